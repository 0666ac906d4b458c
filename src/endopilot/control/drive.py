"""What becomes of motions that are driven side by side towards a place of the route: `Driver`, `Outcome`.

A motion has four steps, each of which a trial takes when it is done with the one before: the devices are *placed*, all
are *turned*, all are *retracted*, and they are *pushed on* until they pass the place. A catheter follows its wire by
some lead, or the wire waits in it; soft devices keep what they are driven with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.course import Controls
from endopilot.control.trials import CATHETER, WIRE, Control, Each, Trials
from endopilot.settings import Positive, Seconds, Within, settings
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

Halt = Literal["off", "stalled", "slipped", "pressed", "late"]
"""A wire leaves the route, does not come forward though it is pushed, cannot be pushed without the drive's slipping,
presses on the wall too hard, or the time is over."""
PLACE, TURN, RETRACT, PUSH = range(4)
"""Steps of a motion."""
_SLIP_SHARE = 0.5
"""A drive slips that advances the wire by less than this share of what is commanded in a period."""
_SLOWEST_MM_S = 1.0
"""Speed of a wire that is about to arrive, at least, mm/s."""
_BEYOND_MM = 4.0
"""Wires of which some are this far beyond a place, in the mean, and others before it, will not pass it together."""
_AT_MM, REST_MM = 1.0, 0.1
"""A device this near to its place is there, mm; what is this near to its goal rests."""
ROUNDING = 1e-9
"""What rounding may take off a sum of weights."""
_LATE = 2
"""Trials that need this many times as long as the first of them to pass are given up."""


_CATHETER_SHARE = 0.5
"""What a millimetre is worth by which a catheter follows its wire, mm."""
_MISS_MM, _FORCE_MM, _SLACK, _MM_S = 10.0, 8.0, 0.05, 0.1
"""What it costs to leave all wires before the place and to press with the whole force limit, mm, what a millimetre of
slack costs, and what a second, mm/s."""


@settings
class SearchConfig:
    """How fast devices are moved in a search, and how a catheter follows its wire; `motions.yaml` has what is tried."""

    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Translation of a device that is pushed straight on, mm/s."""
    turn_rad_s: Annotated[float, Within(0.01, 1000)] = 7.0
    """Fastest rotation that is tried, rad/s."""
    lead_mm: Positive = 4.0
    """Devices are turned this far before a junction, mm, or 1.4 lumen radii where that is more."""
    behind_mm: Positive = 10.0
    """The catheter follows to this far behind the wire's tip, mm, except to the target if its own tip is to arrive."""
    together: bool = False
    """The wire goes on while its catheter follows, instead of resting: in half the time."""
    longest_s: Seconds = 30.0
    """A motion that leads past a place takes this much longer than twice the way at full speed at most, s."""


class Motions(NamedTuple):
    """Motions, one of each trial.

    Attributes:
        at_mm: where along its vessel the tip of a wire alone, or of the catheter, is placed, mm; NaN: it stays.
        lead_mm: how much deeper than its catheter the wire is then, mm.
        turn_rad: by which all devices are turned.
        back_mm: by which all devices are then retracted.
        follow_mm: how far the wire then leads before its catheter follows, mm; where this is negative the wire's tip
            stays so deep in the catheter until the catheter's tip is past. NaN: the devices keep their `velocity`.
        velocity: translation (mm/s) and rotation (rad/s) of each device.
    """

    at_mm: Each
    lead_mm: Each
    turn_rad: Each
    back_mm: Each
    follow_mm: Each
    velocity: Control


@dataclass(frozen=True, eq=False)
class Goal:
    """A place of the route, and when trials are past it.

    Attributes:
        navigation, route: of which it is.
        at_mm: the place, mm; the target's own is the last.
        agree: share of the wires, by weight, that has to come to the last place.
    """

    navigation: Navigation
    route: Route
    at_mm: float
    agree: float = 1.0

    @property
    def last(self) -> bool:
        """Whether the place is the target."""
        return self.at_mm >= self.route.target.abscissa

    def passed(self, trials: Trials) -> Bool[np.ndarray, "worlds"]:
        """Return which worlds are past the place, or at the target."""
        route, tip = self.route, trials.foremost
        if self.last and trials.devices > 1:
            return self.navigation.reached(trials.tips)
        if self.last or (self.at_mm in route.waypoints and trials.devices == 1):
            return route.passed(tip, self.at_mm)
        on_route = route.off_route(tip) == 0
        return (on_route | (self.at_mm not in route.waypoints)) & (route.progress(tip) >= self.at_mm)

    def arrived(self, trials: Trials) -> Bool[np.ndarray, "trials"]:
        """Return which trials are past it with all wires that count."""
        return trials.all(self.passed(trials))

    def suffices(self, share: Each) -> Bool[np.ndarray, "trials"]:
        """Return which shares of the wires, by weight, suffice."""
        return share >= (self.agree if self.last else 1.0) - ROUNDING

    def periods(self, begun_mm: float, config: SearchConfig) -> int:
        """Return after how many decision periods a trial that has begun at a place, mm, is given up."""
        seconds = 2 * max(self.at_mm - begun_mm, 0.0) / config.speed_mm_s + config.longest_s
        return round(seconds / DECISION_PERIOD_S)

    def to_go(self, trials: Trials, behind_mm: float) -> Each:
        """Return how far each trial has to go, mm.

        That is to the place, back from where it has left the route, and half as much for what its catheter lies farther
        behind the wire's tip than it is to.
        """
        tip, route = trials.foremost, self.route
        to_go = trials.mean(np.abs(self.at_mm - route.progress(tip)) + route.off_route(tip))
        if trials.devices > 1:
            wire, catheter = (trials.mean(route.progress(trials.tips[:, each])) for each in (WIRE, CATHETER))
            to_go += _CATHETER_SHARE * np.maximum(wire - behind_mm - catheter, 0.0)
        return to_go


@dataclass(frozen=True)
class Limits:
    """When trials are given up.

    Attributes:
        force_n: wall force on a node beyond which they press too hard, N.
        off_mm: they may be so far in a branch that does not lie on the route, mm.
        slack_mm: they may be pushed so far without coming forward, mm.
    """

    force_n: float
    off_mm: float
    slack_mm: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of trials.

    Attributes:
        motions: of the trials.
        controls: of each trial, in each period since they began.
        periods: of these, those until each was given up or passed.
        share: how many of the wires each brought past the place, by weight; 0 of one that presses too hard.
        force: largest wall force on a node of any wire that counts, N.
        farthest: how far along the route each came, mm.
        to_go: see `Goal.to_go`, mm.
        nearest: the least that it was on the way, mm.
        slack: how much deeper than it has come each is inserted at its end, mm: what lies in loops.
        halt: why each that did not pass was given up.
    """

    motions: Motions
    controls: Float[np.ndarray, "periods trials devices 2"]
    periods: Int[np.ndarray, "trials"]
    share: Each
    force: Each
    farthest: Each
    to_go: Each
    nearest: Each
    slack: Each
    halt: list[Halt]

    def controls_of(self, trial: int) -> Controls:
        """Return the controls of one trial."""
        return self.controls[: self.periods[trial], trial]

    @property
    def left_mm(self) -> Each:
        """How far each trial has to go, and what its slack adds, mm."""
        return self.to_go + _SLACK * np.maximum(self.slack, 0.0)

    def cost(self, force_limit_n: float, *, on_the_way: bool = False) -> Each:
        """Return what each trial costs, mm.

        That is the share of the wires that it leaves before the place, how far these have to go, the square of its
        largest force as a share of a limit (N), its slack, and its time.

        Args:
            on_the_way: count how far they had to go where they were nearest, not where they ended: what is drawn
                around a trial that fell off a branch's mouth may enter it.
        """
        return (
            (1.0 - self.share) * (_MISS_MM + (self.nearest if on_the_way else self.to_go))
            + _FORCE_MM * (self.force / force_limit_n) ** 2
            + _SLACK * np.maximum(self.slack, 0.0)
            + _MM_S * DECISION_PERIOD_S * self.periods
        )

    def expected_cost(self, force_limit_n: float) -> Each:
        """Return the mean cost of each trial and those beside it, since rotations err.

        Trials that are turned otherwise, but else do the same, weigh by the square of the cosine of the difference.
        """
        motions = self.motions
        weight = np.maximum(np.cos(motions.turn_rad[:, None] - motions.turn_rad), 0.0) ** 2
        for each in (motions.at_mm, motions.lead_mm, motions.follow_mm):
            weight *= np.nan_to_num(each)[:, None] == np.nan_to_num(each)
        return weight @ self.cost(force_limit_n) / weight.sum(axis=1)


class Driver:
    """Drives trials through their motions, see the module."""

    def __init__(self, trials: Trials, motions: Motions, goal: Goal, limits: Limits, config: SearchConfig) -> None:
        """Take trials, a motion of each, the place that they are to pass, and when they are given up."""
        self._trials, self._motions, self._goal, self._limits, self._config = trials, motions, goal, limits, config
        self._step, self._alone = np.zeros(trials.count, dtype=int), trials.devices == 1
        self._turn, self._back = motions.turn_rad.copy(), motions.back_mm.copy()
        self._towards = np.sign(np.nan_to_num(self._to_place()))
        self._follows = np.zeros(trials.count, dtype=bool)
        self._behind = np.minimum(motions.follow_mm, config.behind_mm)
        self._halt = np.full(trials.count, "late", dtype=object)

    def run(self, periods: int) -> Outcome:
        """Drive for some decision periods at most, or until each trial has passed the place or is given up."""
        trials, goal, limits, begun = self._trials, self._goal, self._limits, len(self._trials.rows)
        took, passed = np.full(trials.count, begun), np.zeros(trials.count, dtype=bool)
        been = np.zeros(trials.simulator.worlds, dtype=bool)
        farthest, inserted_there = trials.progress(goal.route), trials.deepest
        nearest = goal.to_go(trials, self._config.behind_mm)
        end = begun + min(periods, goal.periods(float(farthest.min()), self._config))
        while len(trials.rows) < end:
            control = self._control()
            going, pushing, before = ~trials.still, self._step == PUSH, trials.lengths[:, WIRE]
            rests = going & pushing & ~control.any(axis=(1, 2))
            passed |= rests & goal.suffices(trials.mean(been))
            self._stop(rests, "stalled")
            if trials.still.all():
                break
            going &= ~rests
            self._stop(trials.move(control, force_n=limits.force_n), "pressed")
            took[going] = len(trials.rows)
            progress, inserted = trials.progress(goal.route), trials.deepest
            ahead = pushing | (self._alone & (control[:, WIRE, 0] > 0))
            inserted_there = np.where((progress > farthest + REST_MM) | ~ahead, inserted, inserted_there)
            farthest = np.where(ahead, np.maximum(farthest, progress), progress)
            nearest = np.minimum(nearest, goal.to_go(trials, self._config.behind_mm))
            been = goal.passed(trials) | (been & goal.last)
            self._stop(pushing & _slips(trials, before) & self._alone, "slipped")
            ends = pushing & (self._alone | np.isnan(self._motions.follow_mm))  # others pass once they rest
            arrives = ends | (self._alone & goal.last)  # at its target, whatever it was doing
            passed |= going & arrives & ~trials.still & goal.suffices(trials.mean(been))
            trials.still |= passed
            self._stop(ends & (progress >= goal.at_mm + _BEYOND_MM), "off")
            if passed.any():
                end = min(end, begun + _LATE * (int(took[passed].min()) - begun))
            self._stop(pushing & ~trials.all(goal.route.off_route(trials.foremost) <= limits.off_mm), "off")
            self._stop(ahead & (inserted - inserted_there > limits.slack_mm), "stalled")
        trials.still[:] = False
        share = np.where(passed, 1.0, trials.mean(goal.passed(trials)))
        return Outcome(
            motions=self._motions,
            controls=np.array([row.control for row in trials.rows]).reshape(-1, trials.count, trials.devices, 2),
            periods=took,
            share=np.where(self._halt == "pressed", 0.0, share),
            force=_largest_force(trials, took),
            farthest=farthest,
            to_go=goal.to_go(trials, self._config.behind_mm),
            nearest=nearest,
            slack=trials.deepest - trials.progress(goal.route),
            halt=self._halt.tolist(),
        )

    def _stop(self, which: Bool[np.ndarray, "trials"], why: Halt) -> None:
        self._halt[which & ~self._trials.still] = why
        self._trials.still |= which

    def _control(self) -> Control:
        """Return what each trial does next; one that is done with a step takes the next."""
        trials, step, config = self._trials, self._step, self._config
        placing, placed = self._place()
        step[(step == PLACE) & placed] = TURN
        step[(step == TURN) & (self._turn == 0)] = RETRACT
        step[(step == RETRACT) & (self._back <= 0)] = PUSH
        control = np.where((step == PLACE)[:, None, None], placing, self._push())
        turn = np.clip(self._turn / DECISION_PERIOD_S, -config.turn_rad_s, config.turn_rad_s) * (step == TURN)
        back = np.clip(self._back / DECISION_PERIOD_S, 0.0, 2 * config.speed_mm_s) * (step == RETRACT)
        control[(step == TURN) | (step == RETRACT)] = 0.0
        control[..., 1] += turn[:, None]
        control[..., 0] -= back[:, None]
        self._turn = np.where(trials.still, self._turn, self._turn - turn * DECISION_PERIOD_S)
        self._back = np.where(trials.still, self._back, self._back - back * DECISION_PERIOD_S)
        return control

    def _to_place(self) -> Each:
        """Return how far the tips that are placed are from their places, mm; NaN of those that stay."""
        guide = WIRE if self._alone else CATHETER
        return self._motions.at_mm - self._trials.mean(self._trials.tips.abscissa[:, guide])

    def _place(self) -> tuple[Control, Bool[np.ndarray, "trials"]]:
        """Return what brings devices towards their places, and which are there, or past them: none turns back, since
        slack would let it hunt."""
        trials, motions, fastest = self._trials, self._motions, 2 * self._config.speed_mm_s
        left = np.nan_to_num(self._to_place() * self._towards)
        moves = left > _AT_MM
        speed = self._towards * np.clip(left / DECISION_PERIOD_S, self._config.speed_mm_s / 2, fastest) * moves
        if self._alone:
            return trials.control(speed), ~moves
        gap = np.maximum(trials.inserted(CATHETER) + speed * DECISION_PERIOD_S + motions.lead_mm, 0.0)
        gap = np.where(np.isnan(motions.at_mm), 0.0, gap - trials.inserted(WIRE))
        gap = np.where(np.abs(gap) > REST_MM, gap, 0.0)
        wire = np.clip(gap / DECISION_PERIOD_S, -2 * fastest, 2 * fastest)
        return trials.control(wire, speed), ~moves & (gap == 0)

    def _push(self) -> Control:
        """Return what pushes devices on: a wire alone the slower, the nearer to the target."""
        trials, goal, speed = self._trials, self._goal, self._config.speed_mm_s
        control = self._motions.velocity.copy()
        progress = trials.progress(goal.route)
        if not self._alone:
            follows = ~np.isnan(self._motions.follow_mm)
            if follows.any():
                control[follows] = self._following(progress)[follows]
        else:
            left = (goal.route.target.abscissa - progress) / DECISION_PERIOD_S
            control[:, WIRE, 0] = np.where(left < 0, -1.0, 1.0) * np.clip(np.abs(left), _SLOWEST_MM_S, speed)
        return control

    def _following(self, progress: Each) -> Control:
        """Return what drives wires on, and catheters once they follow, from how far along the route they are, mm."""
        trials, goal = self._trials, self._goal
        left = goal.at_mm - progress if goal.last else np.where(goal.arrived(trials), 0.0, np.inf)
        wire, catheter = self._in_turn(progress, left)
        inside = self._motions.follow_mm < 0
        if inside.any():
            wire_too, catheter_too = self._inside(left)
            wire, catheter = np.where(inside, wire_too, wire), np.where(inside, catheter_too, catheter)
        return trials.control(wire, catheter)

    def _in_turn(self, progress: Each, left: Each) -> tuple[Each, Each]:
        """Return the speeds, mm/s, of wires that lead, and of catheters that then follow until they are as far behind.

        Beyond a target to which the catheter's tip is to go, the wire goes as far as the catheter stays behind it
        elsewhere: the less, the fewer of its stiffer parts lie in the bends behind.
        """
        trials, goal, config = self._trials, self._goal, self._config
        inserted, around = trials.inserted(WIRE), trials.inserted(CATHETER)
        behind = inserted - self._behind - around
        if goal.last and goal.navigation.arriving:
            end = goal.route.anatomy.tree.branches[goal.route.target.branch].centerline.abscissa[-1]
            left = np.clip(goal.at_mm + self._behind, goal.at_mm, max(float(end) - REST_MM, goal.at_mm)) - progress
            behind = np.minimum(goal.at_mm - trials.mean(trials.tips.abscissa[:, CATHETER]), inserted - around)
        there = np.abs(left) <= REST_MM
        if goal.last and config.together and not goal.navigation.arriving:
            there |= goal.arrived(trials)
        follows = self._follows | there | (inserted - around >= self._motions.follow_mm)
        self._follows = (self._step == PUSH) & (behind > REST_MM) & follows
        rests = there | (self._follows & (not config.together))
        wire = np.where(rests, 0.0, np.clip(left / DECISION_PERIOD_S, -_SLOWEST_MM_S, config.speed_mm_s))
        return wire, np.where(self._follows, np.clip(behind / DECISION_PERIOD_S, 0.0, config.speed_mm_s), 0.0)

    def _inside(self, left: Each) -> tuple[Each, Each]:
        """Return the speeds, mm/s, of wires that stay in catheters until these are past the place, and of these."""
        trials, speed = self._trials, self._config.speed_mm_s
        past = np.abs(left) <= _AT_MM
        catheter = np.where(past, 0.0, np.clip(left / DECISION_PERIOD_S, -_SLOWEST_MM_S, speed))
        deep = np.where(past, 0.0, self._motions.follow_mm)
        gap = np.maximum(trials.inserted(CATHETER) + deep, 0.0) - trials.inserted(WIRE)
        wire = np.clip(gap / DECISION_PERIOD_S, -2 * speed, speed)
        withdrawn = gap >= -_AT_MM  # the wire comes out of the way first
        return np.where(np.abs(gap) > REST_MM, wire, 0.0), np.where(withdrawn, catheter, 0.0)


def _slips(trials: Trials, before: Float[np.ndarray, "worlds"]) -> Bool[np.ndarray, "trials"]:
    """Return which drives have slipped in the last period, given the wires' inserted lengths before, mm."""
    commanded = np.tile(trials.rows[-1].control[:, WIRE, 0], trials.wires) * DECISION_PERIOD_S
    return ~trials.all((trials.lengths[:, WIRE] - before >= _SLIP_SHARE * commanded) | (commanded < 0))


def _largest_force(trials: Trials, periods: Int[np.ndarray, "trials"]) -> Each:
    """Return the largest force in the first periods of each trial, N."""
    force = np.array([row.force for row in trials.rows]).reshape(-1, trials.wires, trials.count)
    within = np.arange(len(force))[:, None] < periods
    return np.where(within, force[:, trials.counted].max(axis=1), 0.0).max(axis=0, initial=0.0)
