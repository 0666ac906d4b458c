"""A wire that is followed by its encoders under a belief: `Monitor`, which whoever drives may ask for X-ray.

An exposure is compared with what was predicted before it weighs the belief (`Innovations`). Where several disagree the
model is wrong, not the prediction unlucky: the bands widen, and X-ray is due every 1.5 s until two images lie in them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from endopilot.belief.bands import AdviserConfig, Calibration, Members, Predicted
from endopilot.belief.belief import Belief, BeliefConfig, Past
from endopilot.belief.drives import ahead_of_valve_n
from endopilot.belief.events import astray_mm
from endopilot.belief.identification import Explanation, Identified, explain
from endopilot.belief.patient_motion import FoundMotion
from endopilot.belief.states import Event, State, States
from endopilot.belief.thought import Budget, Pace, Thought
from endopilot.belief.watch import Innovations, Watch
from endopilot.devices.stack import Proximals
from endopilot.tasks.navigation import Navigation
from endopilot.xray.fluoroscope import TipMeasurement

_FORGETS, _PRIOR_N = 0.9, 0.1
"""What a period weighs a period later; and with what force the prior, that the drive pushes as predicted, counts, N."""
_LEAST_N = 0.02
"""A predicted force of less says nothing: noise hides it."""
_MARGIN = 0.25
"""A ratio is believed this much smaller than it is found: by so much it errs where the model is right, found on
patients to improve agents on."""


_ADVANCES, _OUTSIDE_SDS = 5, 1.645
"""A drive pushes otherwise than predicted where the mean of so many readings is outside a band of 90 %, in standard
deviations; it was 1.4 at most in 16 drives in worlds drawn to improve agents on, in which no stiff wire came far."""


class LoadRatio:
    """The force of a drive over the predicted one, by least squares with forgetting, while the wire advances.

    Walls press on a wire that is pushed harder by as much more: the ratio scales the wall forces of simulated wires.
    """

    def __init__(self) -> None:
        """Begin with a drive that pushes as predicted."""
        self._read = self._predicted = _PRIOR_N**2
        self._off = list[float]()

    def take(self, pushed_n: float, predicted_n: float, sd_n: float = np.inf) -> None:
        """Take a reading while the wire advances: the force ahead of the valve, N, what the model predicts of it, and
        the standard deviation of that, N; nothing lies outside its band if not given."""
        self._off.append((pushed_n - predicted_n) / sd_n)
        if predicted_n < _LEAST_N:
            return
        prior = (1 - _FORGETS) * _PRIOR_N**2
        self._read = _FORGETS * self._read + predicted_n * pushed_n + prior
        self._predicted = _FORGETS * self._predicted + predicted_n**2 + prior

    @property
    def outside(self) -> bool:
        """Whether the drive pushes otherwise than the model predicts: it warns before a wire that is held snaps."""
        last = self._off[-_ADVANCES:]
        return len(last) == _ADVANCES and abs(float(np.mean(last))) > _OUTSIDE_SDS

    @property
    def value(self) -> float:
        """The ratio that is surely exceeded, 1 at least."""
        return max(1.0, self._read / self._predicted - _MARGIN)


_MOST, _EVERY = 6, 3
"""The belief is changed as often at most, after as many further exposures at least."""
_LEAST_EXPOSURES, _OUTSIDE_MM = 3, 0.8
"""A motion of the vessel is looked for in as many exposures at least. Where none is known, one must have shown the tip
so far outside the lumen."""
_MOTION_SD_MM = np.array([0.6, 0.1])
"""Standard deviations of (Δtip, γtip) that a motion adds which was found, mm: measured in moving vessels."""


@dataclass(frozen=True)
class BelievedTip:
    """Where a tip is believed to be.

    Attributes:
        abscissa: Δtip, mm.
        offset: γtip, mm.
        half_width: of the bands around both in which the tip is expected, mm; infinite where no wire explains what
            X-ray showed, NaN without bands.
        asks: why X-ray is asked for at the next decision; empty if it is not.
        found: what was identified since the model was taken to be wrong, in words; empty if nothing was.
        branch: of the vessel, in which it is believed; -1 where that is not told.
    """

    abscissa: float
    offset: float
    half_width: tuple[float, float] = (np.nan, np.nan)
    asks: str = ""
    found: str = ""
    branch: int = -1


class Monitor:
    """Follows a wire that somebody drives, and says where its tip is and when an exposure is due.

    Example:
        monitor = Monitor(navigation, calibration)
        believed = monitor.step(encoders, load, exposure)   # every DECISION_PERIOD_S; the exposure that was asked for

    Attributes:
        belief: about the wire; another one once the model was taken to be wrong and another was identified.
        states: whether it is followed, sought, lost or changed.
        sought: whether one was sought for this exposure, and found.
        identified: what was found when the belief was last changed; None before.
        moves: how the vessel was found to move; None if it was not.
        seen: the last exposure, less that motion; None where X-ray is off.
        changes_left: how often it may still be changed.
    """

    def __init__(
        self,
        navigation: Navigation,
        calibration: Calibration | None,
        *,
        config: BeliefConfig | None = None,
        advice: AdviserConfig | None = None,
        members: Sequence[World] | None = None,
        pace: Pace | None = None,
        settles: int = 0,
    ) -> None:
        """Lay out the simulated wires at the start of a navigation.

        Args:
            calibration: of the bands around what the simulated wires predict; None for a monitor that never doubts: it
                neither asks for X-ray nor changes its belief.
            members: what the simulated wires take reality to be; around what is given if not given.
            pace: what each step grants the search for what explains the exposures; if not given, one waits for it all.
            settles: exposures before another belief is sought, such as in a time under X-ray: all of them tell more
                than the first few.
        """
        self._navigation, self._config = navigation, config or BeliefConfig()
        self._given = Belief.around(self._config) if members is None else tuple(members)
        self.belief = Belief(navigation, self._given, self._config)
        self.past, self.states, self.sought = Past(), States(), False
        self.identified: Identified | None = None
        self.moves: FoundMotion | None = None
        self.seen: TipMeasurement | None = None
        self._tests, self._loads = calibration is not None and not navigation.catheters, LoadRatio()
        self.changes_left, self._since = _MOST, 0
        self._pace, self._thought, self._settles, self._alarmed = pace or Pace(), None, settles, False
        self._watch, self._innovations = None, Innovations()
        if calibration is not None:
            tip_radius_mm, at = navigation.device.tip_radius_mm, predicted_tip(self.belief)
            self._watch = Watch(calibration, advice or AdviserConfig(), tip_radius_mm, at, alone=self._tests)
            self._innovations = self._watch.innovations

    @property
    def predicted(self) -> Predicted:
        """What the belief predicts of the tip."""
        return predicted_tip(self.belief)

    @property
    def lost(self) -> bool:
        """Whether no wire explains what X-ray showed last."""
        return self.states.lost

    @property
    def thinks(self) -> bool:
        """Whether it goes on that what explains the exposures is sought."""
        return self._thought is not None

    @property
    def rests(self) -> bool:
        """Whether devices rest, without X-ray, while that goes on: no wire explains the last image."""
        return self.thinks and self.states.now is State.SEEKING

    @property
    def alarm(self) -> bool:
        """Whether the model is taken to be wrong."""
        return self._innovations.alarm

    @property
    def load_ratio(self) -> float:
        """How much harder the drive surely pushes than the belief predicts: 1 where it does not, or is not measured."""
        return self._loads.value

    def step(self, encoders: Proximals, load: Proximals = (), exposure: TipMeasurement | None = None) -> BelievedTip:
        """Take what is measured, a period after the last, and return where the tip is believed and what is asked for.

        Args:
            encoders: inserted length (mm) and rotation (rad) of each device.
            load: axial force (N) and torque (N·mm) of each drive; empty where it is not measured.
            exposure: what X-ray shows now; None where it is off.
        """
        period = len(self.past.proximal)
        commanded = self.belief.drives.commanded
        self.past.measured.append((encoders, load, commanded))
        if period:
            self.belief.follow(encoders, load)
            pushed_n = ahead_of_valve_n(load, commanded, self.belief.valve)
            if pushed_n is not None and self._tests:
                sd_n, before = np.inf if self.belief.drives.lose else self.belief.pushed_sd_n, self._loads.outside
                self._loads.take(pushed_n, self.belief.pushed_n, sd_n)
                self._innovations.alarm |= self._loads.outside and not before
        else:
            self.belief.drives.begin(encoders)
        self.past.proximal.append(self.belief.drives.proximal.copy())
        self.seen, self.sought, at, watch = None, False, predicted_tip(self.belief), self._watch
        if watch is not None:
            watch.move(at)
        back = self.belief.drives.proximal[0, 0] <= self._navigation.start_inserted_length_mm
        if exposure is not None:
            self._see(exposure, period, at)
        told, thought = exposure is not None, self._thought
        if thought is not None:
            self._think(thought)
            told |= self._thought is None
        if told:
            at = predicted_tip(self.belief)
        explained = self.belief.explains if told else True
        event = Event.UNEXPLAINED if not explained else Event.DOUBTED if self.alarm else Event.TRUSTED
        self.states.take(event if told or back else None, seeks=self.thinks or self._config.copies > 0)
        if watch is None:
            return BelievedTip(float(at.tip[0]), float(at.tip[1]), branch=int(self.belief.tip.branch[self.belief.best]))
        if self.seen is not None:
            watch.exposed(float((at.tip + self.seen.less(at.tip))[1]), at)
        motion = _MOTION_SD_MM * (self.belief.motion is not None)
        beside_mm2 = self.belief.play_spread() ** 2 + motion**2
        due = not self.rests and watch.advise(at, beside_mm2, harder=self.load_ratio)
        return self._believed(watch, at.tip, due)

    def _see(self, exposure: TipMeasurement, period: int, at: Predicted) -> None:
        """Weigh the belief by what X-ray shows, and change it where the model is taken to be wrong."""
        self.seen = seen = self.belief.in_vessel(exposure, period)
        if self._tests and self._watch is not None:
            self._watch.compare(seen.less(at.tip), exposure.tip_sd_mm)
        self.past.exposures[period] = exposure
        self.belief.weigh(seen)
        self.sought = not self.belief.explains and self.belief.seek(seen)
        self._innovations.alarm |= self._tests and not self.belief.explains
        self._since, self._alarmed = self._since + 1, self._alarmed or self.alarm
        if (shown := len(self.past.exposures)) == self._settles:
            self._innovations.alarm |= self._alarmed
        seeks_motion, changes = self._may_move(), self._is_to_change()
        if self._thought is None and shown >= self._settles and (seeks_motion or changes):
            self._thought = self._explaining(seeks_motion=seeks_motion, changes=changes)

    def _explaining(self, *, seeks_motion: bool, changes: bool) -> Thought[Explanation | None]:
        """Begin to seek what explains the exposures, which may take longer than a decision."""
        belief, past, budget = copy.copy(self.belief), self.past.copy(), Budget()
        navigation, given, moves, belief.budget = self._navigation, self._given, self.moves, budget

        def work(_: object) -> Explanation | None:  # holds no monitor, which holds the thought
            return explain(belief, past, navigation, given, moves=moves, seeks_motion=seeks_motion, changes=changes)

        return Thought(work, budget, self._pace)

    def _think(self, thought: Thought[Explanation | None]) -> None:
        """Let the search for what explains the exposures go on, and believe that once it is found."""
        thought.wait()
        if thought.busy:
            return
        rested, self._thought, found = self.rests, None, thought.found
        if found is None:
            return
        found.belief.budget = None
        found.go_on(self.past)
        if found.moves is not self.moves:
            found.belief.drives.begin(self.past.measured[-1][0])
        else:
            self.changes_left -= 1
            if len(found.past.proximal) == 1:
                self._given = found.belief.members
        self.belief, self.identified, self.moves = found.belief, found.identified, found.moves
        self._since, self._loads = 0, LoadRatio()
        self._innovations.renew(unknown=self.identified is not None and not self.identified.explains)
        if rested or self.seen is not None:  # they lie where they were seen
            period, seen = list(self.past.exposures.items())[-1]
            self.seen = self.belief.in_vessel(seen, period)

    def _is_to_change(self) -> bool:
        """Return whether another belief is sought: the first does not explain the images, or no longer the last one."""
        if self.changes_left == 0 or not self.alarm:
            return False
        first = self.identified is None and self.moves is None and not self.belief.drives.unknown
        return first or (self._since >= _EVERY and (not self.belief.explains or self._innovations.outside))

    def _may_move(self) -> bool:
        """Return whether a motion of the vessel may explain the exposures."""
        if not (self.alarm and self._tests) or len(self.past.exposures) < _LEAST_EXPOSURES:
            return False
        if self.moves is None:
            unknown = self.identified is not None and not self.identified.explains
            known = self._navigation.known_motion is not None
            return known or unknown or self._farthest_outside_mm() >= _OUTSIDE_MM
        return not self.belief.explains or self._innovations.outside or self._since >= _EVERY

    def _farthest_outside_mm(self) -> float:
        """Return how far outside the lumen an exposure showed the tip at most, mm."""
        lines = [branch.centerline for branch in self._navigation.anatomy.tree.branches]
        return max(
            seen.offset - float(np.interp(seen.abscissa, lines[seen.branch].abscissa, lines[seen.branch].radius))
            for seen in self.past.exposures.values()
        )

    def _believed(self, watch: Watch, tip: np.ndarray, due: bool) -> BelievedTip:
        abscissa, offset = tip.tolist()
        words = [each.words for each in (self.moves, self.belief.drives, self.identified) if each is not None]
        found, branch = "; ".join(each for each in words if each), int(self.belief.tip.branch[self.belief.best])
        if self.lost:
            asks = "no simulated wire explains the last image" if due or not self._tests else ""
            return BelievedTip(abscissa, offset, (np.inf, np.inf), asks, found, branch)
        along, across = watch.half_width.tolist()
        asks = watch.reason if due else ""
        return BelievedTip(abscissa, offset, (along, across), asks, found, branch)


def predicted_tip(belief: Belief) -> Predicted:
    """Return what a belief predicts of the tip: that of the likeliest wire, and the spread of all wires."""
    best, tip, tree = belief.best, belief.tip, belief.navigation.anatomy.tree
    likeliest = np.full(len(tip.branch), tip.branch[best]), np.full(len(tip.branch), tip.abscissa[best])
    apart_mm = astray_mm(tree, likeliest, (tip.branch, tip.abscissa))
    pressed = belief.force / belief.navigation.force_limit_n
    return Predicted(
        belief.simulator.proximal[best, 0],
        np.array([tip.abscissa[best], tip.offset[best]]),
        belief.tip_spread(),
        float(tip.radius[best]),
        Members(belief.weight, apart_mm, tip.offset, tip.radius, pressed),
    )
