"""How a course brings on wire and catheter that move together where time is short: `Together`.

Such devices are often so soft that they lie down in loops, press forward as these unbend, and slide back when they are
pulled. In a narrow lumen the wire goes ahead while its catheter rests: so much less of what is pushed is stiff.
"""

from __future__ import annotations

import numpy as np

from endopilot.control.halt import SPARE_SHARE
from endopilot.control.population import Population
from endopilot.control.push import REST_MM, Halt
from endopilot.control.search_config import SearchConfig
from endopilot.control.trials import CATHETER, WIRE, Kept, Move, Trials
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

_LOOKOUT_MM = 12.0
"""Motions are drawn that lead to a place no farther ahead than this, mm."""
_SLACK_MM, _TAUT_MM, _COMES_MM, _LEAVES_MM = 25.0, 8.0, 3.0, 10.0
"""Devices with more slack than the first of these are pulled back, mm, until they have no more than the second, or the
tip comes along by the third. Where it then slides back by more than the last, they stay as they were."""
_GAIN_MM, _LOOSE_MM = 3.0, 60.0
"""A motion is a step if the devices come this much forward, mm, and then have no more slack than this."""
_COMES_ALONG_MM, _FOLDS_MM = 10.0, 40.0
"""A catheter that comes this much along its wire supports it, mm; it has folded where it is pushed so much farther than
it comes."""
_RETREAT_MM = 10.0, 40.0
"""A wire that is stuck is pulled back by between these two, mm."""


class Together:
    """What the course of a wire and its catheter does where a straight push fails.

    Attributes:
        ahead: whether the wire goes ahead of its catheter now, in a narrow lumen to which its own tip is to go.
        most_periods: decision periods that the course may take.
    """

    def __init__(
        self,
        navigation: Navigation,
        route: Route,
        course: Trials,
        population: Population,
        config: SearchConfig,
        random: np.random.Generator,
    ) -> None:
        """Take a course.

        Args:
            navigation: with the force limit.
            route: to its target.
            course: the devices.
            population: by which motions are drawn.
            config: settings of the search.
            random: what is drawn from.
        """
        self._navigation, self._route, self._course = navigation, route, course
        self._population, self._config, self._random = population, config, random
        self.ahead, self.most_periods = False, 0

    def set_out(self) -> None:
        """Note whether the wire goes ahead from where the devices are."""
        soft = self._config.manoeuvres.together and not self._navigation.arriving
        self.ahead = soft and self.here >= self._route.narrow_from

    @property
    def here(self) -> float:
        """How far along the route the devices have come, mm."""
        return float(self._course.progress(self._route)[0])

    @property
    def slack_mm(self) -> float:
        """How much deeper than that the foremost of them is inserted, mm: what lies in loops."""
        return float(self._course.deepest[0]) - self.here

    @property
    def lead_mm(self) -> float:
        """How much deeper the wire is inserted than its catheter, mm."""
        return float((self._course.inserted(WIRE) - self._course.inserted(CATHETER))[0])

    @property
    def catheter_at(self) -> float:
        """How far along the route the catheter's tip lies, mm."""
        tips = self._course.tips[:, CATHETER]
        return float(self._course.mean(self._route.progress(tips))[0])

    @property
    def left(self) -> int:
        """Decision periods that the course may still take."""
        return self.most_periods - len(self._course.rows)

    def pull_taut(self, waypoint: float) -> None:
        """Pull devices back that have passed a place with slack: what lies in loops comes out, and the tip stays.

        A device in loops presses forward with EI / 2R² as it unbends, R being the radius of the wide lumen.
        """
        course, speed = self._course, self._config.speed_mm_s
        if self.slack_mm <= _SLACK_MM or waypoint >= self._route.target.abscissa:
            return
        kept, passed = course.kept(), self.here
        leads = self.ahead and self.lead_mm > 0
        back = course.control(*(Move(device, -speed) for device in range(1 if leads else course.devices)))
        while self.slack_mm > _TAUT_MM and self.here > passed - _COMES_MM and course.lengths.min() > 1.0:
            if leads and self.lead_mm <= 0:
                break
            course.move(back)
        if self.here < passed - _LEAVES_MM:
            course.restore(kept)

    def bring_on(self, waypoint: float, kept: Kept, halt: Halt) -> bool:
        """Bring the devices on otherwise than straight; return whether they come forward.

        Motions are drawn: from where the devices lay, then from where a straight push has loaded a wire that goes
        ahead. Else this may stay where the push has brought it; else its catheter follows.

        Args:
            waypoint: the place that is to be passed, mm.
            kept: where the devices lay.
            halt: how the straight push ended, with which the course ends.
        """
        course, loaded = self._course, self._course.kept()
        course.restore(kept)
        begun, presses_on = self.here, self.ahead and halt == "stalled"
        for begin in (kept, loaded) if presses_on else (kept,):
            course.restore(begin)
            here = self.here
            goal = min(self._route.next_waypoint(here), here + _LOOKOUT_MM)
            rounds = min(self._config.rounds, self.left // self._config.round_periods)
            for control in self._population.find(course, goal, rounds=rounds, spare_share=SPARE_SHARE)[0]:
                course.move(control[None])
            if self._comes_on(waypoint, begun):
                return True
        if presses_on:
            course.restore(loaded)
            if self._comes_on(waypoint, begun):
                return True
        course.restore(kept)
        return self.ahead and self.support()

    def _comes_on(self, waypoint: float, begun: float) -> bool:
        """Pull devices taut; return whether they have then come forward from a place, mm, without lying in loops."""
        self.pull_taut(waypoint)
        return self.here >= begun + _GAIN_MM and self.slack_mm <= _LOOSE_MM

    def support(self) -> bool:
        """Let the catheter follow over the resting wire, which it then supports; return whether it comes along."""
        course, config = self._course, self._config
        begun, here, first_mm = self.catheter_at, self.here, float(course.inserted(CATHETER)[0])
        for _ in range(min(self.left, round(config.manoeuvres.longest_s / DECISION_PERIOD_S))):
            left_mm = self.lead_mm - config.manoeuvres.behind_mm
            pushed_mm = float(course.inserted(CATHETER)[0]) - first_mm
            if left_mm <= REST_MM or pushed_mm - (self.catheter_at - begun) > _FOLDS_MM or course.still[0]:
                break
            speed = min(config.speed_mm_s, left_mm / DECISION_PERIOD_S)
            course.still |= course.move(course.control(Move(CATHETER, speed)), force_n=self._navigation.force_limit_n)
        course.still[:] = False
        return self.catheter_at >= begun + _COMES_ALONG_MM and self.here >= here - _COMES_MM

    def retreat(self, kept: Kept) -> None:
        """Pull a wire that goes ahead back from where it is stuck, for another search to begin there.

        Its catheter comes back too where its tip lies beyond a fork at which the wire has left it.
        """
        course, random = self._course, self._random
        course.restore(kept)
        astray = bool((self._route.off_route(course.tips[:, CATHETER]) > 0).any())
        leads, wire_mm = self.lead_mm > 0, random.uniform(*_RETREAT_MM)
        catheter_mm = random.uniform(*_RETREAT_MM) if astray or not leads else 0.0
        periods = int(np.ceil(max(wire_mm, catheter_mm) / (self._config.speed_mm_s * DECISION_PERIOD_S)))
        back = [-mm / (periods * DECISION_PERIOD_S) for mm in (wire_mm, catheter_mm)]
        for _ in range(min(periods, self.left)):
            if course.lengths.min() < 1.0 or (leads and self.lead_mm <= 0):
                return
            course.move(course.control(Move(WIRE, back[0]), Move(CATHETER, back[1])))
