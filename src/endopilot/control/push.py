"""Push trials of a stack on along a route: `turn` them to all sides, then `Push` them past a place; `middle` chooses.

A wire alone is given up as soon as it stops. In a catheter it may come on again when the catheter follows, so it is
given more: the wire goes ahead by some lead and the catheter follows, or the wire waits in the catheter.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.course import Controls
from endopilot.control.search_config import SearchConfig
from endopilot.control.trials import CATHETER, STALL_PERIODS, WIRE, Control, Move, Period, Trials
from endopilot.devices.drive_limits import SLACK_WIDTHS
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

Halt = Literal["off", "stalled", "slipped", "pressed", "late"]
"""A wire leaves the route, does not come forward though it is pushed, cannot be pushed without the drive's slipping,
presses on the wall too hard, or the time is over."""
Each = Float[np.ndarray, "trials"]
TURN_PERIODS = 2
"""Decision periods in which devices are turned, half a turn at most."""
ALL_ALONG_MM = 1000.0
"""The lead of a wire that goes all the way before its catheter follows."""
_SLIP_SHARE = 0.5
"""A drive slips that advances the wire by less than this share of what is commanded in a period."""
_SLOWEST_MM_S = 1.0
"""Speed of a wire alone that is about to arrive, at least; in a catheter, of one that has gone too far, mm/s."""
_BEYOND_MM = 4.0
"""Wires of which some are this far beyond a waypoint, in the mean, and others before it, will not pass it together."""
_OFF_MM = 4.0
"""A tip that is this far in a wrong branch does not come back, mm: in a wide fork it may seem to leave the route."""
_OFF_WIDE_MM, _OFF_RADII = 5.0, 2.0
"""The same where there is a catheter, or a wide lumen: this far, and as many radii of the route's lumen."""
_MOUTH_RADII = 1.4
"""Half the width of a branch's mouth, lumen radii."""
_SLACK_MM = 40.0
"""A wire that was pushed this far and did not come forward folds, mm; in a wide lumen see `SLACK_WIDTHS`."""
LOOPS_MM = 120.0
"""The same of soft devices that move together: what they lay into loops in a wide lumen holds what comes after, mm."""
_AT_MM, REST_MM = 1.0, 0.1
"""A catheter this near to its place is there, mm; what is this near to its goal rests."""
_LATE = 2
"""Where time is short, trials that need this many times as long as the first of them to pass are given up."""


@dataclass(frozen=True, eq=False)
class Pushed:
    """What became of trials that were pushed.

    Attributes:
        rows: what they did since they were put where they began.
        periods: of these, those until each was given up or passed.
        passed: which brought all wires that count past the place.
        force: largest wall force on a node of any wire that counts, N.
        farthest: how far along the route each came, mm.
        slack: how much deeper than that each is inserted at its end, mm: what lies in loops.
        halt: why each that did not pass was given up.
    """

    rows: list[Period]
    periods: Int[np.ndarray, "trials"]
    passed: Bool[np.ndarray, "trials"]
    force: Each
    farthest: Each
    slack: Each
    halt: list[Halt]

    def within(self, force_n: float, slack_mm: float = np.inf) -> Bool[np.ndarray, "trials"]:
        """Return which pass without pressing on the wall with more than some force, N, or ending in more slack, mm."""
        return self.passed & (self.force <= force_n) & (self.slack <= slack_mm)

    @property
    def moving(self) -> Int[np.ndarray, "trials"]:
        """Periods in which each trial moves, without those in which it waits for others."""
        moves = [row.control.any(axis=(1, 2)) & (k < self.periods) for k, row in enumerate(self.rows)]
        return np.sum(moves, axis=0, dtype=int)

    def controls(self, trial: int) -> Controls:
        """Return the controls of one trial."""
        return np.array([row.control[trial] for row in self.rows[: self.periods[trial]]])


def turn(trials: Trials, angle: Each, *, periods: int = TURN_PERIODS, force_n: float = np.inf) -> None:
    """Turn all devices of each trial alike.

    Args:
        trials: the stacks.
        angle: rad.
        periods: decision periods that there is time for.
        force_n: force on the wall that is too hard, N.
    """
    speed = angle / (TURN_PERIODS * DECISION_PERIOD_S)
    control = trials.control(*(Move(device, rotation=speed) for device in range(trials.devices)))
    for _ in range(min(periods, TURN_PERIODS)):
        trials.still |= trials.move(control, force_n=force_n)


def sides(count: int) -> Each:
    """Return angles evenly over a full turn, from half a turn back on, rad."""
    return 2 * np.pi * (np.arange(count) / count - 0.5)


def stand_off(route: Route, at_mm: float, least_mm: float) -> float:
    """Return how far before or beyond a place of the route devices are turned, mm: a branch's mouth is about as wide.

    Args:
        route: to the target.
        at_mm: the place, mm.
        least_mm: in a narrow vessel, mm.
    """
    return max(least_mm, _MOUTH_RADII * float(route.radius(np.array([at_mm]))[0]))


def middle(passed: Bool[np.ndarray, "rotations"]) -> int:
    """Return the rotation in the middle of the longest run of those that pass, counted around the full turn."""
    if passed.all() or not passed.any():
        return 0
    twice = np.concatenate([passed, passed])
    length = np.zeros(len(twice), dtype=int)
    for index in np.flatnonzero(twice):
        length[index] = 1 + (length[index - 1] if index else 0)
    end = int(np.argmax(length))
    return (end - int(length[end]) // 2) % len(passed)


@dataclass(frozen=True, eq=False)
class Push:
    """How trials are pushed past a place of the route.

    Attributes:
        route: to the target.
        navigation: with the force limit, at which a trial is given up.
        config: speed, and how catheters follow.
        waypoint: the place, mm; the target's own ends the push there.
        strict: whether a wire alone is given up at the first sign that it will not pass, since there are other ways.
    """

    route: Route
    navigation: Navigation
    config: SearchConfig
    waypoint: float
    strict: bool = False

    @property
    def last(self) -> bool:
        """Whether the place is the target."""
        return self.waypoint >= self.route.target.abscissa

    def spreads(self, trials: Trials) -> bool:
        """Return whether wires may come to the place one after another: to a target in a wide lumen."""
        return self.last and trials.devices == 1 and self.route.is_wide(self.waypoint)

    def run(self, trials: Trials, periods: int, lead: Each | None = None) -> Pushed:
        """Push trials past the place, and tell which pass.

        Args:
            trials: the stacks; those that stand still are given up already.
            periods: decision periods that there are.
            lead: how far each wire leads before its catheter follows, mm; where it is negative the wire's tip stays so
                deep in the catheter until the catheter's tip is past. A wire leads all along if not given.
        """
        alone, begun = trials.devices == 1, len(trials.rows)
        took, halt = np.full(trials.count, begun), np.full(trials.count, "late", dtype=object)
        passed, been = np.zeros(trials.count, dtype=bool), np.zeros(trials.simulator.worlds, dtype=bool)
        progress = farthest = trials.progress(self.route)
        inserted_there, follower = trials.deepest, _Follower(self, trials, lead)
        beyond = progress > self.waypoint
        waits = alone and not self.strict and self.route.is_wide(self.waypoint)
        slack_mm = SLACK_WIDTHS * self.route.width_mm(self.waypoint) if waits else _SLACK_MM
        slack_mm = LOOPS_MM if self.config.manoeuvres.together and not alone else slack_mm
        off_mm, longest, force_n = self._limits(trials, waits)

        def stop(which: Bool[np.ndarray, "trials"], why: Halt) -> None:
            halt[which & ~trials.still] = why
            trials.still |= which

        if self.strict:
            stop(self._off(trials, off_mm), "off")
        longest, hurries = begun + min(periods, longest), self.config.manoeuvres.together
        while len(trials.rows) < longest:
            going, before = ~trials.still, trials.lengths[:, WIRE]
            control = self._straight(trials, progress) if alone else follower.control(progress)
            if not control[going].any():
                break
            rests = going & ~control.any(axis=(1, 2))
            if hurries and (rests & self.arrived(trials)).any():
                hurries, longest = False, min(longest, begun + _LATE * (len(trials.rows) - begun))
            presses = trials.move(control, force_n=force_n)
            took[going] = len(trials.rows)
            progress, inserted = trials.progress(self.route), trials.deepest
            inserted_there = np.where(progress > farthest + REST_MM, inserted, inserted_there)
            farthest = np.maximum(farthest, progress)
            if alone:
                stop(_slips(trials, before), "slipped")
            stop(presses, "pressed")
            if alone:
                stalls = self._stalls(trials, begun) & (not waits)
                stop(stalls & self.strict, "stalled")
                arrived = self.arrived(trials)
                if self.spreads(trials):
                    been |= self.route.passed(trials.foremost, self.waypoint)
                    arrived, was_beyond = trials.mean(been) > 0.5, beyond
                    beyond = progress > self.waypoint
                    stop(was_beyond & ~beyond & ~arrived, "off")
                passed |= ~trials.still & arrived
                trials.still |= passed
                stop(stalls, "stalled")
                missed = progress >= self.waypoint + _BEYOND_MM
                stop(missed & (not self.strict and not self.spreads(trials)), "off")
            stop(self._off(trials, off_mm), "off")
            stop(inserted - inserted_there > slack_mm, "stalled")
        if not alone:
            passed = self.arrived(trials) & ~trials.still
        trials.still[:] = False
        slack = trials.deepest - progress
        return Pushed(trials.rows, took, passed, _largest_force(trials, took), farthest, slack, halt.tolist())

    def arrived(self, trials: Trials) -> Bool[np.ndarray, "trials"]:
        """Return which trials are past the place, or at the target."""
        route, tip = self.route, trials.foremost
        if trials.devices == 1:
            return trials.all(route.passed(tip, self.waypoint))
        if self.last:
            return trials.all(self.navigation.reached(trials.tips))
        if self.waypoint in route.waypoints:
            return trials.all((route.off_route(tip) == 0) & (tip.abscissa >= self.waypoint))
        return trials.all(route.progress(tip) >= self.waypoint)

    def _straight(self, trials: Trials, progress: Each) -> Control:
        """Return what pushes wires alone on, slower near to the target, and in a wide lumen back to it."""
        left = self.waypoint - progress if self.last else np.full(trials.count, np.inf)
        speed = np.clip(left / DECISION_PERIOD_S, _SLOWEST_MM_S, self.config.speed_mm_s)
        if self.spreads(trials):
            back = np.clip(left / DECISION_PERIOD_S, -self.config.speed_mm_s, -_SLOWEST_MM_S)
            speed = np.where(left < 0, back, speed)
        return trials.control(Move(WIRE, speed))

    def _off(self, trials: Trials, off_mm: float) -> Bool[np.ndarray, "trials"]:
        return ~trials.all(self.route.off_route(trials.foremost) <= off_mm)

    def _limits(self, trials: Trials, waits: bool) -> tuple[float, int, float]:
        """Return how far in a wrong branch (mm), after how many periods, and at what force (N) a trial is given up."""
        limit_n, config = self.navigation.force_limit_n, self.config
        if self.strict:
            return 0.0, sys.maxsize, config.cost.forbidden_share * limit_n
        if trials.devices == 1:
            before = self.route.junctions[self.route.junctions < self.waypoint]
            wide_mm = _OFF_WIDE_MM + _OFF_RADII * float(self.route.radius(before[-1:]).max(initial=0.0))
            return wide_mm if waits else _OFF_MM, sys.maxsize, limit_n
        begun = float(trials.progress(self.route).min())
        off_mm = _OFF_WIDE_MM + _OFF_RADII * float(self.route.radius(np.array([begun, self.waypoint])).max())
        seconds = 2 * max(self.waypoint - begun, 0.0) / config.speed_mm_s + config.manoeuvres.longest_s
        return off_mm, round(seconds / DECISION_PERIOD_S), limit_n

    def _stalls(self, trials: Trials, begun: int) -> Bool[np.ndarray, "trials"]:
        if len(trials.rows) - begun < STALL_PERIODS:
            return np.zeros(trials.count, dtype=bool)
        return trials.stalled(self.route.progress, gains=STALL_PERIODS - self.strict)


class _Follower:
    """How a wire leads its catheter past a place."""

    def __init__(self, push: Push, trials: Trials, lead: Each | None) -> None:
        self._push, self._trials = push, trials
        self._lead = np.full(trials.count, ALL_ALONG_MM) if lead is None else lead
        self._follows = np.zeros(trials.count, dtype=bool)
        self._behind = np.minimum(self._lead, push.config.manoeuvres.behind_mm)

    def control(self, progress: Each) -> Control:
        """Return what drives wires on, and catheters once they follow, from how far along the route they are, mm."""
        push, trials = self._push, self._trials
        left = push.waypoint - progress if push.last else np.where(self._past(), 0.0, np.inf)
        wire, catheter = self._in_turn(progress, left)
        together = self._lead < 0
        if together.any():
            wire_too, catheter_too = self._together(left)
            wire, catheter = np.where(together, wire_too, wire), np.where(together, catheter_too, catheter)
        return trials.control(Move(WIRE, wire), Move(CATHETER, catheter))

    def _in_turn(self, progress: Each, left: Each) -> tuple[Each, Each]:
        """Return the speeds, mm/s, of wires that lead, and of catheters that then follow until they are as far behind.

        Beyond a target to which the catheter's tip is to go, the wire goes as far as the catheter stays behind it
        elsewhere: the less, the fewer of its stiffer parts lie in the bends behind.
        """
        push, trials, speed = self._push, self._trials, self._push.config.speed_mm_s
        inserted, around = trials.inserted(WIRE), trials.inserted(CATHETER)
        behind = inserted - self._behind - around
        if push.last and push.navigation.arriving:
            end = push.route.anatomy.tree.branches[push.route.target.branch].centerline.abscissa[-1]
            goal = np.clip(push.waypoint + self._behind, push.waypoint, max(float(end) - REST_MM, push.waypoint))
            left = goal - progress
            behind = np.minimum(push.waypoint - trials.mean(trials.tips.abscissa[:, CATHETER]), inserted - around)
        there = np.abs(left) <= REST_MM
        if push.last and push.config.manoeuvres.together and not push.navigation.arriving:
            there |= trials.all(push.navigation.reached(trials.tips))
        self._follows = (behind > REST_MM) & (self._follows | there | (inserted - around >= self._lead))
        rests = there | (self._follows & (not push.config.manoeuvres.together))
        wire = np.where(rests, 0.0, np.clip(left / DECISION_PERIOD_S, -_SLOWEST_MM_S, speed))
        return wire, np.where(self._follows, np.clip(behind / DECISION_PERIOD_S, 0.0, speed), 0.0)

    def _together(self, left: Each) -> tuple[Each, Each]:
        """Return the speeds, mm/s, of wires that stay in catheters until these are past the place, and of these."""
        trials, speed = self._trials, self._push.config.speed_mm_s
        past = np.abs(left) <= _AT_MM
        catheter = np.where(past, 0.0, np.clip(left / DECISION_PERIOD_S, -_SLOWEST_MM_S, speed))
        gap = np.maximum(trials.inserted(CATHETER) + np.where(past, 0.0, self._lead), 0.0) - trials.inserted(WIRE)
        wire = np.clip(gap / DECISION_PERIOD_S, -2 * speed, speed)
        withdrawn = gap >= -_AT_MM  # the wire comes out of the way first
        return np.where(np.abs(gap) > REST_MM, wire, 0.0), np.where(withdrawn, catheter, 0.0)

    def _past(self) -> Bool[np.ndarray, "trials"]:
        """Return which tips are past a place before the target, within the branch if it is a waypoint."""
        push, tip = self._push, self._trials.foremost
        if push.waypoint in push.route.waypoints:
            return self._trials.all(push.route.passed(tip, push.waypoint))
        return self._trials.all(push.route.progress(tip) >= push.waypoint)


def _slips(trials: Trials, before: Float[np.ndarray, "worlds"]) -> Bool[np.ndarray, "trials"]:
    """Return which drives have slipped in the last period, given the wires' inserted lengths before, mm."""
    commanded = np.tile(trials.rows[-1].control[:, WIRE, 0], trials.wires) * DECISION_PERIOD_S
    return ~trials.all((trials.lengths[:, WIRE] - before >= _SLIP_SHARE * commanded) | (commanded < 0))


def _largest_force(trials: Trials, periods: Int[np.ndarray, "trials"]) -> Each:
    """Return the largest force in the first periods of each trial, N."""
    force = np.array([row.force for row in trials.rows]).reshape(-1, trials.wires, trials.count)
    within = np.arange(len(force))[:, None] < periods
    return np.where(within, force[:, trials.counted].max(axis=1), 0.0).max(axis=0, initial=0.0)
