"""The policies that plan in the rod core: `AgentPolicy`, and `OraclePolicy`, which is given the true parameters.

Both search a course from the believed state of the wire and its catheter, and follow it by the encoders. Between
exposures the simulated wires alone give the tip. An exposure weights these wires, and shows where none of them is
right: then the real wire is pulled back, with X-ray on, until one agrees with the image, and another course is searched
from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from endopilot.belief.bands import AdviserConfig, Calibration
from endopilot.belief.monitor import BelievedTip, Monitor
from endopilot.belief.states import State
from endopilot.belief.thought import Budget, Thought
from endopilot.control.agent_config import AgentConfig, read_agent_calibration
from endopilot.control.course import Course, Follower
from endopilot.control.search import Search
from endopilot.devices.stack import Proximals
from endopilot.errors import InputError
from endopilot.navigation.policy import Decision, Observation
from endopilot.progress import Advance
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import NEAR_MM, Route, check_passable
from endopilot.xray.fluoroscope import TipMeasurement

_WIRE_CREEP_MM_S = 2.0
"""Fastest translation of a wire that should have arrived, and that X-ray shows beside its target, mm/s."""
_CLEAR_MM = 4.0
"""A wire that is lost is pulled back by this much at least before it is looked at again, mm."""
_OUT_MM = 0.5
"""A wire that is inserted no deeper is out, but for the noise of encoders; X-ray shows none then that is believed."""
_HARDER = 1.1
"""Another course is searched where the drive pushes this many times harder than the last one was searched for."""
_CREEP_MM_S, _CREEP_PERIODS = 1.0, 6
"""A catheter, which X-ray does not show, is moved ahead and back by this where it should have arrived, for as many
periods and twice."""


class _PlanningPolicy:
    """What the policies share.

    Attributes:
        plans: how often a course was searched.
        planning_s: time that the searches took which have ended, s, less that in which they waited.
    """

    def __init__(self, config: AgentConfig | None = None) -> None:
        """Take search and belief; if not given, those for the navigation's devices."""
        self._given_config = config

    def _monitored(self) -> Monitor:
        """Return the monitor at the start of the navigation."""
        raise NotImplementedError

    def wants_xray(self) -> bool:
        """Return whether X-ray is to be on at the next decision."""
        raise NotImplementedError

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires, around the navigation's devices and ostium.

        Raises:
            InputError: the lumen is narrower than a device on the route, or there are two catheters.
        """
        self.navigation, self.config = navigation, self._given_config or AgentConfig.of(navigation)
        self.route = Route.to(navigation.anatomy, navigation.target)
        if self.config.search.together:
            self.route = self.route.beyond_carinas()
        for device in navigation.devices:
            check_passable(self.route, device)
        if len(navigation.catheters) > 1:
            raise InputError(f"catheter: {len(navigation.catheters)}; the search drives one: give one")
        self.monitor, self._seed = self._monitored(), seed
        self.belief, self._believed = self.monitor.belief, BelievedTip(np.nan, np.nan)
        self._back_mm, self._arrived, self._shows = np.inf, False, False
        self._crept = self.plans = 0
        self.planning_s, self._thought = 0.0, None
        self._set_out()

    def decide(self, observation: Observation) -> Decision:
        """Follow the course, search another one, or pull back, as the module describes."""
        self._observe(observation)
        self._shows, lost = False, self.monitor.lost
        wanted = self._pull_back() if lost else self._go_on(observation)
        self.belief.drives.sent(wanted)
        ends = self._failed >= self.config.tries and self._follower.course is None and not lost
        expose = not self.monitor.rests and (self._back_far_enough() if lost else self.wants_xray())
        return Decision(wanted, expose=expose, gives_up=self.halt if ends else "")

    def watch(self, observation: Observation) -> None:
        """Follow what somebody else does; a new course is searched at the next decision."""
        self._forget()
        self._failed = 0
        self._observe(observation)

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip."""
        return self._believed

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the simulated wires, the likeliest first: nodes from the foremost tip on, LPS mm."""
        return self.belief.wires

    def find_course(self, seconds: float, advance: Advance | None = None, *, horizon_mm: float = np.inf) -> Course:
        """Search a course from where the likeliest devices are; the arguments are those of `Search.find`."""
        return self._search.find(self.belief, seconds=seconds, horizon_mm=horizon_mm, advance=advance)

    @property
    def halt(self) -> str:
        """Where and why the last search ended before the target, in words; empty if it arrived."""
        return self._search.halt

    def _set_out(self) -> None:
        """Follow and search with what is believed. Walls press as much harder as the drive is felt to push."""
        self._harder, given = self.monitor.load_ratio, self.belief.navigation
        navigation = replace(given, force_limit_n=given.force_limit_n / self._harder)
        config = self.config
        budget = Budget(config.planning_s or np.inf, config.evaluations)
        search, seed = config.search, self._seed
        self._search = Search(navigation, self.route, self.belief, config=search, seed=seed, budget=budget)
        devices, turn_rad_s = len(self.navigation.devices), search.turn_rad_s
        self._follower = Follower(self.belief.drives, devices=devices, turn_rad_s=turn_rad_s)
        self._failed = 0

    def _begin_anew(self) -> None:
        """Forget course and failed searches: what they were made with is no longer believed."""
        self._forget()
        self._set_out()

    def _observe(self, observation: Observation) -> None:
        monitor, before = self.monitor, self.monitor.lost
        self._believed = monitor.step(observation.devices, observation.load, self._shown(observation))
        if self.belief is not monitor.belief:  # another wire, lumen or ostium: another course
            self.belief = monitor.belief
            self._begin_anew()
        self._limit_load()
        if monitor.sought or (monitor.seen is not None and (before or monitor.lost)):
            self._forget()  # they lie otherwise than the course was searched for
        if monitor.seen is not None:
            self._back_mm = self.belief.drives.proximal[0, 0] - self._way_back(monitor.seen)

    def _shown(self, observation: Observation) -> TipMeasurement | None:
        """Return what the belief is weighed by."""
        return observation.tip

    def _limit_load(self) -> None:
        """Search another course where the drive pushes so hard that the wall would press with more than is safe."""
        course, ratio = self._follower.course, self.monitor.load_ratio
        if course is None or ratio < _HARDER * self._harder:
            return
        if course.force[self._follower.at :].max(initial=0.0) * ratio > self.navigation.force_limit_n:
            self._begin_anew()

    def _way_back(self, measured: TipMeasurement) -> float:
        """Return how far a wire that is lost is pulled back before it is looked at again, mm.

        That is out of the branch that its tip is in and none of the likeliest wire is, a little at least. Without play
        it is looked at all the time.
        """
        tree, tip = self.navigation.anatomy.tree, self.belief.likeliest_tip()
        if not self.belief.drives.lose:
            return -np.inf
        leaves = min(
            tree.departures(int(tip.branch[0]))[measured.branch], tree.departures(measured.branch)[tip.branch[0]]
        )
        return max(measured.abscissa - leaves + _CLEAR_MM, _CLEAR_MM)

    def _back_far_enough(self) -> bool:
        """Return whether a wire that is lost is to be looked at when it is pulled back for another period."""
        drives = self.belief.drives
        return bool(drives.proximal[0, 0] - self.config.search.speed_mm_s * DECISION_PERIOD_S <= self._back_mm)

    def _pull_back(self) -> Proximals:
        """Return the velocities that pull the wire back, and each catheter that the wire's tip is in.

        Soft devices fall back by themselves if only one of them is pulled, so both are. They rest first, as long as
        other simulated ones are sought that explain the image.
        """
        config, inserted = self.config.search, self.belief.drives.proximal[:, 0].tolist()
        if self.monitor.states.now is State.SEEKING:
            return self._follower.move([0.0 for _ in inserted])
        pulled = [config.together or inserted[0] <= each for each in inserted]
        return self._follower.move([-config.speed_mm_s if each else 0.0 for each in pulled])

    def _go_on(self, observation: Observation) -> Proximals:
        """Return the velocities that lead to the next place of the course."""
        arriving, follower = self.navigation.arriving, self._follower
        over = follower.ended and self._thought is None and not (follower.reached and arriving)
        if self._off_course() or over:
            self._plan(observation)
        if self._thought is not None:
            self._think(self._thought)
        self._arrived = self._follower.reached and self._follower.ended
        if self._arrived and arriving:
            return self._creep()
        if self._arrived and self.monitor.seen is not None:  # no wire says what is wrong; the image does
            along_mm = self.navigation.target.abscissa - self.monitor.seen.abscissa
            if self.navigation.target.near_mm and abs(along_mm) <= NEAR_MM:  # beside the target: another course
                self._forget()
            left = along_mm / DECISION_PERIOD_S
            return self._follower.move([float(np.clip(left, -_WIRE_CREEP_MM_S, _WIRE_CREEP_MM_S))])
        if self._follower.ended:
            self._shows = self._thought is None and not self._search.draws  # another look, before another search
            return ((0.0, 0.0),)
        wanted = self._follower.step()
        self._shows = self._follower.shows
        return wanted

    def _creep(self) -> Proximals:
        """Return the velocity of a catheter that should have arrived: a little ahead and back; then search again."""
        step, self._crept = self._crept, self._crept + 1
        if step >= 3 * _CREEP_PERIODS:
            self._forget()
        speed = _CREEP_MM_S if step < _CREEP_PERIODS else -_CREEP_MM_S
        return self._follower.move([*[0.0] * self.navigation.arriving, speed])

    def _off_course(self) -> bool:
        """Return whether the likeliest tip is not where the course has it now."""
        course, at = self._follower.course, self._follower.at - 1
        if course is None or at < 0 or not course.checked[at]:
            return False
        tip, planned = self.belief.likeliest_tip(), course.tip[at]
        allowed_mm = float(self.route.off_route(planned).max())
        if allowed_mm > 0 and not course.exposed[at]:
            allowed_mm = np.inf  # within a manoeuvre a tip may lie in the mouth of another branch
        error = np.abs(planned.abscissa - tip.abscissa[0]).min()
        return bool(self.route.off_route(tip)[0] > allowed_mm or error > self.config.off_course_mm)

    def _plan(self, observation: Observation) -> None:
        """Begin to search a course, unless too many searches failed or no time is left."""
        self._forget()
        seconds = self.navigation.seconds - observation.time_s
        if self._failed >= self.config.tries or seconds < DECISION_PERIOD_S:
            return
        self._crept, self.plans = 0, self.plans + 1
        self._search.set_out(self.belief, seconds=seconds, horizon_mm=self.config.horizon_mm or np.inf)
        self._thought = Thought(self._search.go_on, self._search.budget, self.config.pace)

    def _think(self, thought: Thought[Course]) -> None:
        """Let the search go on for a decision, and follow what it has found."""
        thought.wait()
        course = thought.found
        if course is not None:
            self._follower.extend(course)
        if thought.busy:
            return
        self._thought, self.planning_s = None, self.planning_s + self._search.budget.worked_s
        if not self.halt:
            self._failed = 0
        elif not (self._search.budget.over and course is not None and len(course.control)):  # that came on in its time
            self._failed += 1

    def _forget(self) -> None:
        """Follow no course, and search none."""
        if self._thought is not None:
            self._thought.stop()
            self._thought, self.planning_s = None, self.planning_s + self._search.budget.worked_s
        self._follower.begin(None)


class OraclePolicy(_PlanningPolicy):
    """Plans in the rod core with the true parameters, X-ray always on: the upper bound of what a model can do."""

    def __init__(self, world: World | None = None, config: AgentConfig | None = None) -> None:
        """Take the true parameters: reality, of which wire, catheters, vessel and ostium are simulated; as the
        navigation says if not given.
        """
        super().__init__(config)
        self._world = world or World()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated devices as they truly are, in the vessel as it truly is, its catheter among it."""
        world = self._world
        stack, anatomy = world.stack(navigation.stack), world.anatomy(navigation.anatomy)
        super().start(replace(navigation, anatomy=anatomy, device=stack.wire, catheters=stack.catheters), seed)

    def _monitored(self) -> Monitor:
        members = [World(ostium_mm=self._world.ostium_mm)]
        return Monitor(self.navigation, None, config=self.config.belief, members=members, pace=self.config.pace)

    def wants_xray(self) -> bool:
        """X-ray is always on."""
        return True


class OpenLoopPolicy(OraclePolicy):
    """Plans once with the given parameters, and follows the plan by the encoders without X-ray."""

    def _shown(self, observation: Observation) -> None:
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
            config: search and belief; if not given, those for the navigation's devices.
            calibration: of the bands around what the simulated wires predict; if not given, the package's own for the
                navigation's X-ray and devices, which `python -m benchmarks agent-calibration` makes.
            advice: which events the adviser watches for.
        """
        super().__init__(config)
        self._given, self._advice = calibration, advice or AdviserConfig()

    def _monitored(self) -> Monitor:
        navigation = self.navigation
        self._calibration = self._given or read_agent_calibration(navigation.xray, len(navigation.devices))
        self._exposures = 1  # a navigation begins with one
        config = self.config
        return Monitor(navigation, self._calibration, config=config.belief, advice=self._advice, pace=config.pace)

    def decide(self, observation: Observation) -> Decision:
        """Follow the course as the module describes; end where belief after belief was lost."""
        decision = super().decide(observation)
        if decision.gives_up and self._harder > 1:
            given = f"{self.navigation.force_limit_n:g} N is given"
            harder = f"the drive pushes {self._harder:.1f} times as hard as simulated wires"
            return replace(decision, gives_up=f"{decision.gives_up}: {given}, and {harder}")
        losses, seen = self.monitor.states.losses, self.monitor.seen
        out = self.belief.drives.proximal[0, 0] <= _OUT_MM and self.monitor.states.now is State.LOST
        lost = losses >= self.config.losses or (out and seen is not None)
        if decision.gives_up or self.monitor.thinks or not lost:
            return self._within_dose(decision)
        at = "" if seen is None else f" at {seen.abscissa:.0f} mm"
        how = "pulled out, the wire is still seen" if out else f"lost {losses} times"
        return replace(decision, gives_up=f"{how}: no wire, lumen or ostium explains what X-ray shows{at}")

    def _within_dose(self, decision: Decision) -> Decision:
        """Return a decision, or one that gives up where it asks for more exposures than the agent may take."""
        self._exposures, most = self._exposures + decision.expose, self.config.most_exposures
        if self._exposures <= most:
            return decision
        return replace(
            decision,
            expose=False,
            gives_up=decision.gives_up or f"{most} exposures did not suffice; AgentConfig.most_exposures allows more",
        )

    def wants_xray(self) -> bool:
        """Ask the monitor; a device that should have arrived, and the end of a manoeuvre, are looked at."""
        return bool(self._believed.asks) or self._arrived or self._shows

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip, the adviser's bands around it, and why it asks for X-ray."""
        asks = self._believed.asks
        if not self.monitor.lost:
            asks = "a manoeuvre is over" if self._shows else asks
            asks = "the tip should be at the target" if self._arrived else asks
        return replace(self._believed, asks=asks)
