"""Verification in tubes: a rod under its weight that buckles on the bottom, and a whip of torque in a bent one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from endopilot import _core
from endopilot.simulation.config import COMPLIANT_WALL_STIFFENING_MM2, SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.rod import RodLayout
from endopilot.types import DistanceMap, Insertion
from endopilot.verification.free_rod import (
    STATIC,
    Case,
    Curve,
    Loading,
    Picture,
    compare,
    equilibrium,
    extrapolate_to_zero,
    straight_rod,
)

BEND_N_MM2 = 100.0
WEIGHT_N_MM = 1e-3
CLEARANCE_MM = 1.0
WIRE_RADIUS_MM = 0.2
WALL_N_MM = 20.0
"""Stiffness of the tube's wall at a node."""
WAVES = 10
"""Natural wavelengths 2π (EI r/w)^¼ that the rod is long."""
LOAD_N = float(np.sqrt(BEND_N_MM2 * WEIGHT_N_MM / CLEARANCE_MM))
"""sqrt(EI w/r), the unit of the critical loads."""
WAVE_NUMBER_MM = float((WEIGHT_N_MM / (BEND_N_MM2 * CLEARANCE_MM)) ** 0.25)
TUBE_LENGTH_MM = WAVES * 2 * np.pi / WAVE_NUMBER_MM
SINUSOIDAL_SHARES = np.array([0.94, 0.96, 0.98])
HELICAL_LOADS = np.array([3.5, 4.0, 4.5])
"""Loads in units of LOAD_N under which the rod lies in a helix that is measured."""
WHIP_JOINTS = 60
WHIP_TUBE_CURVATURE = 0.05
"""Curvature of the tube, 1/mm."""
WHIP_WIRE_CURVATURE = 0.02
"""Curvature of the unloaded wire, 1/mm."""
WHIP_BEND = 10.0
WHIP_TWIST = 8.0
WHIP_SHARES = np.array([0.85, 0.9, 0.95])
PRESSED_BEND_N_MM2 = 5.0
"""EI of the rod that is pressed into a compliant wall, N·mm²."""


def straight_tube(*, length_mm: float, radius_mm: float, outside_mm: float = 0.8) -> DistanceMap:
    """Return the distance map of a tube about the x-axis from 0 to a length, with open ends, and of some mm outside."""
    spacing_mm = 0.2
    across = np.arange(-radius_mm - outside_mm, radius_mm + outside_mm + spacing_mm / 2, spacing_mm)
    along = np.arange(-outside_mm, length_mm + outside_mm, spacing_mm)
    values = radius_mm - np.sqrt(across[None, :, None] ** 2 + across[:, None, None] ** 2) + 0 * along
    origin = np.array([along[0], across[0], across[0]])
    return DistanceMap(values=np.maximum(values, -outside_mm - 0.2), spacing_mm=spacing_mm, origin_mm=origin)


def rod_in_tube(
    load: float,
    side: Float[np.ndarray, "n 2"],
    *,
    drag: float,
    samples: int,
    guided: bool,
    lumen: _core.Lumen,
) -> tuple[Float[np.ndarray, "n 3"], RodLayout, Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Press on the tip of a rod in a horizontal tube; return its nodes, the rod, their weight and the wall's force, N.

    Args:
        load: dead axial load on the tip in units of LOAD_N.
        side: y and z of a small load on the nodes, as share of their weight; one row a node from the tip.
        drag: of a mm of rod, N·s/mm².
        samples: samples of 0.5 s until it is at rest.
        guided: keep the tip from moving sideways.
        lumen: the tube.
    """
    elements = len(side)
    rod = straight_rod(
        elements=elements,
        length_mm=TUBE_LENGTH_MM,
        bend=BEND_N_MM2,
        twist=BEND_N_MM2,
        shear=1e4,
        stretch=1e5,
        radius_mm=WIRE_RADIUS_MM,
    )
    size = float(rod.abscissa_mm[1])
    rod.drag_n_s_mm[:] = drag * size
    loading = Loading.none(len(rod.abscissa_mm))
    weight = np.full(elements, WEIGHT_N_MM * size)
    loading.force_n[:elements, 1:] = weight[:, None] * side
    loading.force_n[:elements, 2] -= weight
    loading.force_n[0, 0] -= load * LOAD_N
    if guided:
        loading.spring_n_mm[:2, 1] = 1e3
    bottom = Insertion(position=np.array([0.0, 0.0, -CLEARANCE_MM]), direction=np.array([1.0, 0.0, 0.0]))
    config = SimulatorConfig(time_step_s=0.5, tolerance_mm=1e-7, wall_stiffness_n_mm=WALL_N_MM, threads=1)
    result = equilibrium(rod, loading, samples=samples, lumen=lumen, insertion=bottom, config=config)
    return result["shape"][-1][:elements], rod, weight, result["contacts"][:elements]


def along_tube(elements: int) -> Float[np.ndarray, "n"]:
    """Return the place of each free node along the tube before the rod is loaded, mm, from the tip on."""
    return TUBE_LENGTH_MM * (1 - np.arange(elements) / (elements - 0.5))


def _tube() -> _core.Lumen:
    radius = CLEARANCE_MM + WIRE_RADIUS_MM
    return make_lumen(straight_tube(length_mm=TUBE_LENGTH_MM, radius_mm=radius), WIRE_RADIUS_MM)


def sinusoidal_buckling() -> list[Case]:
    """Compare the load under which a rod on a tube's bottom begins to snake with F = 2 sqrt(EI w/r).

    R. Dawson and P. R. Paslay, J. Petroleum Technology 36 (1984) 1734-1738. A wave of wave number k across the bottom
    has the stiffness EI k⁴ - F k² + w/r per length; it vanishes first at k⁴ = w/(EI r). r is the clearance.
    """
    elements, lumen = 200, _tube()
    along = along_tube(elements)
    pattern = np.sin(WAVE_NUMBER_MM * along) * np.sin(np.pi * along / TUBE_LENGTH_MM)
    share = 1e-3
    side = share * np.column_stack([pattern, 0 * pattern])
    stiffness = []
    for load in 2 * SINUSOIDAL_SHARES:
        shape, *_ = rod_in_tube(load, side, drag=1e-12, samples=3, guided=True, lumen=lumen)
        stiffness.append(share * WEIGHT_N_MM * (pattern**2).sum() / (pattern * shape[:, 1]).sum())
    value = extrapolate_to_zero(np.array(stiffness), 2 * SINUSOIDAL_SHARES)
    line = np.array([1.85, 2.0])
    picture = Picture(
        "axial load, √(EI w/r)",
        "stiffness against the mode, w/r",
        (
            Curve("2 − F/√(EI w/r)", line, 2 - line, "reference"),
            Curve("core", 2 * SINUSOIDAL_SHARES, np.array(stiffness) * CLEARANCE_MM / WEIGHT_N_MM),
            Curve("core, continued to 0", np.array([value]), np.zeros(1), "mark"),
        ),
    )
    return [compare("rod in a horizontal tube, sinusoidal F", 2 * LOAD_N, value * LOAD_N, 0.05, picture)]


def helix(load: float, lumen: _core.Lumen) -> tuple[float, float]:
    """Let a rod in a tube coil up, and return its energy over the straight rod's and the wall's force on it.

    Both are taken over the whole turns in the middle half of the rod. A load of a tenth of the weight in the shape of a
    helix gives all turns the same hand, and the wave number sqrt(F/(2 EI)).

    Args:
        load: dead axial load in units of LOAD_N.
        lumen: the tube.

    Returns:
        Energy of bending, weight and axial load per length, in units of w r; force per length, in units of w.
    """
    elements = 300
    phase = WAVE_NUMBER_MM * np.sqrt(load / 2) * along_tube(elements)
    side = 0.1 * np.column_stack([np.sin(phase), -np.cos(phase)])
    shape, rod, weight, wall = rod_in_tube(load, side, drag=7.5e-6, samples=300, guided=False, lumen=lumen)
    angle = np.unwrap(np.arctan2(shape[:, 1], -shape[:, 2]))
    first, last = elements // 4, 3 * elements // 4
    turns = int(abs(angle[last] - angle[first]) / (2 * np.pi))
    if turns < 3:
        raise RuntimeError(f"no helix under {load:g} sqrt(EI w/r): {turns} turns in the middle half of the rod")
    last = first + int(np.argmin(np.abs(np.abs(angle[first:] - angle[first]) - 2 * np.pi * turns)))
    middle, size = slice(first, last), float(rod.abscissa_mm[1])
    step = np.diff(shape, axis=0)
    tangent = step / np.linalg.norm(step, axis=1)[:, None]
    turned = np.arccos(np.clip((tangent[1:] * tangent[:-1]).sum(axis=1), -1, 1))
    bending = 0.5 * rod.bend_n_mm2[1 : elements - 1] * (turned / size) ** 2
    lifting = weight / size * (shape[:, 2] + CLEARANCE_MM)
    shortening = load * LOAD_N * (1 - np.abs(step[:, 0]) / size)
    energy = bending[first - 1 : last - 1].mean() + lifting[middle].mean() - shortening[middle].mean()
    force = wall[middle].mean() / size
    return float(energy / (WEIGHT_N_MM * CLEARANCE_MM)), float(force / WEIGHT_N_MM)


def helical_buckling() -> list[Case]:
    """Compare the load at which a helix in a tube has the straight rod's energy with F = 2 sqrt(2) sqrt(EI w/r).

    Y.-C. Chen, Y.-H. Lin and J. B. Cheatham, J. Petroleum Technology 42 (1990) 214-220. A helix of wave number k has
    the energy EI r² k⁴/2 - F r² k²/2 + w r over the straight rod's, per length, which is w r - F² r²/(8 EI) at its
    best k² = F/(2 EI) and vanishes at that load. For some range above it the snaking rod is stable too: so the helix
    is measured where the rod coils up by itself, and continued. The weight makes the turns uneven, which lowers the
    load by 1.3 %. The energy hardly feels a wrong balance of forces, so the wall's force is compared too: it is
    r k² (F - EI k²) per length, F² r/(4 EI) at that wave number (A. Lubinski, W. S. Althouse and J. L. Logan, J.
    Petroleum Technology 14 (1962) 655-670).
    """
    lumen = _tube()
    energy, force = np.array([helix(load, lumen) for load in HELICAL_LOADS]).T
    value = np.sqrt(extrapolate_to_zero(energy, HELICAL_LOADS**2, degree=1))
    line = np.linspace(2.5, 4.6, 50)
    picture = Picture(
        "axial load, √(EI w/r)",
        "energy over the straight rod's, w r per length",
        (
            Curve("1 − F²/(8 EI w/r)", line, 1 - line**2 / 8, "reference"),
            Curve("core", HELICAL_LOADS, energy),
            Curve("core, continued to 0", np.array([value]), np.zeros(1), "mark"),
        ),
    )
    pressed = Picture(
        "axial load, √(EI w/r)",
        "wall's force on the helix, w",
        (Curve("F² r/(4 EI)", line, line**2 / 4, "reference"), Curve("core", HELICAL_LOADS, force)),
    )
    expected = HELICAL_LOADS[1] ** 2 / 4
    return [
        compare("rod in a horizontal tube, helical F", 2 * np.sqrt(2) * LOAD_N, value * LOAD_N, 0.05, picture),
        compare("helix in a tube, wall's force / w", expected, force[1], 0.05, pressed),
    ]


def whip(
    length_mm: float, control: Float[np.ndarray, "samples 2"]
) -> tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]:
    """Turn a bent wire in a bent tube without clearance and friction, and return the angles of its base and its tip.

    Stiff springs hold the nodes on the tube's arc. Angles are those of the wire's bend against the tube's, rad; both
    begin at π, where the wire is bent against the tube.

    Args:
        length_mm: length of the wire in the tube.
        control: 0 and rotation of the base, rad/s.
    """
    size = length_mm / WHIP_JOINTS  # joints between the clamped element and the tip's
    elements = WHIP_JOINTS + 1
    rod = straight_rod(
        elements=elements, length_mm=(elements - 0.5) * size, bend=WHIP_BEND, twist=WHIP_TWIST, drag=1e-9
    )
    rod.rest_curvature[1:elements, 0] = WHIP_WIRE_CURVATURE
    loading = Loading.none(len(rod.abscissa_mm))
    turned = WHIP_TUBE_CURVATURE * size * np.arange(elements)
    tangent = np.column_stack([np.cos(turned), np.sin(turned), 0 * turned])
    start = np.array([[-0.5 * size, 0.0, 0.0]])
    nodes = np.concatenate([start, start + size * np.cumsum(tangent, axis=0)])
    loading.anchor_mm[: elements + 1] = nodes[::-1]
    loading.spring_n_mm[:elements] = 1e4
    result = equilibrium(rod, loading, control=control)
    frames = Rotation.from_quat(result["attitude"][:, 0], scalar_first=True).as_matrix()
    up = np.array([0.0, 0.0, 1.0])
    inward = np.cross(up, frames[:, :, 2])
    tip = -np.arctan2((frames[:, :, 0] * inward).sum(axis=1), frames[:, :, 0] @ up)
    base = np.pi + 0.5 * np.cumsum(control[:, 1])
    return base, base + np.mod(tip - base + np.pi, 2 * np.pi) - np.pi  # the tip lags by less than half a turn


def torque_whip() -> list[Case]:
    """Compare the length from which a bent wire's tip whips round in a bent tube with L = π/2 sqrt(GJ/(EI k0 kt)).

    GJ θ'' = EI k0 kt sin θ with θ given at the base and θ' = 0 at the tip; k0, kt are the curvatures of tube and wire.
    About θ = π the tip turns 1/cos(L sqrt(EI k0 kt/GJ)) times as far as the base, which diverges at that length: a
    longer wire jumps. J. Burgner-Kahrs, D. C. Rucker and H. Choset, IEEE Trans. Robotics 31 (2015) 1261-1280, and P.
    E. Dupont et al., IEEE Trans. Robotics 26 (2010) 209-225, have it for concentric tubes.
    """
    rate = np.sqrt(WHIP_BEND * WHIP_TUBE_CURVATURE * WHIP_WIRE_CURVATURE / WHIP_TWIST)
    critical = np.pi / 2 / rate
    nudge = 1e-4
    control = np.zeros((4, 2))
    control[0, 1] = nudge / 0.5
    ratio = []
    for share in WHIP_SHARES:
        _, tip = whip(share * critical, control)
        ratio.append(nudge / (tip[-1] - np.pi))
    value = extrapolate_to_zero(np.array(ratio), WHIP_SHARES * critical)
    picture = Picture("angle of the base, rad", "angle of the tip, rad", _there_and_back(critical, rate))
    return [compare("torque whip, snap length, mm", critical, value, 0.02, picture)]


def _there_and_back(critical: float, rate: float) -> tuple[Curve, ...]:
    """Return the tip's angle while the base turns by 3π and back, for a short and a long wire."""
    steps = 90
    control = np.zeros((2 * steps, 2))
    control[:steps, 1] = 3 * np.pi / steps / 0.5
    control[steps:, 1] = -3 * np.pi / steps / 0.5
    curves = []
    for share in (0.7, 1.5):
        base, tip = whip(share * critical, control)
        exact = _pendulum(share * critical, rate)
        curves.append(Curve(f"closed form, {share:g} of the snap length", *exact, "reference"))
        curves.append(Curve(f"core, {share:g}, there and back", base, tip))
    return tuple(curves)


def _pendulum(length_mm: float, rate: float) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return angles of base and tip, three turns of them, that satisfy θ'' = rate² sin θ with θ' = 0 at the tip."""
    away = np.geomspace(1e-3, np.pi, 150)
    tip = np.pi + np.concatenate([-away[::-1], away])

    def slope(_: float, state: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        angle, turn = np.split(state, 2)
        return np.concatenate([turn, rate**2 * np.sin(angle)])

    solution = solve_ivp(slope, (0.0, length_mm), np.concatenate([tip, 0 * tip]), rtol=1e-8, atol=1e-10)
    base = solution.y[: len(tip), -1]
    turns = 2 * np.pi * np.array([-1, 0, 1, 2])[:, None]
    base, tip = (base + turns).ravel(), (tip + turns).ravel()
    shown = (base > 0.5 * np.pi) & (base < 4.5 * np.pi)
    return base[shown], tip[shown]


def rod_on_wall(
    foundation_n_mm2: float, weight_n_mm: float, *, load_n: float = 0.0
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Lay a long rod on a tube's compliant bottom; return places on it and how far it sinks there, mm.

    Args:
        foundation_n_mm2: stiffness of the wall.
        weight_n_mm: of the rod, by which all of it sinks.
        load_n: on the node in the middle, besides.
    """
    elements, length, radius = 241, 120.0, 0.1
    rod = straight_rod(
        elements=elements, length_mm=length, bend=PRESSED_BEND_N_MM2, twist=PRESSED_BEND_N_MM2, shear=1e5, stretch=1e5
    )
    tube = straight_tube(length_mm=length + 10, radius_mm=2.0, outside_mm=4.0)
    sinks = stiffening_depth(weight_n_mm / foundation_n_mm2)
    start = Insertion(position=np.array([5.0, 0.0, radius - 2.0 - sinks]), direction=np.array([1.0, 0.0, 0.0]))
    config = replace(STATIC, compliant_wall_n_mm2=foundation_n_mm2)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[:elements, 2] = -weight_n_mm * rod.abscissa_mm[1]
    loading.force_n[elements // 2, 2] -= load_n
    lumen = make_lumen(tube, radius, far_mm=config.wall_reach_mm)
    shape = equilibrium(rod, loading, samples=2, lumen=lumen, insertion=start, config=config)["shape"][-1]
    return rod.abscissa_mm[:elements] - rod.abscissa_mm[elements // 2], radius - 2.0 - shape[:elements, 2]


def stiffening_depth(unstiffened_mm: float) -> float:
    """Return d with d exp(s d²) = `unstiffened_mm`: how far a compliant wall yields that would, if linear, by that."""
    depth: Any = brentq(lambda d: d * np.exp(COMPLIANT_WALL_STIFFENING_MM2 * d**2) - unstiffened_mm, 0.0, 3.0)
    return float(depth)


def compliant_wall() -> list[Case]:
    """Compare a long rod that is pressed into a compliant straight wall with δ = F β/(2 k), β = (k/(4 EI))^¼.

    EI d⁴w/dx⁴ + k w = 0 beside the load: w = δ exp(-β |x|) (cos β x + sin β |x|). M. Hetényi, Beams on Elastic
    Foundation, 1946. A weight keeps the rod on the wall where it would lift, which the equation, being linear, allows;
    the wall hardly stiffens over these hundredths of a millimetre.
    """
    stiffness, load = 0.01, 0.01
    beta = (stiffness / (4 * PRESSED_BEND_N_MM2)) ** 0.25
    (along, resting), (_, pressed) = (rod_on_wall(stiffness, 0.05 * load * beta, load_n=extra) for extra in (0.0, load))
    sunk, exact, away = pressed - resting, load * beta / (2 * stiffness), beta * np.abs(along)
    line = exact * np.exp(-away) * (np.cos(away) + np.sin(away))
    picture = Picture(
        "distance from the load, mm",
        "displacement of the wall, mm",
        (Curve("F β/(2k) exp(−βx) (cos βx + sin βx)", along, line, "reference"), Curve("core", along, sunk)),
    )
    return [compare("rod pressed into a compliant wall, δ, mm", exact, float(sunk.max()), 0.01, picture)]


def stiffening_wall() -> list[Case]:
    """Compare how far a long rod sinks into a compliant wall by its weight w with w = k d exp(s d²)."""
    stiffness, depths = 0.01, np.array([0.5, 1.0, 1.5, 2.0])
    weights = stiffness * depths * np.exp(COMPLIANT_WALL_STIFFENING_MM2 * depths**2)
    found = [rod_on_wall(stiffness, weight) for weight in weights]
    sunk = np.array([float(np.median(depth)) for _, depth in found])
    line = np.linspace(0, depths[-1], 100)
    picture = Picture(
        "displacement of the wall, mm",
        "force, N/mm",
        (
            Curve(
                "k d exp(s d²)", line, stiffness * line * np.exp(COMPLIANT_WALL_STIFFENING_MM2 * line**2), "reference"
            ),
            Curve("core", sunk, weights, "mark"),
        ),
    )
    return [compare("rod's weight on a wall that stiffens, d, mm", depths[-1], sunk[-1], 0.001, picture)]


CASES = (sinusoidal_buckling, helical_buckling, torque_whip, compliant_wall, stiffening_wall)
