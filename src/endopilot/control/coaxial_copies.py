"""What the search for a wire in a catheter is made of: copies driven side by side, its settings and its result."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from endopilot.control.halt import SPARE_SHARE
from endopilot.control.period import drive_period
from endopilot.control.route import Route
from endopilot.devices.drive_limits import SPARE_MM, DriveLimits
from endopilot.settings import Positive, Seconds, Within, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulatorState
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.task import CORE
from endopilot.types import TipProjection


@settings
class CoaxialSearchConfig:
    """Settings of the search."""

    turns: Annotated[int, Within(1, 1000)] = 12
    """Rotations that are tried at each place."""
    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 5.0
    """Translation of either device, mm/s."""
    behind_mm: Positive = 10.0
    """The catheter follows to this far behind the wire's tip, mm, except to the target if its own tip is to arrive."""
    longest_s: Seconds = 30.0
    """A catheter is brought to its place in this time at most, s, and a wire past a fork."""
    core: SimulatorConfig = field(default_factory=lambda: replace(CORE, threads=1))
    """Settings of the rod core."""


@dataclass(frozen=True, eq=False)
class CoaxialCourse:
    """Controls of wire and catheter, and where they bring both.

    Attributes:
        control: mm/s and rad/s of wire and catheter, of each decision period.
        proximal: inserted length (mm) and rotation (rad) of both at the end of each period.
        abscissa: Δtip of the wire at the end of each period, mm.
        off_route: how far the wire's tip is in a wrong branch then, mm.
        settled: whether a waypoint is passed then, and the catheter has followed.
        peak_n: largest wall force on a node, N.
        reached: whether it ends at the target.
    """

    control: Float[np.ndarray, "periods 2 2"]
    proximal: Float[np.ndarray, "periods 2 2"]
    abscissa: Float[np.ndarray, "periods"]
    off_route: Float[np.ndarray, "periods"]
    settled: Bool[np.ndarray, "periods"]
    peak_n: float
    reached: bool


@dataclass(frozen=True, eq=False)
class Kept:
    """Where a course was: the state of its simulator, the largest force so far, N, and its periods."""

    state: SimulatorState
    peak: Float[np.ndarray, "1"]
    periods: int


class Copies:
    """Copies of wire and catheter that are driven side by side, and what they have done.

    Attributes:
        simulator: their worlds.
        most_n: force on the wall that is too hard, N.
        made: controls of each period, `proximal` and `tip` what they led to.
        peak: largest wall force on a node of each, N.
        failed: which have left the route, pressed too hard or folded; they stand still.
        farthest: how far along the route each wire came in the last push, mm.
    """

    def __init__(
        self, navigation: Navigation, route: Route, config: CoaxialSearchConfig, worlds: int, like: Simulator | None
    ):
        self.simulator = Simulator(
            navigation.anatomy,
            navigation.stack,
            worlds=worlds,
            motion=navigation.known_motion,
            config=config.core,
            sharing=like,
        )
        self.route, self.most_n = route, SPARE_SHARE * navigation.force_limit_n
        limits = [DriveLimits.of(device, navigation.anatomy) for device in navigation.devices]
        deepest = limits[0].travel_mm[1] - SPARE_MM / 10
        self._limits = [replace(each, travel_mm=(0.0, deepest)) for each in limits]
        self.begin()

    def begin(self) -> None:
        """Forget what they have done."""
        self.made: list[np.ndarray] = []
        self.proximal: list[np.ndarray] = []
        self.tip: list[tuple[np.ndarray, np.ndarray]] = []
        self.peak = np.zeros(self.simulator.worlds)
        self.failed = np.zeros(self.simulator.worlds, dtype=bool)
        self.farthest = np.zeros(self.simulator.worlds)

    @property
    def wire(self) -> Float[np.ndarray, "worlds"]:
        """Inserted lengths of the wires, mm."""
        return self.simulator.inserted_length[:, 0]

    @property
    def catheter(self) -> Float[np.ndarray, "worlds"]:
        """Inserted lengths of the catheters, mm."""
        return self.simulator.inserted_length[:, 1]

    def foremost(self) -> TipProjection:
        """Return the foremost tips, those of the wires or of the catheters."""
        worlds = np.arange(self.simulator.worlds)
        return self.simulator.project()[worlds, np.where(self.wire >= self.catheter, 0, 1)]

    def drive(self, wire: np.ndarray | float, catheter: np.ndarray | float, turn: np.ndarray | float = 0.0) -> None:
        """Drive them for a decision period, wire and catheter at mm/s, both turned at rad/s."""
        simulator = self.simulator
        control = np.zeros((simulator.worlds, 2, 2))
        control[:, 0, 0], control[:, 1, 0] = wire, catheter
        control[:, 0, 1] = control[:, 1, 1] = turn
        control[self.failed] = 0.0
        for k, inserted in enumerate((self.wire, self.catheter)):
            control[:, k] = self._limits[k].clip(control[:, k], inserted, DECISION_PERIOD_S)
        step = drive_period(simulator, control)
        self.peak = np.maximum(self.peak, np.where(step.valid, step.contact_force_max, np.inf))
        tip = simulator.project()[:, 0]
        off = self.route.off_route(tip)
        self.made.append(control)
        self.proximal.append(simulator.proximal)
        self.tip.append((tip.abscissa, off))
        self.failed |= self.peak > self.most_n
