"""The policies that plan in the rod core: `TwinPolicy`, which is told the truth, and `AgentPolicy`, which finds it out.

Both search a way from where they believe the wire to be, and follow it by the encoders. Between exposures only their
simulated wires speak. An exposure weighs these, and shows where none of them is right: then the wire is pulled back,
with X-ray on, until one agrees with what is seen, and another way is searched from there.
"""

from __future__ import annotations

from dataclasses import field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.control.belief import Belief, BeliefConfig
from endopilot.control.navigate import ModelMismatch
from endopilot.control.policy import Decision, Observation
from endopilot.control.route import Route, check_passable
from endopilot.control.search import Course, Search, SearchConfig
from endopilot.progress import Advance
from endopilot.settings import Count, Positive, settings
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection
from endopilot.xray.adviser import AdviserConfig, XrayAdviser
from endopilot.xray.bands import Calibration
from endopilot.xray.fluoroscope import TipMeasurement

CALIBRATED = Path(__file__).parent
"""Where the calibration of the agent's ensemble lies."""
AdviserInput = tuple[
    Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1"]
]
"""What an adviser is told of a navigation: (Δ, φ), mm and rad; (Δtip, γtip), mm; the spread (standard deviation) of
these by the model's own account, mm; and the lumen's radius at the tip, mm."""


@settings
class AgentConfig:
    """How an agent searches, believes and looks."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """The search for a way."""
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    """The simulated wires."""
    off_course_mm: Positive = 2.5
    """Another way is searched when the likeliest tip is this far along the centerline from where it should be, mm."""
    tries: Count = 8
    """Searches in vain, one after another, before the wire is left where it is."""
    lost_along_mm: Positive = 4.0
    """A measured tip this far along the wire from all simulated ones is explained by none, mm."""
    lost_across_mm: Positive = 1.5
    """The same across the wire, mm."""


class _PlanningPolicy:
    """What both policies share."""

    def __init__(self, config: AgentConfig | None = None) -> None:
        """Take the settings.

        Args:
            config: how to search, believe and look.
        """
        self.config = config or AgentConfig()

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        """Return friction factor, tip stiffness factor and depth of the ostium (mm) of the simulated wires."""
        raise NotImplementedError

    def wants_xray(self) -> bool:
        """Return whether the tip is to be looked at at the next decision."""
        raise NotImplementedError

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay the simulated wires out. What is believed of reality is the navigation's device and ostium.

        Raises:
            InputError: the lumen is narrower than the wire on the route.
        """
        self.navigation = navigation
        self.route = Route.to(navigation.anatomy, navigation.target)
        check_passable(self.route, navigation.device)
        self.belief = Belief(navigation, self._parameters(), self.config.belief)
        self._search = Search(
            navigation,
            self.route,
            list(self.belief.wires.values()),
            config=self.config.search,
            seed=seed,
            sharing=self.belief.simulator,
        )
        self._limits = DriveLimits.of(navigation.device, navigation.anatomy)
        self._course: Course | None = None
        self._at, self._lost, self._began = 0, False, False
        self.plans, self._vain = 0, 0

    def decide(self, observation: Observation) -> Decision:
        """Follow the course, search another one, or pull back; see the module."""
        if self._began:
            self.belief.follow(observation.inserted_length, observation.rotation)
        self._began = True
        if observation.tip is not None:
            self._look(observation.tip)
        if self._lost:
            translation, rotation = -self.config.search.speed_mm_s, 0.0
        else:
            translation, rotation = self._follow(observation)
        translation, rotation = self._limits.safe(translation, rotation)
        return Decision(translation, rotation, expose=self._lost or self.wants_xray())

    def _look(self, measured: TipMeasurement) -> None:
        """Let a measurement tell which wires are likely, and whether all are wrong."""
        self.belief.weigh(measured)
        along, across = self.belief.misses(measured)[int(np.argmax(self.belief.weight))]
        lost = bool(along > self.config.lost_along_mm or across > self.config.lost_across_mm)
        if lost or self._lost:
            self._course = None
        self._lost = lost

    def _follow(self, observation: Observation) -> tuple[float, float]:
        """Return the velocities that lead to the next place of the course."""
        if self._course is None or self._at >= len(self._course.control) or self._off_course():
            self._plan(observation)
        if self._course is None or self._at >= len(self._course.control):
            return 0.0, 0.0
        wanted = self._course.inserted[self._at] - self._ostium, self._course.rotation[self._at]
        self._at += 1
        return (
            (wanted[0] - observation.inserted_length) / DECISION_PERIOD_S,
            (wanted[1] - observation.rotation) / DECISION_PERIOD_S,
        )

    def _off_course(self) -> bool:
        """Return whether the likeliest tip is not where the course has it now."""
        if self._course is None or self._at == 0:
            return False
        tip = self.belief.likeliest_tip()
        strayed = self.route.astray(tip)[0] > 0 and np.all(self.route.astray(self._planned_tip()) == 0)
        off = np.abs(self._course.abscissa[self._at - 1] - tip.abscissa[0]).min()
        return bool(strayed or off > self.config.off_course_mm)

    def _planned_tip(self) -> TipProjection:
        """Return where the course has the tips of its wires now."""
        course, at = self._course, self._at - 1
        assert course is not None
        return TipProjection(
            abscissa=course.abscissa[at], offset=course.offset[at], branch=course.branch[at], radius=course.radius[at]
        )

    def find_course(self, seconds: float, advance: Advance | None = None) -> Course:
        """Search a way from where the likeliest wires are.

        Args:
            seconds: time that is left, s.
            advance: told of every millimetre along the route.
        """
        source, weight = self.belief.likeliest()
        self._ostium = float(self.belief.parameters[source[0], 2])
        return self._search.find(self.belief.simulator, source, weight, seconds=seconds, advance=advance)

    def _plan(self, observation: Observation) -> None:
        seconds = self.navigation.seconds - observation.time_s
        if self._vain >= self.config.tries:
            self._course = None
            return
        self._at, self.plans = 0, self.plans + 1
        self._course = self.find_course(seconds) if seconds >= DECISION_PERIOD_S else None
        self._vain = self._vain + 1 if self._course is not None and self._course.reached < 0.5 else 0


class TwinPolicy(_PlanningPolicy):
    """Plans in the rod core with the true parameters, X-ray always on: the upper bound of what a model can do."""

    def __init__(self, truth: ModelMismatch | None = None, config: AgentConfig | None = None) -> None:
        """Take the truth.

        Args:
            truth: how reality differs from the navigation; not at all if not given.
            config: how to search, believe and look.
        """
        super().__init__(config)
        self._truth = truth or ModelMismatch()

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        truth = self._truth
        return np.array([[truth.friction_factor, truth.stiffness_factor, truth.ostium_mm]])

    def wants_xray(self) -> bool:
        """X-ray is always on."""
        return True


class OpenLoopPolicy(TwinPolicy):
    """Plans once, with what it is told, and follows the plan by the encoders: what is planned is replayed, unseen."""

    def _look(self, measured: TipMeasurement) -> None:
        """Learn nothing from the first exposure."""

    def wants_xray(self) -> bool:
        """X-ray stays off."""
        return False


class AgentPolicy(_PlanningPolicy):
    """Plans in an ensemble of rod cores that it weighs by what it sees, and looks only when its adviser asks."""

    def __init__(
        self,
        config: AgentConfig | None = None,
        *,
        calibration: Calibration | None = None,
        advice: AdviserConfig | None = None,
    ) -> None:
        """Take the settings.

        Args:
            config: how to search, believe and look.
            calibration: of the bands around what the simulated wires foretell, by which `XrayAdviser` asks for X-ray;
                the package's own, which `benchmarks/agent_calibration.py` makes, if not given.
            advice: what the adviser must not miss.
        """
        super().__init__(config)
        self._calibration, self._advice = calibration or Calibration.read(CALIBRATED), advice or AdviserConfig()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay the simulated wires out, and begin to watch the bands."""
        super().start(navigation, seed)
        self._adviser = XrayAdviser(self._calibration, self._advice, navigation.device.tip_radius_mm)
        proximal, tip, _, radius = self.foretold()
        self._adviser.start(proximal, tip, radius)

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        return Belief.around(np.array([1.0, 1.0, 0.0]), self.config.belief)

    def foretold(self) -> AdviserInput:
        """Return what the adviser is told, of the likeliest wire; the spread is that of all wires."""
        best, tip = int(np.argmax(self.belief.weight)), self.belief.likeliest_tip()
        wires = self.belief.simulator
        proximal = np.array([[wires.inserted_length[best], wires.rotation[best]]])
        return proximal, np.array([[tip.abscissa[0], tip.offset[0]]]), self.belief.tip_spread()[None], tip.radius

    def wants_xray(self) -> bool:
        """Ask the adviser."""
        return bool(self._adviser.advise(*self.foretold())[0])
