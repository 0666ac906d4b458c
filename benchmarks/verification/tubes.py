"""Verification of telescoping tubes: stiffness, torsional snap, buckling and friction against closed forms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.rod import RodLayout, TubeLayout
from endopilot.verification.free_rod import (
    STATIC,
    Case,
    Curve,
    Loading,
    Picture,
    compare,
    driven,
    equilibrium,
    extrapolate_to_zero,
    straight_rod,
)

POISSON = 0.3
"""Of a tube of round section, GJ = EI / (1 + ν)."""
ELEMENTS = 80
STRETCHES = 400
SNAP_CURVATURE = 1 / 30
"""Of each of two equal tubes, 1/mm."""
SNAP_SHARES = np.array([0.85, 0.9, 0.95])
BUCKLING_SHARES = np.array([0.9, 0.95, 0.98])


@dataclass(frozen=True)
class Uniform:
    """A tube with the same section and rest curvature (1/mm) throughout: EI and GJ, N·mm²."""

    bend: float
    twist: float
    curvature: float = 0.0


def lay_out(
    tubes: tuple[Uniform, ...], length_mm: float, *, bore_friction: float = 0.0, stretch_n: float | None = None
) -> TubeLayout:
    """Return uniform tubes, the innermost first, with outer radii of 0.1, 0.2, ... mm and drives without limits.

    Args:
        tubes: the tubes.
        length_mm: length of each, mm; so short that elements do not stretch, if `stretch_n` is not given.
        bore_friction: Coulomb coefficient between them.
        stretch_n: EA and κGA of each, N.
    """
    count = len(tubes)

    def profile(values: list[float]) -> Float[np.ndarray, "tubes stretches"]:
        return np.repeat(np.array(values)[:, None], STRETCHES, axis=1)

    stiff = 1e5 * max(tube.bend for tube in tubes) / length_mm**2 if stretch_n is None else stretch_n
    return TubeLayout(
        spacing_mm=length_mm / STRETCHES,
        bend_n_mm2=profile([tube.bend for tube in tubes]),
        twist_n_mm2=profile([tube.twist for tube in tubes]),
        stretch_n=profile([stiff] * count),
        rest_curvature=profile([tube.curvature for tube in tubes]),
        radius_mm=0.1 * np.arange(1, count + 1),
        bore_friction=np.full(count, bore_friction),
        limits=np.full((count, 3), np.inf),
        shear_share=1.0,
    )


def mesh(length_mm: float, *, elements: int = ELEMENTS, drag: float = 1e-12) -> RodLayout:
    """Return the nodes that tubes of some free length share, as `straight_rod` lays them out."""
    return straight_rod(elements=elements, length_mm=length_mm, bend=1.0, twist=1.0, drag=drag)


def drive(
    rod: RodLayout,
    tubes: TubeLayout,
    inserted_length_mm: Float[np.ndarray, "tubes"],
    *,
    rotation: Float[np.ndarray, "tubes"] | None = None,
    control: Float[np.ndarray, "samples tubes 2"] | None = None,
    loading: Loading | None = None,
    config: SimulatorConfig = STATIC,
    approach: bool = False,
) -> dict[str, np.ndarray]:
    """Bring tubes that are clamped at the origin to rest, move them, and return the core's arrays.

    Args:
        rod: the nodes.
        tubes: the tubes.
        inserted_length_mm: free length of each at the start.
        rotation: of each at the start, rad; 0 if not given.
        control: mm/s and rad/s of each; they rest for 1 s if not given.
        loading: dead loads.
        config: settings of the core.
        approach: push them out together from within the clamp; else they start there, straight.
    """
    turned = np.zeros(len(inserted_length_mm)) if rotation is None else rotation
    return driven(
        rod,
        np.zeros((2, len(inserted_length_mm), 2)) if control is None else control,
        initial=np.column_stack([inserted_length_mm, turned]),
        config=replace(config, sample_tolerance_mm=1e-8),
        tubes=tubes,
        loading=loading,
        approach=approach,
    )


def curvature(shape: Float[np.ndarray, "n 3"], size_mm: float) -> Float[np.ndarray, "m"]:
    """Return the curvature at the inner nodes of a polygon with elements of one length, 1/mm."""
    along = np.diff(shape, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    half = 0.5 * np.linalg.norm(np.diff(along, axis=0), axis=1)
    return 2 * np.arcsin(np.clip(half, 0, 1)) / size_mm


def precurved_pair() -> list[Case]:
    """Compare the curvature of two precurved tubes with (E1 κ1 ± E2 κ2) / (E1 + E2), E = EI, aligned and opposed.

    P. E. Dupont et al., IEEE Trans. Robotics 26 (2010) 209-225, eq. 7. Opposed, 40 mm are below the snap.
    """
    length, inner, outer = 40.0, Uniform(100.0, 77.0, 1 / 60), Uniform(60.0, 46.0, 1 / 80)
    rod = mesh(length)
    cases = []
    for name, turned, sign in (("aligned", 0.0, 1), ("opposed", np.pi, -1)):
        result = drive(rod, lay_out((inner, outer), length), np.full(2, length), rotation=np.array([0.0, turned]))
        shape = result["shape"][-1][:ELEMENTS]
        expected = (inner.bend * inner.curvature + sign * outer.bend * outer.curvature) / (inner.bend + outer.bend)
        angle = expected * (length - rod.abscissa_mm[:ELEMENTS])
        arc = np.column_stack([np.sin(angle), np.cos(angle) - 1]) / expected
        picture = Picture(
            "x, mm",
            "y, mm",
            (Curve("arc", arc[:, 0], arc[:, 1], "reference"), Curve("core", shape[:, 0], shape[:, 1])),
            equal=True,
        )
        value = float(curvature(shape, float(rod.abscissa_mm[1])).mean())
        cases.append(compare(f"tubes: curvature of a precurved pair, {name}, 1/mm", expected, value, 1e-3, picture))
    return cases


def twisted_pair(length_mm: float, base: Float[np.ndarray, "samples"]) -> Float[np.ndarray, "samples"]:
    """Turn one of two equal precurved tubes in the other, and return its twist at the tip against the other's, rad.

    Args:
        length_mm: free length, from the clamp to the middle of the foremost element, which no joint is ahead of.
        base: its rotation at the clamp, rad, step by step; it starts opposed, at π.
    """
    size = length_mm / (ELEMENTS - 1)
    rod = mesh((ELEMENTS - 0.5) * size)
    tube = Uniform(60.0, 60.0 / (1 + POISSON), SNAP_CURVATURE)
    free = np.full(2, (ELEMENTS - 0.5) * size)
    control = np.zeros((len(base) + 1, 2, 2))
    control[1:, 1, 1] = np.diff(base, prepend=np.pi) / 0.5
    result = drive(rod, lay_out((tube, tube), float(free[0])), free, rotation=np.array([0.0, np.pi]), control=control)
    return result["tip_twist"][1:, 1]


def snap_rate() -> float:
    """Return √c of α″ = c sin α for the pair, 1/mm: c = κ² EI/2 (2/GJ) = κ² (1 + ν)."""
    return SNAP_CURVATURE * float(np.sqrt(1 + POISSON))


def pendulum_tip(length_mm: float, base: float) -> float:
    """Return the tip's angle of α″ = c sin α, α given at the base and α′ = 0 at the tip, for a base before π."""

    def miss(tip: float) -> float:
        rate2 = snap_rate() ** 2
        solution = solve_ivp(
            lambda _, state: [state[1], rate2 * np.sin(state[0])], (0, length_mm), [tip, 0.0], rtol=1e-10, atol=1e-12
        )
        return float(solution.y[0, -1]) - base

    found: Any = brentq(miss, 1e-6, np.pi)
    return float(found)


def torsional_snap() -> list[Case]:
    """Compare the length from which two equal precurved tubes snap with L √c = π/2, and their twist with that.

    α″ = c sin α with c = κ1 κ2 EI1 EI2/(EI1 + EI2) (1/GJ1 + 1/GJ2), α′ = 0 at the tip (P. E. Dupont et al., IEEE Trans.
    Robotics 26, 2010, 209-225). About α = π the tip turns 1/cos(L √c) times as far as the base, which diverges at that
    length: 41.3 mm for a curvature of 1/30 mm and ν = 0.3.
    """
    critical, nudge = np.pi / 2 / snap_rate(), 1e-4
    ratio = [nudge / (twisted_pair(share * critical, np.array([np.pi + nudge]))[-1] - np.pi) for share in SNAP_SHARES]
    value = extrapolate_to_zero(np.array(ratio), SNAP_SHARES * critical)
    length = 0.8 * critical
    base = np.pi - np.array([0.2, 0.5, 0.8, 1.2, 1.6, 2.0])
    tip = twisted_pair(length, base)
    expected = np.array([pendulum_tip(length, angle) for angle in base])
    picture = Picture(
        "angle of the base, rad",
        "angle of the tip, rad",
        (Curve("α″ = c sin α", base, expected, "reference"), Curve("core", base, tip)),
    )
    return [
        compare("tubes: torsional snap, length, mm", critical, value, 0.01, picture),
        compare("tubes: twist of the tip before the snap, rad", expected[2], tip[2], 0.01, picture),
    ]


def telescoped_cantilever() -> list[Case]:
    """Compare a wire in a catheter that ends `a` from the clamp, under a load F at its tip, with the beam's deflection.

    δ = F {[L³ - (L-a)³]/(3 (EIw + EIc)) + (L-a)³/(3 EIw)}, the integral of M²/EI. The end lies within an element.
    """
    length, wire, catheter, force = 40.0, Uniform(10.0, 8.0), Uniform(50.0, 40.0), 1e-5
    rod = mesh(length)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0, 1] = force
    overlap = np.array([0.0, 5.1, 12.4, 20.2, 28.9, 40.0])
    found = []
    for covered in overlap:
        result = drive(rod, lay_out((wire, catheter), length), np.array([length, covered]), loading=loading)
        found.append(float(result["shape"][-1][0, 1]))
    both, rest = wire.bend + catheter.bend, length - overlap
    expected = force * ((length**3 - rest**3) / (3 * both) + rest**3 / (3 * wire.bend))
    worst = int(np.argmax(np.abs(np.array(found) / expected - 1)))
    picture = Picture(
        "overlap, mm",
        "deflection, mm",
        (Curve("closed form", overlap, expected, "reference"), Curve("core", overlap, np.array(found), "mark")),
    )
    return [compare("tubes: telescoped cantilever, deflection, mm", expected[worst], found[worst], 5e-3, picture)]


def wire_out_of_a_catheter() -> list[Case]:
    """Compare the load that buckles a wire which stands out of a rigid catheter by l with π² EI / 4 l² (Euler)."""
    length, free, wire = 40.0, 15.2, Uniform(10.0, 8.0)
    catheter = Uniform(1e5 * wire.bend, 1e5 * wire.twist)
    critical = np.pi**2 * wire.bend / (4 * free**2)
    rod, tubes = mesh(length), lay_out((wire, catheter), length, stretch_n=1e3)
    stiffness = []
    for share in BUCKLING_SHARES:
        loading = Loading.none(len(rod.abscissa_mm))
        side = 1e-6 * critical
        loading.force_n[0] = [-share * critical, side, 0.0]
        result = drive(rod, tubes, np.array([length, length - free]), loading=loading)
        stiffness.append(side / result["shape"][-1][0, 1])
    value = extrapolate_to_zero(np.array(stiffness), BUCKLING_SHARES * critical)
    picture = Picture(
        "axial load, N",
        "stiffness of the tip, N/mm",
        (
            Curve("core", BUCKLING_SHARES * critical, np.array(stiffness)),
            Curve("core, continued to 0", np.array([value]), np.zeros(1), "mark"),
            Curve("π² EI / 4 l²", np.array([critical]), np.zeros(1), "reference"),
        ),
    )
    return [compare("tubes: wire out of a rigid catheter, buckling load, N", critical, value, 5e-3, picture)]


def two_halves() -> list[Case]:
    """Compare two tubes of half the stiffness each with one rod of the whole, bent and twisted in space; and a catheter
    from which the wire has been withdrawn with its own curvature."""
    length, half = 30.0, Uniform(30.0, 24.0, 0.02)
    rod = mesh(length)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0] = [0.0, 0.02, 0.05]
    free = float((ELEMENTS - 0.5) * rod.abscissa_mm[1])  # as `equilibrium` has it, to the last bit
    pair = drive(rod, lay_out((half, half), length), np.full(2, free), loading=loading)["shape"][-1]
    whole = straight_rod(
        elements=ELEMENTS,
        length_mm=length,
        bend=2 * half.bend,
        twist=2 * half.twist,
        shear=2e5 * 30 / 900,
        stretch=2e5 * 30 / 900,
    )
    whole.rest_curvature[:, 0] = half.curvature
    one = equilibrium(whole, loading)["shape"][-1]
    apart = float(np.linalg.norm(pair - one, axis=1)[:ELEMENTS].max())
    picture = Picture(
        "x, mm",
        "y, mm",
        (
            Curve("one rod", one[:ELEMENTS, 0], one[:ELEMENTS, 1], "reference"),
            Curve("two tubes", pair[:ELEMENTS, 0], pair[:ELEMENTS, 1]),
        ),
        equal=True,
    )
    wire, catheter = Uniform(60.0, 48.0), Uniform(20.0, 16.0, 1 / 40)
    control = np.zeros((22, 2, 2))
    control[1:21, 0, 0] = -length / 20 / 0.5
    bare = drive(rod, lay_out((wire, catheter), length), np.full(2, length), control=control)["shape"]
    size = float(rod.abscissa_mm[1])
    before, after = (float(curvature(shape[:ELEMENTS], size).mean()) for shape in (bare[0], bare[-1]))
    joined = catheter.bend * catheter.curvature / (wire.bend + catheter.bend)
    return [
        Case("tubes: two halves and one rod, apart, mm", 0.0, apart, apart, 1e-6, picture),
        compare("tubes: catheter with the wire in it, curvature, 1/mm", joined, before, 1e-3),
        compare("tubes: catheter after the wire's withdrawal, curvature, 1/mm", catheter.curvature, after, 1e-3),
    ]


@dataclass(frozen=True)
class Sliding:
    """A wire in a rigid, bent catheter, with a dead load on its tip along the catheter's end.

    Attributes:
        bore_friction: Coulomb coefficient.
        angle_rad: by which the catheter is bent.
        load_n: on the wire's tip, N.
        wire: so soft that it presses on the catheter by its tension alone.
    """

    bore_friction: float
    angle_rad: float
    load_n: float = 0.05
    wire: Uniform = Uniform(0.003, 0.003)

    def drive(
        self, velocity: tuple[float, float], samples: int
    ) -> tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]:
        """Return the pull of the wire's drive over the load, and its torque over the load and the wire's radius.

        Args:
            velocity: of the wire, mm/s and rad/s.
            samples: of 0.5 s.
        """
        length, ahead = 40.0, 0.5
        catheter = Uniform(1e4, 1e4, self.angle_rad / (length - ahead))
        rod = mesh(length, elements=100, drag=1e-9)
        layout = lay_out((self.wire, catheter), length, bore_friction=self.bore_friction, stretch_n=1e3)
        loading = Loading.none(len(rod.abscissa_mm))
        loading.force_n[0] = self.load_n * np.array([np.cos(self.angle_rad), -np.sin(self.angle_rad), 0.0])
        control = np.zeros((samples, 2, 2))
        control[:, 0] = velocity
        config = SimulatorConfig(
            time_step_s=0.05, tolerance_mm=1e-6, stick_velocity_mm_s=1e-4, largest_jump=1e6, threads=1
        )
        inserted = np.array([length, length - ahead])
        result = drive(rod, layout, inserted, control=control, loading=loading, config=config, approach=True)
        force, torque = result["base_force"][:, 0], result["base_torque"][:, 0]
        return -force / self.load_n, torque / (self.load_n * float(layout.radius_mm[0]))


def friction_between() -> list[Case]:
    """Compare the pull on a wire in a bent catheter, and the torque that turns it, with closed forms.

    The catheter presses the wire with T κ a length. So the pull grows to exp(µ θ) times the load on the tip (L. Euler's
    capstan), and the torque to µ θ T r. Until then the turn winds up the wire from the base: the torque is
    sqrt(2 GJ q φ) after a turn by φ, with q = µ T κ r the friction a length. µ is small there, for the wire keeps the
    axial friction of its way in until it turns.
    """
    angles, friction = np.array([0.5, 1.0, 1.5]), 0.3
    pulls = np.array([Sliding(friction, float(angle)).drive((-0.05, 0.0), 4)[0][-1] for angle in angles])
    expected = np.exp(friction * angles)
    pulled = Picture(
        "angle of the catheter, rad",
        "pull / load on the tip",
        (Curve("exp(µθ)", angles, expected, "reference"), Curve("core", angles, pulls, "mark")),
    )
    turned, speed = Sliding(0.05, 1.0, load_n=0.01), 0.1
    _, torque = turned.drive((0.0, speed), 12)
    wound = 0.5 * speed * np.arange(1, 13)
    q = turned.bore_friction * turned.load_n * turned.angle_rad / 39.5 * 0.1
    lag = np.minimum(
        np.sqrt(2 * turned.wire.twist * q * wound) / (turned.load_n * 0.1), turned.bore_friction * turned.angle_rad
    )
    twisted = Picture(
        "turn of the drive, rad",
        "torque / (T r)",
        (Curve("closed form", wound, lag, "reference"), Curve("core", wound, torque)),
    )
    return [
        compare("tubes: wire pulled through a bent catheter, T2/T1", expected[1], pulls[1], 0.01, pulled),
        compare("tubes: wire pulled through a catheter bent more, T2/T1", expected[2], pulls[2], 0.01),
        compare("tubes: wire wound up in a bent catheter, torque / (T r)", lag[1], torque[1], 0.02, twisted),
        compare("tubes: wire turned in a bent catheter, torque / (T r)", lag[-1], torque[-1], 0.02),
    ]


CASES = (
    precurved_pair,
    torsional_snap,
    telescoped_cantilever,
    wire_out_of_a_catheter,
    two_halves,
    friction_between,
)
