"""The core (C++): Cosserat rods and projection to centerlines; see `src/core/README.md`."""

from collections.abc import Callable
from typing import Any

import numpy as np

class RodModel:
    nodes: int

class Lumen:
    bytes: int
    steepest: float
    def distance(self, points: np.ndarray) -> np.ndarray: ...

class Projector:
    def project(
        self, points: np.ndarray, nearest: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]: ...

class Loads: ...
class Tubes: ...

class Motion:
    def placements(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

class Drives: ...
class Transmission: ...

class Options:
    """Settings; `OPTIONS` says what each is."""

    def __setattr__(self, name: str, value: float) -> None: ...

LEVEL: str
LANES: int
OUTPUTS: list[tuple[str, str, int, str, str]]
"""What a run records: name, what it has an entry of, numbers of an entry, unit, meaning."""
OPTIONS: list[tuple[str, str, str, str]]
"""The settings: name, type ("float" or "int"), unit, meaning."""

def supported_levels() -> list[str]: ...
def make_rod(
    *,
    abscissa: np.ndarray,
    shear: np.ndarray,
    stretch: np.ndarray,
    bend: np.ndarray,
    twist: np.ndarray,
    rest: np.ndarray,
    radius: np.ndarray,
    drag: np.ndarray,
    spin_drag: np.ndarray,
) -> RodModel: ...
def make_lumen(
    *,
    values: np.ndarray,
    origin: np.ndarray,
    spacing: float,
    near: float,
    far: float,
    finer: int,
    spheres: np.ndarray,
) -> Lumen: ...
def make_projector(
    *,
    point: np.ndarray,
    tangent: np.ndarray,
    abscissa: np.ndarray,
    radius: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    branch: np.ndarray,
    rival: np.ndarray,
    entry: np.ndarray,
    ostium: np.ndarray,
    axis: np.ndarray,
    catheter_radius: float,
) -> Projector: ...
def make_loads(
    *,
    force: np.ndarray,
    moment: np.ndarray,
    spring: np.ndarray,
    anchor: np.ndarray,
    hold: np.ndarray,
    attitude: np.ndarray,
) -> Loads: ...
def make_tubes(
    *,
    spacing: float,
    shear_share: float,
    bend: np.ndarray,
    twist: np.ndarray,
    stretch: np.ndarray,
    rest: np.ndarray,
    radius: np.ndarray,
    bore_friction: np.ndarray,
) -> Tubes: ...
def make_drives(limits: np.ndarray) -> Drives: ...
def make_motion(*, ostium: np.ndarray, period: np.ndarray, coefficients: np.ndarray) -> Motion: ...
def make_transmission(
    *, spacing: float, length: np.ndarray, friction: np.ndarray, compliance: np.ndarray
) -> Transmission: ...

class Simulation:
    nodes: int

    def __init__(
        self,
        *,
        rod: RodModel,
        lumen: Lumen | None,
        loads: Loads | None,
        origin: np.ndarray,
        orientation: np.ndarray,
        options: Options,
        drives: Drives,
        tubes: Tubes | None = None,
        motion: Motion | None = None,
        transmission: Transmission | None = None,
        worlds: int,
    ) -> None: ...
    def reset(self, *, index: np.ndarray, initial: np.ndarray, friction: np.ndarray, sample_period: float) -> None: ...
    def run(
        self,
        *,
        control: np.ndarray,
        force_driven: bool,
        time_step: float,
        steps_per_sample: int,
        record_shape: bool,
        record_attitude: bool,
        threads: int,
        lanes: int,
        chosen: np.ndarray,
        progress: Callable[[int], Any] | None,
    ) -> dict[str, np.ndarray]: ...
    def state(self) -> np.ndarray: ...
    def set_state(self, all: np.ndarray) -> None: ...
    def tips(self) -> np.ndarray: ...
    def tip_directions(self) -> np.ndarray: ...
    def positions(self) -> np.ndarray: ...
    def attitudes(self) -> np.ndarray: ...
    def contacts(self) -> np.ndarray: ...
    def time(self) -> np.ndarray: ...
    def active(self) -> np.ndarray: ...
    def drive_rotation(self) -> np.ndarray: ...
    def reason(self) -> np.ndarray: ...
    def __getattr__(self, name: str) -> Callable[[], np.ndarray]:
        """Any output that is a number of a device, as it is now."""
