"""Search for a path of a wire alone to a target in the rod core: `WireSearch`.

One wire, or several that differ in what is uncertain, is driven from its present state. It is pushed straight on as
long as the tip advances along the route. Where the tip enters a wrong branch, or stops, the wires go back to where they
were before, and a population of candidates tries other motions. Every round each candidate draws a constant control for
a second. Those nearest to the waypoint, in the mean over the wires and with the cost of their motion, are kept and
copied over the others, until one of them has entered the wanted branch.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.belief import Belief
from endopilot.control.course import SLIP_SHARE, STALL_PERIODS, Copies, Course, Kept
from endopilot.control.halt import SPARE_SHARE, Halt, describe_halt, near_fork
from endopilot.control.search import SearchConfig
from endopilot.control.sweep import TURN_PERIODS, Motion, Sweep, middle, sweep
from endopilot.devices.drive_limits import DriveLimits
from endopilot.progress import Advance
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route
from endopilot.types import TipProjection

_BACK_MM_S = 2.0
"""Speed at which a wire that has gone past its target is pulled back, mm/s."""
_SHORT_MM = 1.0
"""A path leaves this much of the travel unused, mm: encoders err."""
_LEFT_BEHIND = 0.2
"""Each further attempt accepts a path that this much more of the wires, by weight, do not follow."""
_LEAST_SHARE = 0.5
"""No attempt accepts a path that fewer of the wires follow, by weight."""
_LOOKOUT_MM, _LOOKOUT_RADII = 12.0, 3.0
"""A waypoint that is searched for lies no farther ahead than this, mm, or lumen radii where that is more: beyond, a
chord says little."""
_TURNS = (0.0, np.pi)
"""Angles by which the wire may be turned before it goes in, rad."""
_LEAD_RADII = 1.4
"""In a wide vessel a search begins this many lumen radii before the junction: a branch's mouth is about as wide."""


class WireSearch:
    """Searches paths of a wire alone, from any state of several that differ in stiffness.

    Attributes:
        halt: where and why the last search ended before the target, in words; empty if it arrived.
        draws: it draws at random.
    """

    draws = True

    def __init__(
        self, navigation: Navigation, route: Route, belief: Belief, *, config: SearchConfig, seed: int
    ) -> None:
        """Lay out the wires, and the candidates of each.

        Args:
            navigation: where, and how hard the wall may be pressed.
            route: to its target.
            belief: whose wires they are, and whose settings of the rod core are taken.
            config: settings of the search.
            seed: of the random candidates.
        """
        self.navigation, self.route, self.config = navigation, route, config
        self._random = np.random.default_rng([seed, 0x5EA])
        wires = list(belief.wires.values())
        candidates = [wire for wire in wires for _ in range(config.candidates)]
        self._single, self._many = (Copies(navigation, some, belief.simulator) for some in (wires, candidates))
        limits = DriveLimits.of(wires[0], navigation.anatomy)
        self._limits = replace(limits, travel_mm=(limits.travel_mm[0], limits.travel_mm[1] - _SHORT_MM))
        self._wire_radius = wires[0].tip_radius_mm
        self.halt = ""

    def find(self, belief: Belief, *, seconds: float, first: bool = False, advance: Advance | None = None) -> Course:
        """Find a path from where the likeliest wires are to the target, as `Search` has it.

        In a tortuous vessel forces depend on the side that the bent tip looks to as the wire goes in. So where the
        first course presses hard, or none is found though no fork refuses, others are searched with the wire turned.
        """
        gentle_n = SPARE_SHARE * self.navigation.force_limit_n
        best: Course | None = None
        halt = ""
        for turn in _TURNS if first else _TURNS[:1]:
            course = self.find_turned(belief, turn, seconds=seconds, advance=advance)
            if best is None or _merit(course) > _merit(best):
                best, halt = course, self.halt
            if (course.reached > 0.5 and course.force.max(initial=0.0) <= gentle_n) or self._at_fork:
                break
        assert best is not None
        self.halt = halt
        return best

    def find_turned(self, belief: Belief, turn: float, *, seconds: float, advance: Advance | None = None) -> Course:
        """Find a path that begins with a turn of the wire, rad; the other arguments are those of `find`."""
        source, self._weight = belief.likeliest()
        single = self._single
        single.put(source, belief.simulator)
        log, reported, self.halt, self._at_fork = single.log, 0.0, "", False
        periods = max(1, int(seconds / DECISION_PERIOD_S))
        for _ in range(min(TURN_PERIODS, periods) if turn else 0):
            self._drive(np.array([0.0, turn / (TURN_PERIODS * DECISION_PERIOD_S)]))
        while log.periods < periods:
            here = float(self.route.progress(self._tip) @ self._weight)
            if advance is not None:
                advance(max(here - reported, 0.0))
                reported = max(here, reported)
            waypoint, kept = self.route.next_waypoint(here), single.kept()
            halt = self._push_on(periods, waypoint)
            if halt is None:
                if self._reached() > 0.5:
                    break
                if log.periods == kept.periods:  # past the waypoint, not at the target: some wire lies beyond it
                    self._drive(np.array([-_BACK_MM_S, 0.0]))
                continue
            hard = self._farthest(kept.periods, here)
            if self._sweep(periods, kept, waypoint, hard):
                continue
            single.restore(kept)
            self._approach(periods, waypoint, hard)
            if not self._search_candidates(periods) or log.periods == kept.periods:
                self.halt = describe_halt(halt, hard, self.route, self.navigation)
                self._at_fork = halt in ("off", "stalled") and near_fork(hard, self.route, self.navigation) is not None
                break
        else:
            self.halt = describe_halt("late", 0.0, self.route, self.navigation)
        reached = self._reached()
        if reached <= 0.5:
            self._cut_hard()
        ostium_mm = float(belief.parameters[source[0], 2])
        return log.course((len(source), 1), reached=reached, ostium_mm=ostium_mm)

    @property
    def _tip(self) -> TipProjection:
        """Where the tips of the wires are."""
        return self._single.simulator.project()[:, 0]

    def _cut_hard(self) -> None:
        """Forget what a path that does not arrive does from where a wire presses too hard."""
        log, limit = self._single.log, self.navigation.force_limit_n
        hard = [bool((row.force[self._weight > 0] > limit).any()) for row in log.rows]
        if any(hard):
            log.cut(hard.index(True))

    def _farthest(self, begun: int, here: float) -> float:
        """Return how far along the route the wires have come since a period, in the mean, mm."""
        rows = self._single.log.rows[begun:]
        return max([here, *(float(self.route.progress(row.tip) @ self._weight) for row in rows)])

    def _sweep(self, periods: int, kept: Kept, waypoint: float, hard: float) -> bool:
        """Turn the wires to all sides and push them on; follow the middle of the rotations that pass the waypoint.

        That is tried before the place that a straight push came to, and from where the wires were kept: in a tortuous
        vessel the side that a tip looks to decides early. What stays within the share of the force limit that costs
        nothing is taken first, then what leaves something for the uncertain.

        Args:
            periods: length of the path at most.
            kept: where the wires were.
            waypoint: that is to be passed, mm.
            hard: abscissa that a straight push came to, mm.
        """
        limit, log = self.navigation.force_limit_n, self._single.log
        made: dict[bool, Sweep] = {}
        for share, near in product((self.config.cost.forbidden_share, SPARE_SHARE), (True, False)):
            if near in made and not made[near].within(share * limit).any():
                continue
            self._single.restore(kept)
            if near:
                self._approach(periods, waypoint, hard)
            if near not in made:
                self._copy()
                made[near] = sweep(
                    self._many.simulator,
                    self.route,
                    waypoint,
                    weight=self._weight,
                    travel=self._limits,
                    force_limit_n=limit,
                    speed_mm_s=self.config.speed_mm_s,
                    periods=periods - log.periods,
                )
            within = made[near].within(share * limit)
            if within.any():
                self._follow(made[near].controls(middle(within)))
                return True
        return False

    def _reached(self) -> float:
        return float(self.navigation.reached(self._single.simulator.project()) @ self._weight)

    def _push_on(self, periods: int, waypoint: float) -> Halt | None:
        """Push straight on past a waypoint; return why not, or None if all wires passed it."""
        log, simulator = self._single.log, self._single.simulator
        begun = log.periods
        while log.periods < periods:
            tip = self._tip
            if self._all(self.route.passed(tip, waypoint)):
                return None
            if not self._all(self.route.off_route(tip) == 0):
                return "off"
            left = waypoint - float(self.route.progress(tip) @ self._weight)
            last = waypoint >= self.route.target.abscissa
            speed = np.clip(left / DECISION_PERIOD_S, 1.0, self.config.speed_mm_s) if last else self.config.speed_mm_s
            before = simulator.inserted_length[:, 0]
            self._drive(np.array([speed, 0.0]))
            advance = (simulator.inserted_length[:, 0] - before)[self._weight > 0].min()
            if advance < SLIP_SHARE * log.rows[-1].control[0, 0, 0] * DECISION_PERIOD_S:
                return "slipped"
            if self._pressed():
                return "pressed"
            if log.periods - begun >= STALL_PERIODS and log.stalled(self._weight > 0):
                return "stalled"
        return None if self._all(self.route.passed(self._tip, waypoint)) else "late"

    def _approach(self, periods: int, waypoint: float, hard: float) -> None:
        """Push on, or pull back, to where a search for a waypoint begins.

        Args:
            periods: length of the path at most.
            waypoint: that is searched for, mm.
            hard: abscissa that a straight push came to, mm; a bend that turns a wire back may lie before the junction.
        """
        before = self.route.junctions[self.route.junctions < waypoint]
        last = waypoint >= self.route.target.abscissa
        begin = waypoint - _LOOKOUT_MM
        if len(before) and not last:
            radius = float(self.route.radius(before[-1:])[0])
            begin = float(before[-1]) - max(self.config.lead_mm, _LEAD_RADII * radius)
        begin = min(begin, hard - self.config.lead_mm)
        log = self._single.log
        for _ in range(periods - log.periods):
            tip = self._tip
            here, on_route = self.route.progress(tip) @ self._weight, self._all(self.route.off_route(tip) == 0)
            if not on_route and self._single.simulator.inserted_length[:, 0].min() > 1.0:
                self._drive(np.array([-self.config.speed_mm_s, 0.0]))
            elif here < begin - 1.0 and not (log.periods >= STALL_PERIODS and log.stalled(self._weight > 0)):
                self._drive(np.array([min(self.config.speed_mm_s, (begin - here) / DECISION_PERIOD_S), 0.0]))
            else:
                return

    def _drive(self, control: Float[np.ndarray, "2"]) -> None:
        """Drive all wires alike for a period, as far as the drive can."""
        made = self._possible(control[None], self._single.simulator)
        self._single.drive(np.tile(made, (self._single.simulator.worlds, 1, 1)))

    def _possible(self, control: Float[np.ndarray, "n 2"], simulator: Simulator) -> Float[np.ndarray, "n 2"]:
        """Return what the drive can do of controls: neither the shortest nor the longest wire leaves the travel."""
        inserted = simulator.inserted_length[:, 0]
        for length in (inserted.min(), inserted.max()):
            control = self._limits.clip(control, length, DECISION_PERIOD_S)
        return control

    def _copy(self) -> None:
        """Put the candidates of each wire where it is."""
        wires = np.arange(self._single.simulator.worlds)
        self._many.put(np.repeat(wires, self.config.candidates), self._single.simulator)

    def _pressed(self) -> bool:
        limit = self.config.cost.forbidden_share * self.navigation.force_limit_n
        return not self._all((self._single.log.rows[-1].force <= limit) & self._single.simulator.valid)

    def _all(self, holds: Bool[np.ndarray, "wires"]) -> bool:
        """Return whether something holds for all wires that have not been left behind."""
        return bool(holds[self._weight > 0].all())

    def _search_candidates(self, periods: int) -> bool:
        """Search with the whole population for a path past the next waypoint; follow the best.

        Every attempt begins from the same state, so that a plan holds no motion of a failed one.
        """
        progress = float(self.route.progress(self._tip) @ self._weight)
        lookout = max(_LOOKOUT_MM, _LOOKOUT_RADII * float(self.route.radius(np.array([progress]))[0]))
        waypoint = min(self.route.next_waypoint(progress), progress + lookout)
        rounds = min(self.config.rounds, (periods - self._single.log.periods) // self.config.round_periods)
        nearest, best = np.inf, np.zeros((0, 2))
        for attempt in range(self.config.attempts):
            score, controls, won = self._attempt(waypoint, rounds, attempt)
            if won:
                self._follow(controls)
                self._leave_behind(self.route.passed(self._tip, waypoint))
                return True
            if score < nearest:
                nearest, best = score, controls
        self._follow(best)
        return False

    def _leave_behind(self, passed: Bool[np.ndarray, "wires"]) -> None:
        """Go on without the wires that a path does not bring past a waypoint."""
        left = np.where(passed, self._weight, 0.0)
        if left.sum() > 0:
            self._weight = left / left.sum()

    def _attempt(self, waypoint: float, rounds: int, attempt: int) -> tuple[float, Motion, bool]:
        """Search once; return the least cost so far and to go, its controls, and whether they pass the waypoint."""
        count, wires = self.config.candidates, self._single.simulator.worlds
        self._copy()
        history, spent = np.zeros((0, count, 2)), np.zeros(count)
        spare = SPARE_SHARE if 2 * attempt < self.config.attempts else 1.0  # the last attempts leave nothing to spare
        most_n = spare * self.navigation.force_limit_n
        nearest, best = np.inf, np.zeros((0, 2))
        for number in range(rounds):
            before = history[-1] if number else np.zeros((count, 2))
            drawn = self._possible(self._draw(before, number, attempt), self._many.simulator)
            spent += self._run_round(drawn, before, waypoint)
            history = np.concatenate([history, np.repeat(drawn[None], self.config.round_periods, axis=0)])
            score, share = self._judge(waypoint, spent, most_n)
            won = share >= max(1 - _LEFT_BEHIND * attempt, _LEAST_SHARE) - 1e-9
            if won.any():
                return 0.0, history[:, np.argmin(np.where(won, score, np.inf))], True
            if number == 0:
                continue  # what has only turned has not shown yet where it leads
            if score.min() < nearest:
                nearest, best = float(score.min()), history[:, np.argmin(score)]
            chosen = self._select(score)
            source = (np.arange(wires)[:, None] * count + chosen).ravel()
            self._many.simulator.copy_worlds(source)
            self._many.peak = self._many.peak[source]
            history, spent = history[:, chosen], spent[chosen]
        return nearest, best, False

    def _draw(
        self, last: Float[np.ndarray, "candidates 2"], number: int, attempt: int
    ) -> Float[np.ndarray, "candidates 2"]:
        """Draw a control for each candidate.

        In the first round they turn the tip to all sides, and pull back, in later attempts farther; in the second most
        go straight on; then they move at random, and a few go on with what they did.
        """
        count, config, random = self.config.candidates, self.config, self._random
        turn = np.where(random.random(count) < 0.25, 0.0, random.uniform(-1.0, 1.0, count)) * config.turn_rad_s
        if number == 0:
            sides = (np.arange(count) + random.random(count)) / count
            turn = (2 * sides - 1) * np.pi / (config.round_periods * DECISION_PERIOD_S)
            speed = random.uniform(-0.3 * (1 + attempt), 0.3, count)
        elif number == 1:
            turn = np.where(random.random(count) < 0.6, 0.0, turn)
            speed = random.uniform(0.2, 1.0, count)
        else:
            back = random.random(count) < 0.45
            speed = np.where(back, random.uniform(-0.8, 0.0, count), random.uniform(0.1, 0.8, count))
        drawn = np.column_stack([np.clip(speed, -1.0, 1.0) * config.speed_mm_s, turn])
        same = (random.random(count) < 0.2) & (number > 1)
        drawn[same] = last[same]
        return drawn

    def _run_round(
        self, control: Float[np.ndarray, "candidates 2"], before: Float[np.ndarray, "candidates 2"],
        waypoint: float,
    ) -> Float[np.ndarray, "candidates"]:  # fmt: skip
        """Drive all candidates for a round; return what it cost each, in the mean over its wires."""
        cost, wires = self.config.cost, self._single.simulator.worlds
        spent = cost.roughness(before, control, self._limits.fastest)
        for _ in range(self.config.round_periods):
            step = self._many.drive(np.tile(control[:, None], (wires, 1, 1)))
            tip = self._many.log.rows[-1].tip
            running = cost.running(
                error=self._distance(step.tip_position[:, 0], waypoint),
                ratio=safety_ratio(tip.offset, tip.radius, self._wire_radius),
                force_share=step.contact_force_max / self.navigation.force_limit_n,
            )
            running = np.where(step.valid, running, 1e3)
            spent += DECISION_PERIOD_S * (self._weight @ running.reshape(wires, -1))
        return spent

    def _distance(self, position: Float[np.ndarray, "n 3"], waypoint: float) -> Float[np.ndarray, "n"]:
        return np.linalg.norm(position - self.route.position(waypoint), axis=-1)

    def _judge(
        self, waypoint: float, spent: Float[np.ndarray, "candidates"], force_n: float
    ) -> tuple[Float[np.ndarray, "candidates"], Float[np.ndarray, "candidates"]]:
        """Return each candidate's cost so far and to go, and the share of its wires that passed within a force."""
        many, wires = self._many, self._single.simulator.worlds
        tip = many.log.rows[-1].tip
        to_go = self._distance(many.simulator.position[:, 0], waypoint) + 0.5 * self.route.off_route(tip)
        sound = many.simulator.valid & (many.peak <= force_n)
        passed = (self.route.passed(tip, waypoint) & sound).reshape(wires, -1)
        score = self._weight @ to_go.reshape(wires, -1) + spent
        return score, self._weight @ passed

    def _select(self, score: Float[np.ndarray, "candidates"]) -> Int[np.ndarray, "candidates"]:
        """Return whose copy each candidate becomes: the best stay and are copied over the others."""
        best = np.argsort(score)[: max(1, round(self.config.keep_share * len(score)))]
        others = self._random.choice(best, len(score) - len(best))
        return np.concatenate([best, others])

    def _follow(self, controls: Motion) -> None:
        for control in controls:
            self._drive(control)


def _merit(course: Course) -> tuple[bool, float]:
    """Return how good a course is: whether it arrives, and how gently, or how far it comes."""
    arrives = course.reached > 0.5
    if arrives or not len(course.force):
        return arrives, -float(course.force.max(initial=0.0)) if arrives else 0.0
    return False, float(course.tip.abscissa[-1].mean())
