"""One comparison of the rod core with a reference, and the rods that comparisons are made on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot import _core
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import Loading, of_device, run_core
from endopilot.simulation.rod import RodLayout
from endopilot.simulation.tubes import TubeLayout
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
    config: SimulatorConfig,
    tubes: TubeLayout | None = None,
    loading: Loading | None = None,
    lumen: _core.Lumen | None = None,
    friction: float = 0.0,
    insertion: Insertion = X_AXIS,
    approach: bool = False,
    free_behind_mm: float = 0.0,
    push_limit_n: float = np.inf,
) -> dict[str, np.ndarray]:
    """Drive one rod, or tubes in each other, and return the core's arrays, without the axis of worlds; only tubes have
    one of devices. Controls (mm/s, rad/s) and the start (mm, rad) have a row for each of `tubes`; all else is as of
    `run_core`. Raises RuntimeError where the core did not converge."""
    result = run_core(
        rod,
        lumen,
        insertion,
        config=config,
        initial=initial.reshape(1, -1),
        control=control.reshape(1, len(control), -1),
        friction=np.full((1, initial.size // 2), friction),
        loads=None if loading is None else loading.core(),
        record_shape=True,
        record_attitude=True,
        lanes=1,
        approach=approach,
        free_behind_mm=free_behind_mm,
        push_limit_n=push_limit_n,
        tubes=tubes,
    )
    if not result["valid"].all():
        raise RuntimeError("a verification case did not converge")
    result = of_device(result, 0) if tubes is None else result
    return {name: values[0] for name, values in result.items()}
