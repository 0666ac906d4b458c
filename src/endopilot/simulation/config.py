"""Settings of the rod core, `SimulatorConfig`, and where it steps worlds: on the processor, or on a CUDA GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import model_validator

from endopilot import _core
from endopilot.errors import InputError
from endopilot.parallel import CORES
from endopilot.settings import Within, settings
from endopilot.types import SAMPLE_PERIOD_S

if TYPE_CHECKING:
    from endopilot._core import Lumen, Options, RodModel, Simulation, Tubes
    from endopilot._core import Motion as CoreMotion
    from endopilot._core import Transmission as CoreTransmission
else:  # each build of the core has classes of its own
    CoreMotion = CoreTransmission = Lumen = Options = RodModel = Simulation = Tubes = Any

Processor = Literal["cpu", "cuda"]  # where worlds are stepped: the processor's threads, or a CUDA GPU


def core_for(processor: Processor) -> Any:
    """Return the module that steps worlds there, with the names of `endopilot._core`; InputError without a GPU."""
    if processor == "cpu":
        return _core
    try:
        core: Any = import_module("endopilot._core_cuda")
    except ModuleNotFoundError:
        raise InputError(
            "processor: 'cuda': endopilot was built without it; build it with -C cmake.define.ENDOPILOT_CUDA=ON, "
            "or give 'cpu'"
        ) from None
    missing = core.why_no_gpu()
    if missing:
        raise InputError(f"processor: 'cuda': no GPU can be used here ({missing}); give 'cpu'")
    return core


@contextmanager
def gpu_errors(processor: Processor) -> Iterator[None]:
    """Turn what a GPU reports, such as too little memory, into an InputError."""
    try:
        yield
    except RuntimeError as error:
        if processor == "cpu":
            raise
        raise InputError(f"processor: 'cuda': {error}; simulate fewer worlds at once, or give 'cpu'") from None


FREE_BEHIND_MM = 3.0  # nodes farther behind the ostium than this follow the drive exactly, mm
LANES = _core.LANES  # worlds that one thread steps side by side
_DENT_MM = 0.015  # depth to which a node that bears all that drives can push dents a wall of no stiffness, mm
_HARD_PUSH_N = 2.0  # push that stands for the limit of a drive that has none, N
_RIGID_REACH_MM, _COMPLIANT_REACH_MM = 0.5, 2.4  # how far outside the wall a wire may lie; maps reach 2.5 mm
_SOFTEST_N_MM2 = 0.01  # a softer wall would yield farther than distance maps reach, N/mm²
_ARTERY_MM = 4.0  # width of the artery that displaces the muscle around it, mm
COMPLIANT_WALL_STIFFENING_MM2 = 8.023 / _ARTERY_MM**2
"""A compliant wall yields by d to K d exp(s d²), s in 1/mm²: muscle in simple shear by γ = d/4 mm bears γ exp(8.023 γ²)
times its modulus (Holzapfel and Ogden, Phil Trans R Soc A 2009, isotropic part, from shear tests of porcine muscle)."""
COMPLIANT_WALL_AT_TIP_MM = 6.4
"""The tip bears on a point, and takes along as much wall as this length has, mm: a rigid disc as wide as the artery, on
the muscle of docs/concepts/wall.md, is held by E B/(1 - ν²) = 0.064 N/mm (Boussinesq), and K is 0.01 N/mm²."""
Actuation = Literal["velocity", "force"]  # mm/s and rad/s, or the drive's axial force (N) and torque (N·mm)


@settings
class SimulatorConfig:
    """Settings of the rod core."""

    time_step_s: Annotated[float, Within(1e-5, SAMPLE_PERIOD_S)] = 0.0125
    """Time step, s; it must divide the sample period of 0.5 s. The tip's error grows about linearly with it."""
    tolerance_mm: Annotated[float, Within(1e-12, 1)] = 1e-3
    """Newton's method stops when its step moves no node farther than this, mm."""
    sample_tolerance_mm: Annotated[float, Within(1e-12, 1)] = 1e-6
    """The same for the time step that ends a sample (no more than `tolerance_mm`): its forces are recorded, and the
    wire is stiff axially."""
    element_mm: Annotated[float, Within(0.02, 5)] = 0.75
    """Length of the wire's elements at its tip, mm; towards the base they grow to five times that."""
    wall_stiffness_n_mm: Annotated[float, Within(1e-3, 1e6)] | None = None
    """Stiffness of the vessel wall at a node, N/mm. If not given, the push limits of all devices together dent it by
    0.015 mm."""
    compliant_wall_n_mm2: Annotated[float, Within(_SOFTEST_N_MM2, 1e6)] | None = None
    """Stiffness of a compliant wall, N/mm of wire and mm of displacement: each place of the wall yields by itself, as a
    bed of springs (Winkler) that stiffen as the heart's muscle does. It takes the place of `wall_stiffness_n_mm` if
    given. An artery that lies in that muscle has 0.01; docs/concepts/wall.md derives it. A softer wall would yield
    farther than distance maps reach."""
    friction_along: tuple[Annotated[float, Within(0, 100)], ...] = ()
    """Factors on friction along the vessel: at even distances from the ostium to the end of the longest path, linear
    between. It is the same everywhere if none is given."""
    wall_along: tuple[Annotated[float, Within(0.1, 10)], ...] = ()
    """The same on the stiffness of a compliant wall."""
    wall_around: tuple[Annotated[float, Within(0.1, 10)], ...] = ()
    """Further factors on that around the vessel: at even angles about the centerline from its normals on, linear
    between."""
    stick_velocity_mm_s: Annotated[float, Within(1e-9, 1000)] = 0.05
    """Slip velocity under which smoothed Coulomb friction falls off, mm/s; a wire at rest creeps more slowly."""
    approach_velocity_mm_s: Annotated[float, Within(0.1, 1000)] = 20.0
    """Velocity at which a wire is brought to its first inserted length before the recording, mm/s."""
    largest_jump: Annotated[float, Within(1e-3, 1e9)] = 0.3
    """Motion of a node in a time step beyond the drive's own, mm (rotations: rad), above which the step is shortened:
    a wire that snaps over is followed in steps of down to 1/64 of `time_step_s`."""
    introducer_friction_n: Annotated[float, Within(0, 1000)] = 0.05
    """Coulomb friction of the introducer's valve, N; the drive feels it, the wire ahead of the valve does not."""
    introducer_drag_n_s_mm: Annotated[float, Within(0, 1000)] = 0.002
    """Viscous drag of the introducer's valve, N·s/mm."""
    processor: Processor = "cpu"
    """Where worlds are stepped: "cpu", or "cuda" on an NVIDIA GPU, one world a thread. The two agree as closely as two
    systems' cosines; a GPU pays for thousands of worlds at once."""
    threads: Annotated[int, Within(0, 1024)] = 0
    """Threads; 0 for one a processor core. The results do not depend on it."""

    @model_validator(mode="after")
    def _consistent(self) -> SimulatorConfig:
        steps = SAMPLE_PERIOD_S / self.time_step_s
        if abs(steps - round(steps)) > 1e-6 or steps < 0.5:
            raise ValueError(f"time_step_s: {self.time_step_s} does not divide {SAMPLE_PERIOD_S} s; give e.g. 0.0125")
        varies = "wall_along" if self.wall_along else "wall_around" if self.wall_around else ""
        if varies and self.compliant_wall_n_mm2 is None:
            raise ValueError(f"{varies}: the wall is not compliant; give compliant_wall_n_mm2 too, such as 0.01")
        softest = (self.compliant_wall_n_mm2 or 0.0) * self.wall_factors(min)
        if varies and softest < _SOFTEST_N_MM2:
            raise ValueError(f"{varies}: the wall has {softest:g} N/mm² at least; give factors by which it has 0.01")
        return self

    def wall_factors(self, end: Callable[..., float]) -> float:
        """Return the least (`min`) or largest (`max`) factor on the stiffness of a compliant wall."""
        return end(self.wall_along, default=1.0) * end(self.wall_around, default=1.0)

    @property
    def steps_per_sample(self) -> int:
        """Time steps in a sample period of 0.5 s."""
        return round(SAMPLE_PERIOD_S / self.time_step_s)

    @property
    def wall_reach_mm(self) -> float:
        """How far outside the wall a wire may lie before it counts as having left the vessel, mm."""
        return _RIGID_REACH_MM if self.compliant_wall_n_mm2 is None else _COMPLIANT_REACH_MM

    def steps_of(self, duration_s: float) -> int:
        """Return into how many time steps, of `time_step_s` at most, some time is cut."""
        return max(1, int(np.ceil(duration_s / self.time_step_s - 1e-9)))

    def threads_for(self, worlds: int, lanes: int) -> int:
        """Return how many threads step some worlds, `lanes` of them side by side: no more than have one to step."""
        return min(self.threads or CORES, -(-worlds // lanes))


Preset = Literal["default", "fast", "accurate"]  # names of `PRESETS`
PRESETS: Mapping[Preset, SimulatorConfig] = MappingProxyType(
    {
        "default": SimulatorConfig(),
        "fast": SimulatorConfig(
            element_mm=1.25, time_step_s=0.025, tolerance_mm=2e-3, sample_tolerance_mm=1e-4, largest_jump=1.0
        ),
        "accurate": SimulatorConfig(element_mm=0.3),
    }
)
"""Settings by name: the usual ones, those for many rollouts, and those for measurements. `python -m benchmarks
simulation --preset NAME` measures speed and error of each."""


def wall_stiffness(config: SimulatorConfig, push_limit_n: float) -> float:
    """Return the stiffness of the wall at a contact, N/mm, for devices of some push limit together or without one."""
    return config.wall_stiffness_n_mm or (push_limit_n if push_limit_n < np.inf else _HARD_PUSH_N) / _DENT_MM
