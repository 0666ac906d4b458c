"""Motions that stay the same for some seconds, drawn at random, of which the best is taken: `ConstantMotions`.

A wire whose bent tip is turned as it is pushed gently enters a bend when the tip looks into it. A tip of curvature k in
a bend of curvature K takes EI (K - k)² / 2 of push where it looks into the bend, and EI (K + k)² / 2 where it looks out
of it: six times as much for 12 mm and 5 mm of radius. So devices that are too soft to be pushed on are turned on.
"""

from __future__ import annotations

import sys
from functools import cached_property

import numpy as np
from jaxtyping import Float

from endopilot.control.course import Controls
from endopilot.control.search_config import SearchConfig
from endopilot.control.trials import CATHETER, WIRE, Control, Move, Trials
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route

Each = Float[np.ndarray, "candidates"]
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
_RESTS, _ALONG = 0.5, 0.25
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


class ConstantMotions:
    """Candidates of a wire and its catheter, each with a motion of its own."""

    def __init__(
        self,
        navigation: Navigation,
        route: Route,
        trials: Trials,
        config: SearchConfig,
        random: np.random.Generator,
    ) -> None:
        """Take the candidates.

        Args:
            navigation: with the force limit.
            route: to the target.
            trials: a candidate each.
            config: settings of the search.
            random: what is drawn from.
        """
        self._navigation, self._route, self._trials = navigation, route, trials
        self._config, self._random = config, random
        self._last = np.zeros((trials.devices, 2))
        self._free_mm = config.manoeuvres.behind_mm + navigation.device.tip_bend_length_mm

    @cached_property
    def _loops_mm(self) -> float:
        """Slack beyond which devices are laid into loops, mm."""
        return max(self._route.outer_mm(self._route.narrow_from()), _LOOPS_MM)

    def best(self, one: Trials, held_at: float, least_mm: float) -> tuple[Controls, float]:
        """Return the best of the motions that were drawn, and how far it brings the devices on, mm.

        Where none brings them on they go on for as long again, and the wire's tip alone counts: slack has to be laid
        down before it presses on, and takes the catheter's tip back.

        Args:
            one: the devices, where all candidates begin.
            held_at: where along the route the catheter's tip is to be held, mm.
            least_mm: a motion that brings them on so far will do, mm.
        """
        trials, limit_n = self._trials.copy_of(one), self._navigation.force_limit_n
        control = trials.possible(self._draw(), alike=True, periods=_LOOK_PERIODS)
        gentle, arrives = np.ones(trials.count, dtype=bool), np.full(trials.count, sys.maxsize)
        gain, kept = np.zeros(trials.count), 0
        for catheter_gain in (_CATHETER_GAIN, 0.0):
            kept += _KEPT_PERIODS
            for _ in range(_LOOK_PERIODS):
                gentle &= ~trials.move(self._unless_full(control) if catheter_gain == 0 else control, force_n=limit_n)
                there = gentle & ~trials.still & trials.all(self._navigation.reached(trials.tips))
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
        full = self._slack(self._trials) > self._loops_mm
        made = control.copy()
        made[full, :, 0] = np.minimum(made[full, :, 0], 0.0)
        return made

    def _slack(self, trials: Trials) -> Each:
        return trials.deepest - trials.progress(self._route)

    def _draw(self) -> Control:
        """Draw a motion for each candidate; the first goes on as was best before, the second is pushed straight."""
        trials, random, fast = self._trials, self._random, self._config.speed_mm_s
        turn = min(self._config.turn_rad_s, float(trials.fastest[1]))

        def draw(speeds: tuple[float, ...], turns: tuple[float, ...]) -> tuple[Each, Each]:
            return fast * random.choice(speeds, trials.count), turn * random.choice(turns, trials.count)

        control = trials.control(
            Move(WIRE, *draw(_SPEEDS, _TURNS)), Move(CATHETER, *draw(_CATHETER_SPEEDS, _CATHETER_TURNS))
        )
        way = random.random(trials.count)
        control[way < _RESTS, CATHETER] = 0.0
        along = way > 1 - _ALONG
        control[along, CATHETER, 0] = control[along, WIRE, 0]
        control[0], control[1] = self._last, [[fast, 0.0], [0.0, 0.0]]
        return control

    def _come(self, trials: Trials, held_at: float, catheter_gain: float) -> Each:
        """Return how far along the route candidates have come, mm, less by how far off it or past the target they are.

        Loops make it less, and a catheter that is not yet where it is to be held, behind the bent tip of the wire.
        """
        tips, target = trials.tips, self._route.target.abscissa
        along = self._route.progress(tips) - self._route.off_route(tips)
        wire, catheter = trials.mean(along[:, WIRE]), trials.mean(along[:, CATHETER])
        deeper = np.maximum(catheter - held_at - _DEEPER_MM, 0.0)
        catheter = np.minimum(np.minimum(catheter, held_at), wire - self._free_mm) - deeper
        wire = wire - 2 * np.maximum(wire - target, 0.0)
        slack = self._slack(trials)
        taut = _TAUT_COST * np.maximum(_SLACK_MM - slack, 0.0)
        loose = _SLACK_COST * np.maximum(slack - _SLACK_MM, 0.0) + _LOOPS_COST * np.maximum(slack - self._loops_mm, 0.0)
        return wire + catheter_gain * catheter - taut - loose
