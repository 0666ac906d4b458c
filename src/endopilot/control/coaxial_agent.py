"""The policy that plans for a wire in a catheter: `CoaxialAgent`.

It searches a course from the believed state of both and follows it by the encoders. An ensemble of simulated wires in
catheters is driven alike; its spread says when X-ray is asked for, and an exposure weights it. Where the course leaves
what the likeliest wire does, another is searched; where no simulated wire explains the image, the wire is pulled back
until one does.
"""

from __future__ import annotations

import time
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from endopilot.belief.adviser import AdviserConfig, XrayAdviser
from endopilot.belief.bands import Calibration
from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import CALIBRATED, SURE_SDS, AdviserInput
from endopilot.control.coaxial_copies import CoaxialCourse, CoaxialSearchConfig
from endopilot.control.coaxial_search import CoaxialSearch
from endopilot.control.route import check_passable
from endopilot.errors import InputError
from endopilot.navigation.baseline_policies import check_catheter
from endopilot.navigation.policy import BelievedTip, Decision, Observation
from endopilot.settings import Positive, Within, settings
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.xray.fluoroscope import TipMeasurement

COAXIAL_CALIBRATED = CALIBRATED / "coaxial"
"""Where the calibration of the ensemble of wires in catheters lies."""


@settings
class CoaxialAgentConfig:
    """Settings of an agent: search, belief, and when the plan or the wire counts as lost."""

    search: CoaxialSearchConfig = field(default_factory=CoaxialSearchConfig)
    """The search for a course. Its rod core gets the settings of the simulated wires."""
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(members=4, stiffness_levels=1, element_mm=1.25))
    """The simulated wires in catheters."""
    off_course_mm: Positive = 3.0
    """Another course is searched when the likeliest tip is this far from where a passed waypoint should see it, mm."""
    tries: Annotated[int, Within(1, 100)] = 2
    """Failed searches, one after another, after which the agent gives up."""
    lost_along_mm: Positive = 5.0
    """A measured tip this far along the wire from all simulated ones is explained by none, mm."""
    lost_across_radii: Positive = 0.5
    """The same across the wire, in radii of the lumen."""


_RETRACT_MM_S = 5.0
"""Translation of a wire that no simulated one explains, mm/s."""
_CREEP_MM_S, _CREEP_PERIODS = 1.0, 6
"""A catheter that should have arrived and did not is moved ahead and back by this, for as many periods and twice."""


class CoaxialAgent:
    """Plans a course of wire and catheter in the rod core, and follows it with X-ray where its adviser asks.

    Attributes:
        plans: how often a course was searched.
        planning_s: processor time that the searches took, s.
    """

    def __init__(self, config: CoaxialAgentConfig | None = None, *, calibration: Calibration | None = None) -> None:
        """Take the settings.

        Args:
            config: search and belief.
            calibration: of the adviser's bands around what the simulated wires predict; if not given, the package's
                own for wires in catheters, which `python -m benchmarks agent-calibration coaxial` makes.
        """
        self.config = config or CoaxialAgentConfig()
        self._calibration = calibration or Calibration.read(COAXIAL_CALIBRATED)

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires in catheters, and start the adviser.

        Raises:
            InputError: there is no catheter, or more than one, or the lumen is narrower than the wire on the route.
        """
        check_catheter(navigation)
        if len(navigation.catheters) > 1:
            raise InputError(f"policy: drives one catheter, and there are {len(navigation.catheters)}; give one")
        self.navigation = navigation
        self.belief = Belief(
            navigation, Belief.around(np.array([1.0, 1.0, 0.0]), self.config.belief), self.config.belief
        )
        config = replace(self.config.search, core=self.config.belief.core)
        self._search = CoaxialSearch(navigation, config, sharing=self.belief.simulator)
        self.route = self._search.route
        for device in navigation.devices:
            check_passable(self.route, device)
        self._course: CoaxialCourse | None = None
        self._at, self._lost, self._began, self._crept = 0, False, False, 0
        self.plans, self.planning_s, self._failed, self._halt = 0, 0.0, 0, ""
        self._adviser = XrayAdviser(self._calibration, AdviserConfig(), navigation.device.tip_radius_mm)
        proximal, tip, _, radius = self.adviser_input()
        self._adviser.start(proximal, tip, radius)

    def decide(self, observation: Observation) -> Decision:
        """Follow the course, search another one, or pull back, as the module describes."""
        if self._began:
            self.belief.follow(*observation.devices[0], observation.devices[1:])
        self._began = True
        if observation.tip is not None:
            self._update(observation.tip)
        due = self.wants_xray()
        if self._lost:
            return self._pull_back(observation)
        if self._course is None or self._off_course():
            self._plan()
        assert self._course is not None
        if self._at < len(self._course.proximal):
            return self._follow(observation, expose=due)
        if not self._course.reached:
            ends = self._failed >= self.config.tries
            self._course = None
            return Decision(expose=True, gives_up=self._halt if ends else "")
        return self._creep()

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip, and the adviser's bands around it."""
        tip, half = self.belief.likeliest_tip(), self._adviser.half_width
        believed = BelievedTip(float(tip.abscissa[0]), float(tip.offset[0]))
        if self._lost or len(half) == 0:
            return believed
        along, across = half[0].tolist()
        return replace(believed, half_width=(along, across))

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the simulated wires, the likeliest first: nodes from the foremost tip on, LPS mm."""
        return self.belief.simulator.position[np.argsort(-self.belief.weight, kind="stable")]

    def adviser_input(self) -> AdviserInput:
        """Return what the adviser is given: the likeliest wire, and the spread of all wires."""
        tip, wires = self.belief.likeliest_tip(), self.belief.simulator
        proximal = wires.proximal[self._best, :1]
        ends = np.array([[tip.abscissa[0], tip.offset[0]]])
        return proximal, ends, self.belief.tip_spread()[None], tip.radius

    def wants_xray(self) -> bool:
        """Ask the adviser."""
        return bool(self._adviser.advise(*self.adviser_input())[0])

    def _update(self, measured: TipMeasurement) -> None:
        """Weight the simulated wires by a measurement, and note whether all are wrong."""
        self.belief.weigh(measured)
        along_mm = self.config.lost_along_mm
        across_mm = max(self.config.lost_across_radii * float(self.belief.tip.radius[self._best]), along_mm / 2)
        explained = np.maximum([along_mm, across_mm], SURE_SDS * np.array(measured.sd_mm))
        self._lost = bool((self.belief.errors(measured)[self._best] > explained).any())
        if self._lost:
            self._course = None

    @property
    def _best(self) -> int:
        return int(np.argmax(self.belief.weight))

    def _pull_back(self, observation: Observation) -> Decision:
        """Pull the wire back, and the catheter too once the wire's tip is in it, with X-ray on."""
        (wire, _), (catheter, _) = observation.devices
        return Decision(((-_RETRACT_MM_S, 0.0), (-_RETRACT_MM_S if wire <= catheter else 0.0, 0.0)), expose=True)

    def _off_course(self) -> bool:
        """Return whether a waypoint was to be passed just now, and the likeliest wire is not where it should be."""
        course, at = self._course, self._at - 1
        if course is None or at < 0 or not course.settled[at]:
            return False
        tip = self.belief.likeliest_tip()
        error = abs(course.abscissa[at] - tip.abscissa[0])
        return bool(self.route.off_route(tip)[0] > course.off_route[at] + 1e-9 or error > self.config.off_course_mm)

    def _plan(self) -> None:
        """Search a course from where the likeliest wire and catheter are."""
        worked = time.process_time()
        self._at, self._crept, self.plans = 0, 0, self.plans + 1
        self._course = self._search.find(self.belief.simulator, self._best)
        self._ostium = float(self.belief.parameters[self._best, 2])
        halted = self._search.halted_mm
        self._failed = 0 if self._course.reached else self._failed + 1
        self._halt = "" if halted is None else f"no course was found past {halted:.0f} mm of the route"
        self.planning_s += time.process_time() - worked

    def _follow(self, observation: Observation, *, expose: bool) -> Decision:
        """Go to the next place of the course; X-ray shows where each waypoint's end has led."""
        course, at = self._course, self._at
        assert course is not None
        wanted = course.proximal[at] - [self._ostium, 0.0]
        velocity = (wanted - np.array(observation.devices)) / DECISION_PERIOD_S
        self._at += 1
        return Decision(tuple((v, w) for v, w in velocity.tolist()), expose=expose or bool(course.settled[at]))

    def _creep(self) -> Decision:
        """Move what is to arrive a little ahead and back, with X-ray on; then search again."""
        step, self._crept = self._crept, self._crept + 1
        if step >= 3 * _CREEP_PERIODS:
            self._course = None
        speed = _CREEP_MM_S if step < _CREEP_PERIODS else -_CREEP_MM_S
        return Decision((*[(0.0, 0.0)] * self.navigation.arriving, (speed, 0.0)), expose=True)
