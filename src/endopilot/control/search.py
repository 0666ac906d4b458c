"""Search for a course that brings a stack of devices to a target, in the rod core: `Search`.

A wire alone is a stack of one. The course grows from place to place of the route: waypoints lie just within the branch
that the route takes at a fork; with a catheter, others lie between forks that are far apart. To pass a place, the rows
of a table (`Repertoire`) are tried in order. All motions of a row are driven side by side, in a world for each wire
that is held possible (`Driver`). One cost compares them (`Outcome.cost`), and one rule accepts: enough of the wires
come past the place, and none presses harder than a share of the force limit. Where no row passes, motions are drawn
round by round: each goes on from the best of the one before, or is drawn around the best so far.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from endopilot.belief.belief import Belief
from endopilot.belief.thought import Budget, OutOfBudgetError
from endopilot.control.course import Course, places_of
from endopilot.control.drive import ROUNDING, Driver, Goal, Halt, Motions, Outcome, SearchConfig
from endopilot.control.repertoire import Repertoire, Row, Table, stand_off
from endopilot.control.set_up import describe_halt
from endopilot.control.trials import Trials
from endopilot.progress import Advance
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

_KEEP = 8
"""Trials that go on to the next round."""
_REPEATED = 3
"""Trials that the course tries, one after another."""
_LONGER = 10
"""Times the given time after which a course to the target with a catheter is given up: a plan tells how long."""


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
        table: Table | None = None,
    ) -> None:
        """Lay out trials of the wires of a belief, whose settings of the rod core are taken.

        Args:
            seed: of what is drawn at random.
            budget: of each call of `find`; none if not given.
            table: what is tried; the package's own if not given.
        """
        self._navigation, self.route, self.config = navigation, route, config
        self.budget = budget or Budget()
        self._belief, self._table, self._trials = belief, table, dict[tuple[int, ...], Trials]()
        self._course = self._new_trials(1, range(len(belief.kinds)))
        self._random = np.random.default_rng([seed, 0x5EA])
        self.halt = ""

    @property
    def draws(self) -> bool:
        """Whether it draws at random, so that another search from the same belief may find another course."""
        return bool(self._repertoire.drawn)

    @property
    def _repertoire(self) -> Repertoire:
        return Repertoire.of(self._navigation, self.route, self.config, self._here, self._table)

    def _new_trials(self, count: int, wires: Iterable[int]) -> Trials:
        like, kinds = self._belief.simulator, self._belief.kinds
        return Trials.of(self._navigation, [kinds[wire] for wire in wires], count, like=like, budget=self.budget)

    def _trials_of(self, row: Row) -> Trials:
        """Return the trials by which the motions of a row are driven.

        A single motion is driven with all wires, and so are those that go onward, since few of them pass;
        others with the likeliest few, and what passes is tried with all when it is followed.
        """
        course = self._course
        few = course.wires if row.count == 1 or row.onward else math.isqrt(course.wires)
        wires = np.sort(np.argsort(-course.weight, kind="stable")[:few])
        key = (row.count, *wires.tolist())
        if key not in self._trials:
            self._trials[key] = self._new_trials(row.count, key[1:])
        return self._trials[key].copy_of(course, wires)

    def find(
        self, belief: Belief, *, seconds: float, horizon_mm: float = np.inf, advance: Advance | None = None
    ) -> Course:
        """Find a course from where the likeliest devices are to the target.

        Args:
            belief: of the devices; nothing of it is changed.
            seconds: time that is left, s. With a catheter a course to the target may take longer.
            horizon_mm: a course may end when it has come so far forward, mm.
            advance: called with every millimetre along the route.
        """
        self.budget.begin()
        self.set_out(belief, seconds=seconds, horizon_mm=horizon_mm)
        return self.go_on(advance=advance)

    def set_out(self, belief: Belief, *, seconds: float, horizon_mm: float = np.inf) -> None:
        """Begin a course where the likeliest devices are; the arguments are those of `find`."""
        source, weight = belief.likeliest()
        self._course.put(source, belief.simulator, weight)
        self._ostium_mm, self._horizon_mm = float(belief.ostium_mm[source[0]]), horizon_mm
        self._most = max(1, int(seconds / DECISION_PERIOD_S))
        if self._navigation.catheters and not np.isfinite(horizon_mm):
            self._most *= _LONGER
        self.halt, self._kept, self._settled = "", self._course.kept(), list[int]()

    def go_on(self, found: Callable[[Course], None] | None = None, *, advance: Advance | None = None) -> Course:
        """Return a course from where it has set out to the target; `found` is called with the course as far as it is
        known, whenever it has passed another place.
        """
        try:
            self._lead(advance, found)
        except OutOfBudgetError:
            self._course.restore(self._kept)
            self.halt = f"the search came to {self._here:.0f} mm in its budget; give more (AgentConfig.evaluations)"
        return self._as_course()

    def _as_course(self) -> Course:
        return self._course.as_course(
            reached=float(self._course.mean(self._navigation.reached(self._course.tips))[0]),
            ostium_mm=self._ostium_mm,
            settled=self._settled if self._navigation.catheters else None,
        )

    def _lead(self, advance: Advance | None, found: Callable[[Course], None] | None) -> None:
        """Lead the course from place to place, and note the periods at whose ends a motion is over."""
        course, begun, alone = self._course, self._here, not self._navigation.catheters
        horizon_mm = self._horizon_mm
        together, reported = self.config.together, begun
        for place in places_of(self.route, begun, alone=alone, together=together):
            goal = Goal(self._navigation, self.route, place, self._repertoire.agree)
            while not goal.arrived(course)[0]:
                self._kept = course.kept()
                halt = self._pass(goal)
                if advance is not None:
                    advance(max(self._here - reported, 0.0))
                    reported = max(self._here, reported)
                if halt is not None:
                    at_mm = self._hard if alone and halt != "late" else place
                    self.halt = describe_halt(halt, at_mm, self.route, self._navigation)
                    return
                self._settled.append(len(course.rows) - 1)
                if found is not None:
                    found(self._as_course())
                came = self._here >= begun + horizon_mm
                if came or (np.isfinite(horizon_mm) and not goal.arrived(course)[0]):
                    return

    def _pass(self, goal: Goal) -> Halt | None:
        """Lead the course past a place, or on towards it; return why no motion does, else None."""
        course, repertoire, limit_n = self._course, self._repertoire, self._navigation.force_limit_n
        if self._left <= 0:
            return "late"
        tried: dict[Row, Outcome] = {}
        halt, self._hard = "late", np.inf
        for share in repertoire.force:
            for row in repertoire.rows:
                if row not in tried:
                    tried[row] = next(self._drive(row, goal))
                if row is repertoire.rows[0] and share == repertoire.force[0]:
                    outcome = tried[row]
                    at = int(np.argmax(outcome.farthest))
                    self._hard, halt = float(outcome.farthest[at]), outcome.halt[at]
                if self._follow(tried[row], goal, row, min(row.force, share) * limit_n):
                    return None
        for row in repertoire.drawn:
            for number, outcome in enumerate(self._drive(row, goal)):
                if self._follow(outcome, goal, row, row.force * limit_n, number):
                    return None
        course.restore(self._kept)
        straight = tried[repertoire.rows[0]]
        farthest = int(np.argmax(straight.farthest))
        if straight.periods[farthest] >= self._left:  # it leads on as far as there is time
            self._repeat(straight, farthest)
        return halt

    def _drive(self, row: Row, goal: Goal) -> Iterator[Outcome]:
        """Drive the motions of a row from where the course is, and yield what becomes of them, round by round."""
        trials = self._trials_of(row)
        obstacle, step = self._obstacle(goal.at_mm)
        limit_n = self._navigation.force_limit_n
        limits = self._repertoire.limits(row, self.route, self._here, goal.at_mm, limit_n)
        periods = self._left if row.draws is None else min(row.draws.periods, self._left)
        best, costs = None, np.empty(0)
        for _ in range(row.rounds):
            motions = row.motions(obstacle, step, self.config, trials.devices, self._random, best)
            outcome = Driver(trials, motions, goal, limits, self.config).run(
                min(periods, self._left - len(trials.rows))
            )
            yield outcome
            cost = outcome.cost(limit_n, on_the_way=not row.onward)
            if row.onward:
                trials.copy_trials(np.resize(np.argsort(cost)[:_KEEP], trials.count))
                best = motions
                continue
            tried = motions if best is None else Motions(*map(np.concatenate, zip(best, motions, strict=True)))
            costs = np.concatenate([costs, cost])
            kept = np.argsort(costs)[:_KEEP]
            best, costs, trials = Motions(*(each[kept] for each in tried)), costs[kept], self._trials_of(row)

    def _follow(self, outcome: Outcome, goal: Goal, row: Row, force_n: float, number: int = 0) -> bool:
        """Let the course do what the cheapest trial of a round did; return whether it passed the place or came on.

        What all wires made of trials that did not is written into the outcome: the next round is drawn near the best.
        """
        course, limit_n, agree = self._course, self._navigation.force_limit_n, row.agrees(number)
        gentle = outcome.force <= force_n
        passes = gentle & (outcome.share >= agree - ROUNDING)
        cost = outcome.expected_cost(limit_n)
        for trial in np.flatnonzero(passes)[np.argsort(cost[passes])][:_REPEATED].tolist():
            gentle_still = self._repeat(outcome, trial, force_n=force_n)
            there = goal.passed(course) * course.weight
            if gentle_still and there.sum() > 0 and (goal.agree < 1 or there.sum() >= agree - ROUNDING):
                course.weight = there / there.sum()
                return True
            outcome.share[trial] = there.sum() if gentle_still else 0.0
            pressed = [row.force[course.counted].max() for row in course.rows[len(self._kept.rows) :]]
            outcome.force[trial] = max(pressed, default=0.0)
        course.restore(self._kept)
        if row.draws is None or not gentle.any():
            return False
        start = float(goal.to_go(course, self.config.behind_mm)[0])
        left = np.where(gentle, outcome.left_mm, np.inf)
        if left.min() > start - row.draws.step_mm:
            return False
        self._repeat(outcome, int(np.argmin(left)), most=row.draws.kept)
        return True

    def _repeat(self, outcome: Outcome, trial: int, *, most: int | None = None, force_n: float = np.inf) -> bool:
        """Let the course do what a trial did, less the periods in which it stood still, until a wire that counts
        presses with more than a force, N; return whether none does."""
        self._course.restore(self._kept)
        moved = (each for each in outcome.controls_of(trial)[:most] if each.any())
        return not any(self._course.move(control[None], force_n=force_n).any() for control in moved)

    def _obstacle(self, place: float) -> tuple[float, float]:
        """Return what lies in the way of a place, and the steps in which devices are placed about it, mm.

        That is the fork before the place, unless it is well behind, or where the straight push came to; where devices
        are too far in, the place itself.
        """
        route = self.route
        near = float(route.junctions[route.junctions < place].max(initial=0.0))
        width = 2 * float(route.radius(np.array([near]))[0])
        obstacle = min(near, self._hard) if near > max(self._here - width, 0.0) else self._hard
        obstacle = min(obstacle, place) if np.isfinite(obstacle) else near
        return obstacle, stand_off(route, obstacle, self.config.lead_mm)

    @property
    def _left(self) -> int:
        """Decision periods that the course may still take."""
        return self._most - len(self._course.rows)

    @property
    def _here(self) -> float:
        """How far along the route the devices have come, mm."""
        return float(self._course.progress(self.route)[0])
