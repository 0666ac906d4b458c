"""The Cosserat rod core (C++); see `endopilot.simulation` for what callers use."""

from collections.abc import Callable
from typing import Any

import numpy as np

class RodModel:
    nodes: int

class Lumen:
    bytes: int

class Loads: ...

class Options:
    time_step: float
    steps_per_sample: int
    stick_velocity: float
    wall_stiffness: float
    tolerance: float
    sample_tolerance: float
    largest_step: float
    most_iterations: int
    free_behind: float
    approach_velocity: float
    push_limit: float

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
def make_lumen(*, coefficients: np.ndarray, origin: np.ndarray, spacing: float, near: float, far: float) -> Lumen: ...
def make_loads(
    *,
    force: np.ndarray,
    moment: np.ndarray,
    spring: np.ndarray,
    anchor: np.ndarray,
    hold: np.ndarray,
    attitude: np.ndarray,
) -> Loads: ...
def simulate(
    *,
    rod: RodModel,
    lumen: Lumen | None,
    loads: Loads | None,
    origin: np.ndarray,
    orientation: np.ndarray,
    options: Options,
    initial: np.ndarray,
    control: np.ndarray,
    friction: np.ndarray,
    order: np.ndarray,
    record_shape: bool,
    record_attitude: bool,
    threads: int,
    lanes: int,
    progress: Callable[[int], Any] | None,
) -> dict[str, np.ndarray]: ...
