"""Search for a course that brings a stack of devices to a target, in the rod core: `Search`.

A wire alone is a stack of one. The course grows from waypoint to waypoint. A *waypoint* lies just within the branch
that the route takes at a fork; with a catheter, others lie between forks that are far apart. What leads past one is a
*manoeuvre*: it advances, rotates and retracts each device (`Move`). Its *trials* are driven side by side, in a world
for each wire that is held possible (`Trials`). One that brings all of these wires past the waypoint becomes part of
the course. Manoeuvres are tried in this order, until one passes:

1. *Straight on* (`Push`). The wire advances and a catheter follows; trials differ in how far the wire leads.
2. *Turned* (`Grid`). Devices are placed before, at or beyond the *obstacle*: the fork, or what ended the straight push.
   They are rotated to all sides, retracted perhaps, and pushed on. Of the places that most rotations pass, the rotation
   in the middle of those is taken: it bears errors best.
3. *Drawn* (`Population`), for a wire alone. Candidates move at random; the cheapest are kept and go on.

Each manoeuvre has to stay within a share of the force limit. The last resort of the turned ones may use more of it than
the first. `manoeuvre_cost` decides between trials that are else as good.
"""

from __future__ import annotations

import sys
from functools import partial
from itertools import product

import numpy as np

from endopilot.belief.belief import Belief
from endopilot.control.course import Course, next_place, places_of
from endopilot.control.population import ConstantMotions, Population
from endopilot.control.push import (
    LOOPS_MM,
    TURN_PERIODS,
    Each,
    Halt,
    Push,
    Pushed,
    middle,
    sides,
    stand_off,
    turn,
)
from endopilot.control.search_config import SearchConfig
from endopilot.control.set_up import SPARE_SHARE, describe_halt, near_fork
from endopilot.control.together import STRAIGHT, Grid, Repertoire, Together, place, retract
from endopilot.control.trials import STALL_PERIODS, WIRE, Budget, Kept, Move, OutOfBudgetError, Trials
from endopilot.errors import InputError
from endopilot.progress import Advance
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

_ENDLESS = sys.maxsize
_BACK_MM_S = 2.0
"""Speed at which a wire that has gone past its target is retracted, mm/s."""
_LOOKOUT_MM, _LOOKOUT_RADII = 12.0, 3.0
"""A waypoint that is searched for lies no farther ahead than this, mm, or lumen radii where that is more: beyond, a
chord says little."""
_TURNS = (0.0, np.pi)
"""Angles by which a wire alone may be turned before it goes in, rad."""
_GENTLE_SHARE, _LOOP_SHARE, _LOOP_MM_S = 0.1, 1e-4, 5.0
"""Share of the force limit below which devices in a wide lumen hardly press, what a millimetre in loops costs, and how
many of these a second is worth, mm/s."""
_BEHIND_WIDTHS = 2
"""Soft devices may slide out of a branch from so many widths of the lumen beyond its fork."""
_LONGER = 10
"""Times the given time after which a plan for devices that move together is given up."""
_OFTEN = 6
"""A course that has passed places this many times as often as there are is at an end."""
_REPEATED = 3
"""Trials of a manoeuvre that the course tries, one after another."""


class Search:
    """Searches courses for a navigation, from whatever is believed of its devices.

    Attributes:
        halt: where and why the last search ended before the target, in words; empty if it arrived.
        budget: of a search, which ends with what it has once that is spent.
    """

    def __init__(
        self,
        navigation: Navigation,
        route: Route,
        belief: Belief,
        *,
        config: SearchConfig,
        seed: int,
        budget: Budget | None = None,
    ) -> None:
        """Lay out the trials.

        Args:
            navigation: what is to be done.
            route: to its target.
            belief: whose wires they are, and whose settings of the rod core are taken.
            config: settings of the search.
            seed: of what is drawn at random.
            budget: of each call of `find`; none if not given.

        Raises:
            InputError: there is more than one catheter.
        """
        check_devices(navigation)
        self._navigation, self.route, self.config = navigation, route, config
        self._alone, wide = not navigation.catheters, route.is_wide(route.target.abscissa)
        self._repertoire = Repertoire.of(navigation.catheters, config, wide=wide)
        self.budget = budget or Budget()
        trials_of = partial(Trials.of, navigation, belief.kinds, like=belief.simulator, budget=self.budget)
        self._course, self._many = trials_of(count=1), trials_of(count=self._repertoire.trials)
        self._few = self._course if self._alone else trials_of(count=len(self._repertoire.leads))
        drawn = trials_of(count=config.candidates) if config.manoeuvres.together else self._many
        random = np.random.default_rng([seed, 0x5EA])
        self._population = Population(navigation, route, drawn, config, random)
        motions = ConstantMotions(navigation, route, drawn, config, random)
        self._together = Together(navigation, route, self._course, config, random, self._population, motions)
        self.halt = ""

    @property
    def draws(self) -> bool:
        """Whether it draws at random, so that another search from the same belief may find another course."""
        return self._alone or self.config.manoeuvres.together

    def find(
        self,
        belief: Belief,
        *,
        seconds: float,
        horizon_mm: float = np.inf,
        first: bool = False,
        advance: Advance | None = None,
    ) -> Course:
        """Find a course from where the likeliest devices are to the target.

        In a tortuous vessel forces depend on the side that the bent tip of a wire alone looks to as it goes in. So
        where the first course presses hard, or none is found though no fork refuses, others are searched with the wire
        turned.

        Args:
            belief: of the devices; nothing of it is changed.
            seconds: time that is left, s. Where devices move in turn a course may take longer.
            horizon_mm: a course may end when it has come so far forward, mm.
            first: whether it is the first of the navigation, which may turn the devices before all else.
            advance: called with every millimetre along the route.
        """
        gentle_n = SPARE_SHARE * self._navigation.force_limit_n
        best: Course | None = None
        halt = ""
        self.budget.begin()
        for angle in _TURNS if first and self._alone else _TURNS[:1]:
            course = self.find_turned(belief, angle, seconds=seconds, horizon_mm=horizon_mm, advance=advance)
            if best is None or _merit(course) > _merit(best):
                best, halt = course, self.halt
            if (
                (course.reached > 0.5 and course.force.max(initial=0.0) <= gentle_n)
                or self._at_fork
                or self.budget.over
            ):
                break
        assert best is not None
        if best.reached <= 0.5 and self._behind_mm > 0 and not self.budget.over:
            course = self.find_turned(belief, 0.0, seconds=seconds, advance=advance, out=True)
            if course.reached > 0.5:
                return course
        self.halt = halt
        return best

    def find_turned(
        self,
        belief: Belief,
        angle: float,
        *,
        seconds: float,
        horizon_mm: float = np.inf,
        advance: Advance | None = None,
        out: bool = False,
    ) -> Course:
        """Find a course that begins with a turn of the devices, rad; the other arguments are those of `find`.

        Args:
            out: whether a wire alone is first pulled back to before the last fork that it has passed.
        """
        course, settled = self._course, list[int]()
        source, weight = belief.likeliest()
        course.put(source, belief.simulator, weight)
        self._behind_mm, self._kept = self._before_fork(), course.kept()
        self.halt, self._at_fork = "", False
        self._together.most_periods = self._most_periods(seconds, horizon_mm)
        try:
            self._set_out(angle, out=out)
            self._lead(settled, horizon_mm, advance)
        except OutOfBudgetError:
            course.restore(self._kept)
            self.halt = f"the search came to {self._here:.0f} mm in its budget; give more (AgentConfig.evaluations)"
        reached = self._reached()
        if reached <= 0.5:
            self._cut_hard()
        return course.as_course(
            reached=reached,
            ostium_mm=float(belief.ostium_mm[source[0]]),
            settled=None if self._alone else settled,
        )

    def _set_out(self, angle: float, *, out: bool) -> None:
        """Turn the devices, rad, and pull a wire alone back to before the last fork that it has passed, if wanted."""
        course = self._course
        if angle:
            turn(course, np.array([angle]), periods=self._left)
        while out and self._here > self._behind_mm and course.lengths[:, WIRE].min() > 1.0 and self._left > 0:
            course.move(course.control(Move(WIRE, -self.config.speed_mm_s)))

    def _lead(self, settled: list[int], horizon_mm: float, advance: Advance | None) -> None:
        """Lead the course from place to place, and note the periods at whose ends a manoeuvre is over."""
        course, pair, together = self._course, self._together, self.config.manoeuvres.together
        reported, begun = 0.0, self._here
        places = places_of(self.route, begun, alone=self._alone, together=together)
        while self._left > 0:
            here = self._here
            if advance is not None:
                advance(max(here - reported, 0.0))
                reported = max(here, reported)
            pair.set_out()
            waypoint, kept, self._tried = next_place(places, here, alone=self._alone), course.kept(), {}
            self._kept = kept
            halt = "stalled" if pair.ahead else self._straight(waypoint)
            if halt is None:
                if together:
                    pair.pull_taut(waypoint)
                settled.append(len(course.rows) - 1)
                if self._reached() > 0.5:
                    break
                if len(course.rows) == kept.periods:  # some wire lies beyond the waypoint, others before it
                    course.move(course.control(Move(WIRE, -_BACK_MM_S)))
                if len(settled) > _OFTEN * len(places):  # it goes to and fro about a place
                    self._halted("stalled", waypoint)
                    break
            elif together and pair.bring_on(waypoint, kept):
                settled.append(len(course.rows) - 1)
                if np.isfinite(horizon_mm) or self._reached() > 0.5:
                    break
            elif pair.ahead:
                self._halted(halt, waypoint)
                pair.retreat(kept)
                break
            elif any(self._turned(grid, share, waypoint, kept) for share, grid in self._repertoire.ways):
                if together:
                    pair.pull_taut(waypoint)
                settled.append(len(course.rows) - 1)
            elif self._alone and self._drawn(waypoint, kept):
                settled.append(len(course.rows) - 1)
            else:
                self._halted(halt, waypoint)
                break
            if self._here >= begun + horizon_mm:
                break
        else:
            self._halted("late", 0.0)

    def _most_periods(self, seconds: float, horizon_mm: float) -> int:
        """Return how many decision periods a course may take in some time, s.

        With a catheter a course to the target may take longer: whoever plans is told how long.
        """
        periods = max(1, int(seconds / DECISION_PERIOD_S))
        if self._alone or np.isfinite(horizon_mm):
            return periods
        return _LONGER * periods if self.config.manoeuvres.together else _ENDLESS

    def manoeuvre_cost(self, pushed: Pushed) -> Each:
        """Return what each trial of a manoeuvre costs, by which those that pass are compared: its largest force, N.

        In a wide lumen soft devices press as gently in loops as straight, and loops end in coils: between trials that
        hardly press, what lies in loops decides there, and the time that the trial takes.
        """
        if self._alone or not self.route.is_wide(self.route.target.abscissa):
            return pushed.force
        limit_n, seconds = self._navigation.force_limit_n, DECISION_PERIOD_S * pushed.moving
        loops_mm = pushed.slack + _LOOP_MM_S * seconds
        return np.maximum(pushed.force, _GENTLE_SHARE * limit_n) + _LOOP_SHARE * limit_n * loops_mm

    def _straight(self, waypoint: float) -> Halt | None:
        """Push straight on past a place; return why not, or None if the course has passed it."""
        course, push = self._course, self._push(waypoint, strict=self._alone)
        if push.arrived(course)[0]:
            return None
        if push.strict:
            pushed = push.run(course, self._left)
            passes = pushed.passed[0]
        else:
            pushed = self._tried[STRAIGHT] = self._try(STRAIGHT, waypoint)
            passes = self._follow(pushed, SPARE_SHARE, waypoint, turns=1)
        self._hard = float(pushed.farthest.max())
        if push.spreads(course):
            passes = passes and self._arrives(push)
        return None if passes else pushed.halt[int(np.argmax(pushed.farthest))]

    def _arrives(self, push: Push) -> bool:
        """Return whether the course is past a place; wires that it does not bring to the target are left behind.

        That happens in a wide lumen, where the wires that are held possible spread by more than what counts as arrived.
        """
        course = self._course
        if not push.spreads(course):
            return bool((push.arrived(course) & ~course.still)[0])
        there = self.route.passed(course.foremost, push.waypoint) * course.weight
        if there.sum() > 0:
            course.weight = there / there.sum()
        return bool(there.sum() > 0 and not course.still[0])

    def _turned(self, grid: Grid, share: float, waypoint: float, kept: Kept) -> bool:
        """Try a grid before a place, and follow the best of it; return whether any passes.

        Args:
            grid: that is tried; what became of it is kept until the place is passed.
            share: of the force limit, which the trial that is followed stays within.
            waypoint: the place, mm.
            kept: where the devices are.
        """
        course, tried = self._course, self._tried.get(grid)
        course.restore(kept)
        if tried is not None and not tried.within(*self._limits(share)).any():
            return False
        if self._alone and grid[0].beyond is not None:
            self._approach(waypoint)
            if len(course.rows) == kept.periods:  # where it is already: that is another grid
                return self._turned(tuple(at._replace(beyond=None) for at in grid), share, waypoint, kept)
        if tried is None:
            tried = self._tried[grid] = self._try(grid, waypoint)
        return self._follow(tried, share, waypoint, turns=self._repertoire.turns if grid else 1)

    def _try(self, grid: Grid, waypoint: float) -> Pushed:
        """Place devices as a grid has them, turn them to all sides, and push them on; `STRAIGHT` with every lead."""
        if not grid:
            return self._push(waypoint).run(
                self._few.copy_of(self._course), self._left, np.array(self._repertoire.leads)
            )
        many, limit_n = self._many.copy_of(self._course), self._navigation.force_limit_n
        left, turns = self._left, self._repertoire.turns
        beyond, lead, back, push_lead = (
            np.repeat(each, turns) for each in np.array([(*at, at.push_lead_mm) for at in grid], dtype=float).T
        )
        obstacle, step = self._obstacle(waypoint)
        if not self._alone:
            place(many, np.maximum(obstacle + beyond * step, 0.0), lead, config=self.config, force_n=limit_n)
        turn(many, np.tile(sides(turns), len(grid)), periods=left, force_n=limit_n)
        retract(many, back * step, config=self.config, force_n=limit_n)
        return self._push(waypoint).run(many, left - TURN_PERIODS, push_lead)

    def _push(self, waypoint: float, *, strict: bool = False) -> Push:
        return Push(self.route, self._navigation, self.config, waypoint, strict)

    def _follow(self, pushed: Pushed, share: float, waypoint: float, *, turns: int) -> bool:
        """Let the course do what the best trial of a manoeuvre did; return whether any passes within a share of force.

        Of the places that most rotations pass, and among these of the cheapest, it is the rotation in the middle. Where
        there is a catheter, trials have waited for each other. The course does not, and so has to pass again; but soft
        devices go on to unbend as they wait, and what moves them together may keep the pauses.
        """
        course, cost, kept = self._course, self.manoeuvre_cost(pushed), self._course.kept()
        limit_n, slack_mm = self._limits(share)
        rows = pushed.within(limit_n, slack_mm).reshape(-1, turns)
        trials = [at * turns + middle(row) for at, row in enumerate(rows) if row.any()]
        trials.sort(key=lambda trial: (-int(rows[trial // turns].sum()), cost[trial]))
        pauses = (self._alone, True) if self.config.manoeuvres.together else (self._alone,)
        for trial, waits in product(trials[:_REPEATED], pauses):
            for control in pushed.controls(trial):
                if waits or control.any():
                    course.still |= course.move(control[None], force_n=limit_n)
            if self._arrives(self._push(waypoint)):
                return True
            course.restore(kept)
        return False

    def _limits(self, share: float) -> tuple[float, float]:
        """Return how hard a manoeuvre may press, N, and how much slack it may leave, mm, at some share of the limits.

        Devices that move together where time is short are so soft that loops end in coils: all but the last resort may
        lay no more than `LOOPS_MM` into them.
        """
        limit_n = share * self._navigation.force_limit_n
        if not self.config.manoeuvres.together or share >= 1.0:
            return limit_n, np.inf
        return limit_n, max(self._together.slack_mm, 0.0) + LOOPS_MM

    def _obstacle(self, waypoint: float) -> tuple[float, float]:
        """Return what lies in the way of a place, and the steps in which devices are placed about it, mm.

        That is the fork before the place, unless it is well behind, or where the straight push came to.
        """
        route = self.route
        near = float(route.junctions[route.junctions < waypoint].max(initial=0.0))
        width = 2 * float(route.radius(np.array([near]))[0])
        behind = width * (_BEHIND_WIDTHS if self.config.manoeuvres.together else 1)
        obstacle = min(near, self._hard) if near > max(self._here - behind, 0.0) else self._hard
        return obstacle, stand_off(route, obstacle, self.config.lead_mm)

    def _approach(self, waypoint: float) -> None:
        """Push a wire alone on, or pull it back, to where it is turned for a waypoint, mm.

        That is before the fork, or before where the straight push came to: a bend that turns a wire back may lie there.
        """
        course, route, speed = self._course, self.route, self.config.speed_mm_s
        before = route.junctions[route.junctions < waypoint]
        begin = waypoint - _LOOKOUT_MM
        if len(before) and waypoint < route.target.abscissa:
            begin = float(before[-1]) - stand_off(route, float(before[-1]), self.config.lead_mm)
        begin = min(begin, self._hard - self.config.lead_mm)
        for _ in range(self._left):
            here, on_route = self._here, course.all(route.off_route(course.foremost) == 0)[0]
            rests = len(course.rows) >= STALL_PERIODS and course.stalled(lambda tip: tip.abscissa, STALL_PERIODS - 1)
            if not on_route and course.lengths[:, WIRE].min() > 1.0:
                course.move(course.control(Move(WIRE, -speed)))
            elif here < begin - 1.0 and not rests:
                course.move(course.control(Move(WIRE, min(speed, (begin - here) / DECISION_PERIOD_S))))
            else:
                return

    def _before_fork(self) -> float:
        """Return a place before the last fork that a wire alone in a wide lumen has passed, mm; 0 if there is none.

        Pulled back to there, what lies in loops behind the fork comes out, and the wire goes in otherwise.
        """
        route = self.route
        if not (self._alone and route.is_wide(route.target.abscissa)):
            return 0.0
        fork = float(route.junctions[route.junctions < self._here].max(initial=0.0))
        return fork - stand_off(route, fork, self.config.lead_mm) if fork else 0.0

    def _drawn(self, waypoint: float, kept: Kept) -> bool:
        """Let candidates draw their motions, and follow the best; return whether it passes the next place.

        A course that does not goes as far as it can. Wires that do not pass are left behind.
        """
        course, route, config = self._course, self.route, self.config
        course.restore(kept)
        self._approach(waypoint)
        here = self._here
        lookout = max(_LOOKOUT_MM, _LOOKOUT_RADII * float(route.radius(np.array([here]))[0]))
        waypoint = min(route.next_waypoint(here), here + lookout)
        rounds = min(config.rounds, self._left // config.round_periods)
        controls, won = self._population.find(course, waypoint, rounds=rounds, spare_share=SPARE_SHARE)
        for control in controls:
            course.move(control[None])
        passed = np.where(won & route.passed(course.foremost, waypoint), course.weight, 0.0)
        if passed.sum() > 0:
            course.weight = passed / passed.sum()
        return won and len(course.rows) > kept.periods

    @property
    def _left(self) -> int:
        """Decision periods that the course may still take."""
        return self._together.left

    @property
    def _here(self) -> float:
        """How far along the route the devices have come, mm."""
        return self._together.here

    def _reached(self) -> float:
        return float(self._course.mean(self._navigation.reached(self._course.tips))[0])

    def _halted(self, halt: Halt, waypoint: float) -> None:
        """Say where and why no course goes on."""
        at_mm = self._hard if self._alone and halt != "late" else waypoint
        self.halt = describe_halt(halt, at_mm, self.route, self._navigation)
        fork = near_fork(at_mm, self.route, self._navigation)
        self._at_fork = halt in ("off", "stalled") and fork is not None

    def _cut_hard(self) -> None:
        """Forget what a course that does not arrive does from where it presses too hard."""
        course, limit_n = self._course, self._navigation.force_limit_n
        hard = [bool((row.force[course.counted] > limit_n).any()) for row in course.rows]
        if any(hard):
            del course.rows[hard.index(True) :]


def check_devices(navigation: Navigation) -> None:
    """Refuse a navigation that a search cannot drive.

    Raises:
        InputError: there is more than one catheter.
    """
    if len(navigation.catheters) > 1:
        raise InputError(f"catheter: {len(navigation.catheters)}; the search drives one: give one")


def _merit(course: Course) -> tuple[bool, float]:
    """Return how good a course is: whether it arrives, and how gently, or how far it comes."""
    arrives = course.reached > 0.5
    if arrives or not len(course.force):
        return arrives, -float(course.force.max(initial=0.0)) if arrives else 0.0
    return False, float(course.tip.abscissa[-1].mean())
