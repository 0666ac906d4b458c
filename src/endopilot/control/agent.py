"""The policies that plan in the rod core: `TwinPolicy`, which is given the true parameters, and `AgentPolicy`.

Both search a path from the believed state of the wire, and follow it by the encoders. Between exposures the simulated
wires alone give the tip. An exposure weights these wires, and shows where none of them is right: then the real wire is
pulled back, with X-ray on, until one agrees with the image, and another path is searched from there.
"""

from __future__ import annotations

import time
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float

from endopilot.belief.adviser import AdviserConfig, XrayAdviser
from endopilot.belief.bands import Calibration
from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.course import Course
from endopilot.control.halt import SPARE_SHARE
from endopilot.control.route import Route, check_passable
from endopilot.control.search import Search, SearchConfig
from endopilot.navigation.policy import BelievedTip, Decision, Observation
from endopilot.progress import Advance
from endopilot.settings import Positive, Within, settings
from endopilot.simulation.mismatch import ModelMismatch
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, XrayKind, check_wire_alone
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement

CALIBRATED = Path(__file__).parent
"""Where the calibration of the agent's ensemble lies."""
CALIBRATIONS: dict[XrayKind, Path] = {"assumed": CALIBRATED, "images": CALIBRATED / "images"}
"""The same by how its exposures find the tip."""
AdviserInput = tuple[
    Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1"]
]
"""What an adviser is given of a navigation: (Δ, φ), mm and rad; (Δtip, γtip), mm; the spread (standard deviation) of
these as the model states it, mm; and the lumen's radius at the tip, mm."""


@settings
class AgentConfig:
    """Settings of an agent: search, belief, and when the plan or the wire counts as lost."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """The search for a path."""
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    """The simulated wires."""
    off_course_mm: Positive = 2.5
    """Another path is searched when the likeliest tip is this far along the centerline from where it should be, mm."""
    tries: Annotated[int, Within(1, 100)] = 3
    """Failed searches, one after another and each from where the last has led, after which the agent gives up."""
    lost_along_mm: Positive = 4.0
    """A measured tip this far along the wire from all simulated ones is explained by none, mm."""
    lost_across_mm: Positive = 1.5
    """The same across the wire, mm."""


SURE_SDS = 3.0
"""A measured tip is taken for another than the simulated ones beyond this many of its own standard deviations."""
_TURNS = (0.0, np.pi)
"""Angles by which the wire may be turned before it goes in, rad."""
_CREEP_MM_S = 2.0
"""Fastest translation of a wire that should have arrived, and that X-ray shows beside its target, mm/s."""


class _PlanningPolicy:
    """What both policies share.

    Attributes:
        plans: how often a course was searched.
        planning_s: processor time that the searches took, s.
        halt: where and why the last search ended before the target, in words; empty if it arrived.
    """

    def __init__(self, config: AgentConfig | None = None) -> None:
        """Take the settings.

        Args:
            config: search and belief.
        """
        self.config = config or AgentConfig()

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        """Return friction factor, tip stiffness factor and depth of the ostium (mm) of the simulated wires."""
        raise NotImplementedError

    def wants_xray(self) -> bool:
        """Return whether X-ray is to be on at the next decision."""
        raise NotImplementedError

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires, around the navigation's device and ostium.

        Raises:
            InputError: the lumen is narrower than the wire on the route, or there are catheters.
        """
        check_wire_alone(navigation, "policy: it")
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
        self._course: Course | None = None
        self._at, self._lost, self._began, self._led, self._arrived = 0, False, False, False, False
        self.plans, self.planning_s, self._failed, self.halt = 0, 0.0, 0, ""

    def decide(self, observation: Observation) -> Decision:
        """Follow the course, search another one, or pull back, as the module describes."""
        if self._began:
            self.belief.follow(*observation.devices[0])
        self._began = True
        if observation.tip is not None:
            self._update(observation.tip)
        elif observation.devices[0][0] <= self.navigation.start_inserted_mm:
            self._lost = False  # back where it began, the wire lies as it did, unseen in its catheter
        if self._lost:
            translation, rotation = -self.config.search.speed_mm_s, 0.0
        else:
            translation, rotation = self._follow(observation)
        gives_up = self.halt if self._failed >= self.config.tries and self._course is None and not self._lost else ""
        return Decision(((translation, rotation),), expose=self._lost or self.wants_xray(), gives_up=gives_up)

    def watch(self, observation: Observation) -> None:
        """Follow what somebody else does; a new course is searched at the next decision."""
        if self._began:
            self.belief.follow(*observation.devices[0])
        self._began, self._led, self._course, self._failed = True, True, None, 0
        if observation.tip is not None:
            self._update(observation.tip)
        self.wants_xray()

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip."""
        tip = self.belief.likeliest_tip()
        return BelievedTip(float(tip.abscissa[0]), float(tip.offset[0]))

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the simulated wires, the likeliest first: nodes from the tip on, LPS mm."""
        return self.belief.simulator.position[np.argsort(-self.belief.weight, kind="stable")]

    def _update(self, measured: TipMeasurement) -> None:
        """Weight the simulated wires by a measurement, and note whether all are wrong."""
        self.belief.weigh(measured)
        errors = self.belief.errors(measured)[int(np.argmax(self.belief.weight))]
        explained = [self.config.lost_along_mm, self.config.lost_across_mm]
        lost = bool((errors > np.maximum(explained, SURE_SDS * np.array(measured.sd_mm))).any())
        if lost or self._lost:
            self._course = None
        self._lost = lost

    def _follow(self, observation: Observation) -> tuple[float, float]:
        """Return the velocities that lead to the next place of the course."""
        if self._course is None or self._at >= len(self._course.control) or self._off_course():
            self._plan(observation)
        self._arrived = self._course is not None and self._course.reached > 0.5 and not len(self._course.control)
        if self._arrived and observation.tip is not None:  # no wire says what is wrong; the image does
            left = (self.navigation.target.abscissa - observation.tip.abscissa) / DECISION_PERIOD_S
            return float(np.clip(left, -_CREEP_MM_S, _CREEP_MM_S)), 0.0
        if self._course is None or self._at >= len(self._course.control):
            return 0.0, 0.0
        wanted = self._course.inserted[self._at] - self._ostium, self._course.rotation[self._at]
        self._at += 1
        inserted, turned = observation.devices[0]
        return (wanted[0] - inserted) / DECISION_PERIOD_S, (wanted[1] - turned) / DECISION_PERIOD_S

    def _off_course(self) -> bool:
        """Return whether the likeliest tip is not where the course has it now."""
        if self._course is None or self._at == 0:
            return False
        tip = self.belief.likeliest_tip()
        left = self.route.off_route(tip)[0] > 0 and np.all(self.route.off_route(self._planned_tip()) == 0)
        error = np.abs(self._course.abscissa[self._at - 1] - tip.abscissa[0]).min()
        return bool(left or error > self.config.off_course_mm)

    def _planned_tip(self) -> TipProjection:
        """Return where the course has the tips of its wires now."""
        course, at = self._course, self._at - 1
        assert course is not None
        return TipProjection(
            abscissa=course.abscissa[at], offset=course.offset[at], branch=course.branch[at], radius=course.radius[at]
        )

    def find_course(self, seconds: float, advance: Advance | None = None) -> Course:
        """Search a path from where the likeliest wires are.

        In a tortuous vessel forces depend on the side that the bent tip looks to as the wire goes in. So where the
        first course presses hard, or none is found though no fork refuses, others are searched with the wire turned.

        Args:
            seconds: time that is left, s.
            advance: called with every millimetre along the route.
        """
        source, weight = self.belief.likeliest()
        self._ostium = float(self.belief.parameters[source[0], 2])
        gentle_n = SPARE_SHARE * self.navigation.force_limit_n
        best: Course | None = None
        for turn in _TURNS if self.plans <= 1 else _TURNS[:1]:
            course = self._search.find(
                self.belief.simulator, source, weight, seconds=seconds, turn=turn, advance=advance
            )
            if best is None or _merit(course) > _merit(best):
                best, self.halt = course, self._search.halt
            if (course.reached > 0.5 and course.force.max(initial=0.0) <= gentle_n) or self._search.at_fork:
                break
        assert best is not None
        return best

    def _plan(self, observation: Observation) -> None:
        seconds = self.navigation.seconds - observation.time_s
        if self._failed >= self.config.tries:
            self._course = None
            return
        self._at, self.plans, worked = 0, self.plans + 1, time.process_time()
        self._course = self.find_course(seconds) if seconds >= DECISION_PERIOD_S else None
        self.planning_s += time.process_time() - worked
        self._failed = self._failed + 1 if self._course is not None and self._course.reached < 0.5 else 0


def _merit(course: Course) -> tuple[bool, float]:
    """Return how good a course is: whether it arrives, and how gently, or how far it comes."""
    arrives = course.reached > 0.5
    if arrives or not len(course.force):
        return arrives, -float(course.force.max(initial=0.0)) if arrives else 0.0
    return False, float(course.abscissa[-1].mean())


class TwinPolicy(_PlanningPolicy):
    """Plans in the rod core with the true parameters, X-ray always on: the upper bound of what a model can do."""

    def __init__(self, truth: ModelMismatch | None = None, config: AgentConfig | None = None) -> None:
        """Take the true parameters.

        Args:
            truth: how reality differs from the navigation; not at all if not given.
            config: search and belief.
        """
        super().__init__(config)
        self._truth = truth or ModelMismatch()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wire in the vessel as it truly is, its catheter among it."""
        super().start(replace(navigation, anatomy=self._truth.anatomy(navigation.anatomy)), seed)

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        truth = self._truth
        return np.array([[truth.friction_factor, truth.stiffness_factor, truth.ostium_mm]])

    def wants_xray(self) -> bool:
        """X-ray is always on."""
        return True


class OpenLoopPolicy(TwinPolicy):
    """Plans once with the given parameters, and follows the plan by the encoders without X-ray."""

    def _update(self, measured: TipMeasurement) -> None:
        """Ignore the first exposure."""

    def wants_xray(self) -> bool:
        """X-ray stays off."""
        return False


class AgentPolicy(_PlanningPolicy):
    """Plans in an ensemble of rod cores, weighted by X-ray, which is on only when the adviser asks for it."""

    def __init__(
        self,
        config: AgentConfig | None = None,
        *,
        calibration: Calibration | None = None,
        advice: AdviserConfig | None = None,
    ) -> None:
        """Take the settings.

        Args:
            config: search and belief.
            calibration: of the bands around what the simulated wires predict, by which `XrayAdviser` asks for
                X-ray; if not given, the package's own for the navigation's X-ray, which
                `python -m benchmarks agent-calibration` makes.
            advice: which events the adviser watches for.
        """
        super().__init__(config)
        self._given, self._advice = calibration, advice or AdviserConfig()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires, and start the adviser."""
        super().start(navigation, seed)
        self._calibration = self._given or Calibration.read(CALIBRATIONS[navigation.xray])
        self._adviser = XrayAdviser(self._calibration, self._advice, navigation.device.tip_radius_mm)
        self._due = False
        self._start_adviser()

    def _start_adviser(self) -> None:
        proximal, tip, _, radius = self.adviser_input()
        self._adviser.start(proximal, tip, radius)

    def _update(self, measured: TipMeasurement) -> None:
        """Weight the wires; an exposure that somebody else made begins the bands anew."""
        super()._update(measured)
        if self._led:
            self._start_adviser()
            self._led = False

    def _parameters(self) -> Float[np.ndarray, "members 3"]:
        return Belief.around(np.array([1.0, 1.0, 0.0]), self.config.belief)

    def adviser_input(self) -> AdviserInput:
        """Return what the adviser is given: the likeliest wire, and the spread of all wires."""
        best, tip = int(np.argmax(self.belief.weight)), self.belief.likeliest_tip()
        wires = self.belief.simulator
        proximal = wires.proximal[best, :1]
        return proximal, np.array([[tip.abscissa[0], tip.offset[0]]]), self.belief.tip_spread()[None], tip.radius

    def wants_xray(self) -> bool:
        """Ask the adviser; a wire that should have arrived is looked at."""
        self._due = bool(self._adviser.advise(*self.adviser_input())[0]) or self._arrived
        return self._due

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip, the adviser's bands around it, and why it asks for X-ray."""
        tip, half = super().believed(), self._adviser.half_width
        if self._lost or len(half) == 0:
            return replace(tip, asks="no simulated wire explains the last image" if self._lost else "")
        along, across = half[0].tolist()
        wide = along >= self._advice.abscissa_mm
        asks = f"Δtip is known to ±{along:.1f} mm only" if wide else "the tip may be reaching the wall"
        asks = "the tip should be at the target" if self._arrived else asks
        return replace(tip, half_width=(along, across), asks=asks if self._due else "")
