"""A population of devices that draw their motions at random until one passes a place: `Population`.

Every round each candidate draws a constant control for a second. Those nearest to the place, with the cost of what they
did, are kept and copied over the others: a beam search with random moves.

`ConstantMotions` draws motions that stay the same for some seconds. A wire whose bent tip is turned as it is pushed
gently enters a bend when the tip looks into it. A tip of curvature k in a bend of curvature K takes EI (K - k)² / 2 of
push where it looks into the bend, and EI (K + k)² / 2 where it looks out of it: six times as much for 12 mm and 5 mm of
radius. So devices that are too soft to be pushed on are turned on.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.course import Controls
from endopilot.control.search_config import SearchConfig
from endopilot.control.trials import CATHETER, WIRE, Control, Move, Trials
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

Each = Float[np.ndarray, "candidates"]
_LEFT_BEHIND = 0.2
"""Share of the wires, by weight, that may be left behind by a motion: so much more at each further attempt."""
_LEAST_SHARE = 0.5
"""No attempt accepts a motion that fewer of the wires follow, by weight."""
_FAILED_MM_S = 1e3
"""Cost of a wire whose simulation has failed, mm/s."""
_RESTS, _FOLLOWS = 0.4, 0.3
"""Shares of the candidates in which a catheter rests, and in which it advances by itself; in the others it goes along
with the wire."""
_OFF_ROUTE = 0.5
"""Cost of each mm that a tip lies off the route, mm."""


@dataclass(eq=False)
class Sampler:
    """Trials by which motions are drawn.

    Attributes:
        navigation: with the wire and the force limit.
        route: to the target.
        trials: a candidate each.
        config: settings of the search.
        random: what is drawn from.
    """

    navigation: Navigation
    route: Route
    trials: Trials
    config: SearchConfig
    random: np.random.Generator


class Population(Sampler):
    """Candidates of a wire, alone or with a catheter around it that rests, follows or goes along."""

    _rests = False

    def find(
        self, one: Trials, waypoint: float, *, rounds: int, spare_share: float, rests: bool = False
    ) -> tuple[Controls, bool]:
        """Find controls that bring most wires past a place; return the best, and whether they do.

        Every attempt begins from the same state, so that what is found holds no motion of a failed one.

        Args:
            one: the wires, where all candidates begin.
            waypoint: that is to be passed, mm.
            rounds: of each attempt at most.
            spare_share: share of the force limit that the first attempts stay within; the last leave nothing to spare.
            rests: whether a catheter rests.
        """
        self._rests = rests
        attempts, nearest, best = self.config.attempts, np.inf, np.zeros((0, one.devices, 2))
        for attempt in range(attempts):
            share = spare_share if 2 * attempt < attempts else 1.0
            score, controls, won = self.attempt(one, waypoint, rounds, attempt, share)
            if won:
                return controls, True
            if score < nearest:
                nearest, best = score, controls
        return best, False

    def attempt(
        self, one: Trials, waypoint: float, rounds: int, attempt: int, force_share: float
    ) -> tuple[float, Controls, bool]:
        """Search once; return the least cost so far and to go, its controls, and whether they pass the place."""
        trials, count = self.trials.copy_of(one), self.trials.count
        begun = np.zeros((count, trials.devices, 2))
        history, spent, peak = begun[None][:0], np.zeros(count), np.zeros(trials.simulator.worlds)
        most_n = force_share * self.navigation.force_limit_n
        nearest, best = np.inf, history[:, 0]
        for number in range(rounds):
            before = history[-1] if number else begun
            drawn = self._draw(before, number, attempt)
            drawn = trials.possible(drawn, alike=True, periods=self.config.round_periods)
            spent += self._run_round(drawn, before, waypoint, peak)
            history = np.concatenate([history, np.repeat(drawn[None], self.config.round_periods, axis=0)])
            score, share = self._judge(waypoint, spent, peak <= most_n)
            won = share >= max(1 - _LEFT_BEHIND * attempt, _LEAST_SHARE) - 1e-9
            if won.any():
                return 0.0, history[:, np.argmin(np.where(won, score, np.inf))], True
            if number == 0:
                continue  # what has only turned has not shown yet where it leads
            if score.min() < nearest:
                nearest, best = float(score.min()), history[:, np.argmin(score)]
            chosen = self._select(score)
            trials.copy_trials(chosen)
            peak = peak.reshape(-1, count)[:, chosen].ravel()
            history, spent = history[:, chosen], spent[chosen]
        return nearest, best, False

    def _draw(self, last: Control, number: int, attempt: int) -> Control:
        """Draw a control for each candidate.

        In the first round they turn the tip to all sides, and pull back, in later attempts farther; in the second most
        go straight on; then they move at random, and a few go on with what they did.
        """
        count, config, random = self.trials.count, self.config, self.random
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
        drawn = self.trials.control(Move(WIRE, np.clip(speed, -1.0, 1.0) * config.speed_mm_s, turn))
        if self.trials.devices > 1 and not self._rests:
            way = random.random(count)
            alike = np.where(way < _RESTS + _FOLLOWS, random.uniform(0.0, 1.0, count), speed)
            drawn[:, CATHETER, 0] = np.where(way < _RESTS, 0.0, np.clip(alike, -1.0, 1.0)) * config.speed_mm_s
        same = (random.random(count) < 0.2) & (number > 1)
        drawn[same] = last[same]
        return drawn

    def _run_round(self, control: Control, before: Control, waypoint: float, peak: Float[np.ndarray, "worlds"]) -> Each:
        """Drive all candidates for a round; return what it cost each, and note the largest forces."""
        trials, cost = self.trials, self.config.cost
        spent = cost.roughness(before[:, WIRE], control[:, WIRE], trials.fastest)
        for _ in range(self.config.round_periods):
            step = trials.drive(control)
            tip = trials.tips[:, WIRE]
            running = cost.running(
                error=self._distance(step.tip_position[:, WIRE], waypoint),
                ratio=safety_ratio(tip.offset, tip.radius, self.navigation.device.tip_radius_mm),
                force_share=step.contact_force_max / self.navigation.force_limit_n,
            )
            spent += DECISION_PERIOD_S * trials.mean(np.where(step.valid, running, _FAILED_MM_S))
            np.maximum(peak, np.where(step.valid, step.contact_force_max, np.inf), out=peak)
        return spent

    def _distance(self, position: Float[np.ndarray, "n 3"], waypoint: float) -> Float[np.ndarray, "n"]:
        return np.linalg.norm(position - self.route.position(waypoint), axis=-1)

    def _judge(self, waypoint: float, spent: Each, gentle: Bool[np.ndarray, "worlds"]) -> tuple[Each, Each]:
        """Return each candidate's cost so far and to go, and the share of its wires that passed gently."""
        trials, route = self.trials, self.route
        tip = trials.tips[:, WIRE]
        to_go = self._distance(trials.simulator.tip_position[:, WIRE], waypoint) + _OFF_ROUTE * route.off_route(tip)
        passed = route.passed(tip, waypoint) & trials.simulator.valid & gentle
        return trials.mean(to_go) + spent, trials.mean(passed)

    def _select(self, score: Each) -> Int[np.ndarray, "candidates"]:
        """Return whose copy each candidate becomes: the best stay and are copied over the others."""
        best = np.argsort(score)[: max(1, round(self.config.keep_share * len(score)))]
        others = self.random.choice(best, len(score) - len(best))
        return np.concatenate([best, others])


_LOOK_PERIODS, _KEPT_PERIODS = 8, 4
"""Decision periods over which candidates are compared, once or twice, and those of them that the best keeps."""
_SPEEDS = (-0.5, -0.25, 0.0, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0)
"""Translations that are drawn, as shares of the speed of a straight push."""
_TURNS = (-1.0, -1.0, -0.5, 0.0, 0.5, 1.0, 1.0)
"""Rotations that are drawn, as shares of the fastest."""
_CATHETER_SPEEDS, _CATHETER_TURNS = (-0.25, 0.25, 0.5, 1.0), (-1.0, 0.0, 0.0, 1.0)
"""The same of a catheter."""
_DEEPER_MM = 30.0
"""A catheter's tip may lie so much deeper than where it is to be held, mm."""
_AT_REST, _ALONG = 0.5, 0.25
"""Shares of the candidates in which the catheter rests, and in which it is pushed and pulled as the wire is: what lies
in loops where it is around the wire holds back its tip too."""
_CATHETER_GAIN = 0.5
"""What a millimetre is worth by which the catheter comes nearer to its place, mm of the route."""
_SLACK_MM, _TAUT_COST, _SLACK_COST = 10.0, 0.2, 0.1
"""Devices with so much slack press on, mm; what a millimetre less costs, since taut ones have to be pushed first, and
what one more costs, mm of the route."""
_LOOPS_MM, _LOOPS_COST = 40.0, 0.4
"""Beyond so much slack, mm, and beyond what the outer walls of a wide lumen take, a millimetre costs so much more: what
is pushed then is laid into loops."""


class ConstantMotions(Sampler):
    """Candidates of a wire and its catheter, each with a motion of its own."""

    _last: Float[np.ndarray, "devices 2"] | float = 0.0
    """The motion that was best before."""

    @property
    def _free_mm(self) -> float:
        """How far behind the wire's tip a catheter stays, mm: behind its bend."""
        return self.config.manoeuvres.behind_mm + self.navigation.device.tip_bend_length_mm

    @cached_property
    def _loops_mm(self) -> float:
        """Slack beyond which devices are laid into loops, mm."""
        return max(self.route.outer_mm(self.route.narrow_from()), _LOOPS_MM)

    def best(self, one: Trials, held_at: float, least_mm: float) -> tuple[Controls, float]:
        """Return the best of the motions that were drawn, and how far it brings the devices on, mm.

        Where none brings them on they go on for as long again, and the wire's tip alone counts: slack has to be laid
        down before it presses on, and takes the catheter's tip back.

        Args:
            one: the devices, where all candidates begin.
            held_at: where along the route the catheter's tip is to be held, mm.
            least_mm: a motion that brings them on so far will do, mm.
        """
        trials, limit_n = self.trials.copy_of(one), self.navigation.force_limit_n
        control = trials.possible(self._draw(), alike=True, periods=_LOOK_PERIODS)
        gentle, arrives = np.ones(trials.count, dtype=bool), np.full(trials.count, sys.maxsize)
        gain, kept = np.zeros(trials.count), 0
        for catheter_gain in (_CATHETER_GAIN, 0.0):
            kept += _KEPT_PERIODS
            for _ in range(_LOOK_PERIODS):
                gentle &= ~trials.move(self._unless_full(control) if catheter_gain == 0 else control, force_n=limit_n)
                there = gentle & ~trials.still & trials.all(self.navigation.reached(trials.tips))
                arrives[there] = len(trials.rows)
                trials.still |= there
            come = self._come(trials, held_at, catheter_gain) - float(self._come(one, held_at, catheter_gain)[0])
            gain = np.where(gentle, come, -np.inf)
            gain[arrives < sys.maxsize] = np.inf
            if gain.max() >= least_mm:
                break
        chosen, periods = int(np.argmax(gain)), kept
        if gain[chosen] == np.inf:
            chosen, periods = int(np.argmin(arrives)), int(arrives.min())
        self._last = control[chosen]
        return np.array([row.control[chosen] for row in trials.rows[:periods]]), float(gain[chosen])

    def _unless_full(self, control: Control) -> Control:
        """Return a control that does not push devices whose loops are full: they come forward as they unbend."""
        full = self._slack(self.trials) > self._loops_mm
        made = control.copy()
        made[full, :, 0] = np.minimum(made[full, :, 0], 0.0)
        return made

    def _slack(self, trials: Trials) -> Each:
        return trials.deepest - trials.progress(self.route)

    def _draw(self) -> Control:
        """Draw a motion for each candidate; the first goes on as was best before, the second is pushed straight."""
        trials, random, fast = self.trials, self.random, self.config.speed_mm_s
        turn = min(self.config.turn_rad_s, float(trials.fastest[1]))

        def draw(speeds: tuple[float, ...], turns: tuple[float, ...]) -> tuple[Each, Each]:
            return fast * random.choice(speeds, trials.count), turn * random.choice(turns, trials.count)

        control = trials.control(
            Move(WIRE, *draw(_SPEEDS, _TURNS)), Move(CATHETER, *draw(_CATHETER_SPEEDS, _CATHETER_TURNS))
        )
        way = random.random(trials.count)
        control[way < _AT_REST, CATHETER] = 0.0
        along = way > 1 - _ALONG
        control[along, CATHETER, 0] = control[along, WIRE, 0]
        control[0], control[1] = self._last, [[fast, 0.0], [0.0, 0.0]]
        return control

    def _come(self, trials: Trials, held_at: float, catheter_gain: float) -> Each:
        """Return how far along the route candidates have come, mm, less by how far off it or past the target they are.

        Loops make it less, and a catheter that is not yet where it is to be held, behind the bent tip of the wire.
        """
        tips, target = trials.tips, self.route.target.abscissa
        along = self.route.progress(tips) - self.route.off_route(tips)
        wire, catheter = trials.mean(along[:, WIRE]), trials.mean(along[:, CATHETER])
        deeper = np.maximum(catheter - held_at - _DEEPER_MM, 0.0)
        catheter = np.minimum(np.minimum(catheter, held_at), wire - self._free_mm) - deeper
        wire = wire - 2 * np.maximum(wire - target, 0.0)
        slack = self._slack(trials)
        taut = _TAUT_COST * np.maximum(_SLACK_MM - slack, 0.0)
        loose = _SLACK_COST * np.maximum(slack - _SLACK_MM, 0.0) + _LOOPS_COST * np.maximum(slack - self._loops_mm, 0.0)
        return wire + catheter_gain * catheter - taut - loose
