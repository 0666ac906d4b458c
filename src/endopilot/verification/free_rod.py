"""The rod core against closed forms of rods without a wall: bending, shear, buckling, large rotations, objectivity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import Loading, of_device, run_core
from endopilot.simulation.rod import RodLayout, TubeLayout
from endopilot.types import Insertion

X_AXIS = Insertion(position=np.zeros(3), direction=np.array([1.0, 0.0, 0.0]))  # free rods point along x from 0
STATIC = SimulatorConfig(time_step_s=0.5, tolerance_mm=1e-8, largest_jump=1e6, threads=1)  # samples are equilibria


@dataclass(frozen=True, eq=False)
class Curve:
    """One curve of a picture: its name in the legend, its points, and its style: `core`, `reference` or `mark`."""

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    style: str = "core"


@dataclass(frozen=True, eq=False)
class Picture:
    """What the figure of a case shows: names and units of the axes, curves, and the kind of its scales."""

    horizontal: str
    vertical: str
    curves: tuple[Curve, ...]
    equal: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, eq=False)
class Case:
    """A comparison with a reference: its error is relative, or absolute if that is 0; `skipped` says why not made."""

    case: str
    reference: float
    value: float
    error: float
    bar: float
    picture: Picture | None = None
    skipped: str = ""

    def row(self) -> dict[str, Any]:
        """Return the row that `endopilot verify` prints; `passed` is None where the case was skipped."""
        figures: dict[str, Any] = {name: getattr(self, name) for name in ("reference", "value", "error")}
        if self.skipped:
            title, figures, passed = f"{self.case} (skipped: {self.skipped})", dict.fromkeys(figures), None
        else:
            title, passed = self.case, bool(self.error <= self.bar)
        return {"case": title, **figures, "bar": self.bar, "passed": passed}


def run(groups: Sequence[Callable[[], list[Case]]]) -> list[Case]:
    """Run groups of cases under a progress bar."""
    cases: list[Case] = []
    with progress("Verifying the rod core", total=len(groups)) as advance:
        for group in groups:
            cases += group()
            advance()
    return cases


def compare(case: str, reference: float, value: float, bar: float, picture: Picture | None = None) -> Case:
    """Return the comparison of a value with its reference, which is not 0."""
    return Case(case, float(reference), float(value), abs(float(value) / float(reference) - 1), bar, picture)


def extrapolate_to_zero(stiffness: Float[np.ndarray, "n"], load: Float[np.ndarray, "n"], *, degree: int = 2) -> float:
    """Return the load at which a stiffness that falls smoothly with it reaches zero, by a polynomial through both."""
    return float(np.polynomial.Polynomial.fit(stiffness, load, degree)(0.0))


def straight_rod(
    *,
    elements: int,
    length_mm: float,
    bend: float,
    twist: float,
    shear: float | None = None,
    stretch: float | None = None,
    radius_mm: float = 0.1,
    drag: float = 1e-12,
    clamp: int = 3,
) -> RodLayout:
    """Return a uniform straight rod whose free length begins in the middle of its first free element (a clamped one
    fixes a direction, and the joint behind it stands for half of it): (elements - 1/2) element lengths.

    EI and GJ are in N·mm², κGA and EA in N (very stiff if not given), a node's drag in N·s/mm; the drive holds `clamp`
    nodes behind the wall.
    """
    stiff = 1e5 * bend / length_mm**2
    return uniform_rod(
        elements + clamp,
        length_mm / (elements - 0.5),
        bend_n_mm2=bend,
        twist_n_mm2=twist,
        shear_n=stiff if shear is None else shear,
        stretch_n=stiff if stretch is None else stretch,
        radius_mm=radius_mm,
        drag_n_s_mm=drag,
        spin_drag_n_mm_s=drag,
    )


def uniform_rod(nodes: int, size_mm: float, **section: float) -> RodLayout:
    """Return a straight rod whose section, by the fields of `RodLayout`, is the same throughout."""
    throughout = {name: np.full(nodes, value) for name, value in section.items()}
    return RodLayout(abscissa_mm=size_mm * np.arange(nodes), rest_curvature=np.zeros((nodes, 3)), **throughout)


def equilibrium(
    rod: RodLayout,
    loading: Loading,
    *,
    samples: int = 2,
    control: Float[np.ndarray, "samples 2"] | None = None,
    config: SimulatorConfig = STATIC,
    inserted_length_mm: float | None = None,
    **scene: Any,
) -> dict[str, np.ndarray]:
    """Bring one clamped rod to rest, as `driven` does, and return the core's arrays without the world axis.
    All nodes but the last three are free; `control` moves the clamp, mm/s and rad/s."""
    if inserted_length_mm is None:
        inserted_length_mm = (len(rod.abscissa_mm) - 3 - 0.5) * float(rod.abscissa_mm[1])
    control = np.zeros((samples, 2)) if control is None else control
    config, initial = replace(config, sample_tolerance_mm=1e-8), np.array([inserted_length_mm, 0.0])
    return driven(rod, control, initial=initial, loading=loading, config=config, **scene)


def driven(
    rod: RodLayout,
    control: Float[np.ndarray, "samples *devices 2"],
    *,
    initial: Float[np.ndarray, "*devices 2"],
    tubes: TubeLayout | None = None,
    loading: Loading | None = None,
    friction: float = 0.0,
    insertion: Insertion = X_AXIS,
    **scene: Any,
) -> dict[str, np.ndarray]:
    """Drive one rod, or tubes in each other, and return the core's arrays, without the axis of worlds; only tubes have
    one of devices. Controls (mm/s, rad/s) and the start (mm, rad) have a row for each of `tubes`; `scene` is what else
    `run_core` takes, as for a rod that begins where it is. Raises RuntimeError where the core did not converge."""
    result = run_core(
        rod,
        insertion=insertion,
        initial=initial.reshape(1, -1),
        control=control.reshape(1, len(control), -1),
        friction=np.full((1, initial.size // 2), friction),
        loads=None if loading is None else loading.core(),
        record_shape=True,
        record_attitude=True,
        lanes=1,
        tubes=tubes,
        **{"lumen": None, "approach": False, "free_behind_mm": 0.0} | scene,
    )
    if not result["valid"].all():
        raise RuntimeError("a verification case did not converge")
    result = of_device(result, 0) if tubes is None else result
    return {name: values[0] for name, values in result.items()}


ELEMENTS = 100
ROLL_UP_DRAG = 0.02
ROLL_UP_SAMPLES = 100


def elastica_tip(alpha: float, elements: int) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "n 3"]]:
    """Return tip displacements (w/L sideways, u/L axially) of a clamped rod under F = α EI/L², and its shape."""
    rod = straight_rod(elements=elements, length_mm=1.0, bend=1.0, twist=1.0)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0] = [0.0, alpha, 0.0]
    shape = equilibrium(rod, loading)["shape"][-1]
    return np.array([shape[0, 1], 1.0 - shape[0, 0]]), shape


def elastica_closed_form(alpha: float) -> tuple[float, float, float]:
    """Return w/L and u/L of a clamped rod's tip under a dead load F = α EI/L², and its curvature at the wall times L.

    With m = (1 + sin θ)/2 of the tip's angle θ and sin ψ = 1/√(2 m), in elliptic integrals of parameter m:
    √α = K - F(ψ), w/L = 1 - 2 [E - E(ψ)]/√α, 1 - u/L = 2 √m cos ψ/√α and (κ L)² = 2 α sin θ (K. E. Bisshopp and D. C.
    Drucker, Quart. Appl. Math. 3 (1945) 272-275).
    """

    def amplitude(m: float) -> float:
        return float(np.arcsin(1 / np.sqrt(2 * m)))

    def load(m: float) -> float:
        return float(ellipk(m) - ellipkinc(amplitude(m), m)) ** 2

    m = float(brentq(lambda m: load(m) - alpha, 0.5 + 1e-12, 1 - 1e-15, xtol=1e-15))  # pyright: ignore
    deflection = 1 - 2 * float(ellipe(m) - ellipeinc(amplitude(m), m)) / np.sqrt(alpha)
    shortening = 1 - 2 * np.sqrt(m) * np.cos(amplitude(m)) / np.sqrt(alpha)
    return float(deflection), float(shortening), float(np.sqrt(2 * alpha * (2 * m - 1)))


def elastica_curve(alpha: float) -> Float[np.ndarray, "2 n"]:
    """Return x/L and y/L along the elastica θ'' = -α cos θ, θ(0) = 0, θ'(1) = 0, from the wall on."""

    def slope(_: float, state: Float[np.ndarray, "4"]) -> list[float]:
        angle, turn = state[:2]
        return [turn, -alpha * np.cos(angle), np.cos(angle), np.sin(angle)]

    start = [0.0, elastica_closed_form(alpha)[2], 0.0, 0.0]
    return solve_ivp(slope, (0.0, 1.0), start, rtol=1e-9, atol=1e-10, t_eval=np.linspace(0, 1, 101)).y[2:]


def elastica() -> list[Case]:
    """Compare a cantilever under a dead tip load, α = F L²/EI, with the elliptic integrals of K. Mattiasson, Int. J.
    Numer. Meth. Eng. 17 (1981) 145-153; loads that he has not: `elastica_closed_form`."""
    table = {
        1.0: (0.301721, 0.056433),
        2.0: (0.493457, 0.160642),
        3.7: elastica_closed_form(3.7)[:2],
        5.0: (0.713792, 0.387628),
        10.0: (0.810609, 0.554996),
        15.0: elastica_closed_form(15.0)[:2],
        40.0: elastica_closed_form(40.0)[:2],
    }
    cases = []
    for alpha, reference in table.items():
        tip, shape = elastica_tip(alpha, ELEMENTS)
        line = elastica_curve(alpha)
        exact = Curve("elastica", line[0], line[1], "reference")
        closed = Curve("tip by elliptic integrals", np.array([1 - reference[1]]), np.array([reference[0]]), "mark")
        curves = (exact, Curve("core", *shape[:ELEMENTS, :2].T), closed)
        picture = Picture("x/L", "y/L", curves, equal=True)
        for name, expected, value in zip(("w/L", "u/L"), reference, tip, strict=True):
            cases.append(compare(f"elastica α={alpha:g} {name}", expected, value, 1e-3, picture))
    return cases


def roll_up() -> list[Case]:
    """Roll a rod into a circle: under an end moment M = 2π EI/L its ends meet. Drag makes it roll up slowly, for the
    moment's potential holds for small rotations in a time step; at rest the drag is gone."""
    rod = straight_rod(elements=ELEMENTS, length_mm=1.0, bend=1.0, twist=1.0, drag=ROLL_UP_DRAG)
    loading = Loading.none(len(rod.abscissa_mm))
    length = (ELEMENTS - 1) * rod.abscissa_mm[1]  # from the wall, in the middle of an element, to the tip element's
    loading.spring_n_mm[:, 2] = 1e3  # keeps the rod in its plane, where the moment's axis is fixed
    loading.moment_n_mm[0] = [2 * np.pi / length, 0.0, 0.0]
    shape = equilibrium(rod, loading, samples=ROLL_UP_SAMPLES)["shape"][-1]
    gap = float(np.linalg.norm(0.5 * (shape[0] + shape[1]))) / length
    return [Case("roll-up gap/L", 0.0, gap, gap, 1e-6)]


def timoshenko() -> list[Case]:
    """Compare a shear-flexible cantilever under a small tip load with δ = F L³/(3 EI) + F L/(κGA)."""
    force, bend, shear = 1e-4, 1.0, 20.0
    rod = straight_rod(elements=ELEMENTS, length_mm=1.0, bend=bend, twist=1.0, shear=shear)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0] = [0.0, force, 0.0]
    shape = equilibrium(rod, loading)["shape"][-1]
    return [compare("Timoshenko tip", force / (3 * bend) + force / shear, shape[0, 1], 1e-3)]


def euler_column() -> list[Case]:
    """Compare the load under which a clamped-free column loses its sideways stiffness with π² EI/(2L)²: the ratio of a
    small sideways load and the tip's motion falls to zero about linearly towards it."""
    critical = np.pi**2 / 4
    loads = critical * np.array([0.9, 0.94, 0.98])
    stiffness = []
    for load in loads:
        rod = straight_rod(elements=ELEMENTS, length_mm=1.0, bend=1.0, twist=1.0)
        loading = Loading.none(len(rod.abscissa_mm))
        loading.force_n[0] = [-load, 1e-6, 0.0]
        stiffness.append(1e-6 / equilibrium(rod, loading)["shape"][-1][0, 1])
    return [compare("Euler column", critical, extrapolate_to_zero(np.array(stiffness), loads), 5e-3)]


def bend_of_45_degrees() -> list[Case]:
    """Compare a curved cantilever loaded out of its plane with the converged solution of a Reissner-Simo rod.

    Radius 100, EI = GJ = 8.333e5, κGA = 4.167e6, EA = 1e7; K.-J. Bathe and S. Bolourchi, Int. J. Numer. Meth. Eng. 14
    (1979) 961-986, whose mesh of 8 elements gave (-13.4, -23.5, 53.4) under 600. Lengths are divided by 100 here.
    """
    references = {300.0: (-7.045, -11.932, 40.192), 600.0: (-13.605, -23.561, 53.475)}
    scale, angle = 100.0, np.pi / 4
    cases = []
    for force, reference in references.items():
        rod = straight_rod(
            elements=ELEMENTS,
            length_mm=angle,
            bend=8.333e5 / scale**2,
            twist=8.333e5 / scale**2,
            shear=4.167e6,
            stretch=1e7,
        )
        rod.rest_curvature[:, 1] = 1.0
        loading = Loading.none(len(rod.abscissa_mm))
        along_y = Insertion(position=np.zeros(3), direction=np.array([0.0, 1.0, 0.0]))
        unloaded = equilibrium(rod, loading, insertion=along_y)["shape"][-1]
        loading.force_n[0] = [0.0, 0.0, force]
        shape = equilibrium(rod, loading, insertion=along_y)["shape"][-1]
        moved = scale * (shape[0] - unloaded[0])
        size = float(np.linalg.norm(reference))
        error = float(np.linalg.norm(moved - reference)) / size
        cases.append(Case(f"45° bend P={force:g}", size, float(np.linalg.norm(moved)), error, 3e-3))
    return cases


def rod_energy(rod: RodLayout, shape: Float[np.ndarray, "n 3"], attitude: Float[np.ndarray, "n 4"]) -> float:
    """Return the elastic energy of a rod, N·mm, written independently of the core; the half of the clamped joint's
    stretch that lies behind the wall is counted too."""
    turn = Rotation.from_quat(attitude, scalar_first=True)
    length = np.diff(rod.abscissa_mm)
    strain = turn[:-1].inv().apply((shape[:-1] - shape[1:]) / length[:, None]) - [0.0, 0.0, 1.0]
    stiffness = np.column_stack([rod.shear_n, rod.shear_n, rod.stretch_n])[:-1]
    stretching = 0.5 * np.sum(length[:, None] * stiffness * strain**2)
    span = 0.5 * (length[:-1] + length[1:])
    curvature = (turn[1:-1].inv() * turn[:-2]).as_rotvec() / span[:, None] - rod.rest_curvature[1:-1]
    stiffness = np.column_stack([rod.bend_n_mm2, rod.bend_n_mm2, rod.twist_n_mm2])[1:-1]
    return float(stretching + 0.5 * np.sum(span[:, None] * stiffness * curvature**2))


def objectivity() -> list[Case]:
    """Turn a curved rod once about its base: unloaded it gains no energy, under a dead load it ends as it began."""
    cases = []
    for name, load in (("unloaded", 0.0), ("closed load loop", 1.0)):
        rod = straight_rod(elements=40, length_mm=1.0, bend=1.0, twist=0.8)
        rod.rest_curvature[:, 0] = 1.0
        rod.rest_curvature[-4:] = 0.0  # the part that is held straight
        loading = Loading.none(len(rod.abscissa_mm))
        loading.force_n[:, 1] = load / len(rod.abscissa_mm)
        steps = 24
        control = np.zeros((steps + 6, 2))
        control[3 : steps + 3, 1] = 2 * np.pi / steps / 0.5
        result = equilibrium(rod, loading, control=control)
        energy = np.array([rod_energy(rod, *pose) for pose in zip(result["shape"], result["attitude"], strict=True)])
        reference = 0.5  # EI κ² L / 2
        change = float(np.abs(energy[3:]).max() if load == 0 else abs(energy[-1] - energy[2])) / reference
        cases.append(Case(f"energy, {name}", 0.0, change, change, 1e-10))
    return cases


CASES = (elastica, roll_up, timoshenko, euler_column, bend_of_45_degrees, objectivity)
