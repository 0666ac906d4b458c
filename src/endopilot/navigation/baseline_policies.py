"""Policies that need no model: what every planner has to beat. `CatheterAlone` and `InTurn` drive a catheter, too."""

from __future__ import annotations

import numpy as np

from endopilot.errors import InputError
from endopilot.navigation.policy import Decision, Observation
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation

ADVANCE_MM_S = 5.0
"""Velocity of the baselines, mm/s: 2.5 mm between two decisions, less than the 4 mm that a target is wide."""
SPIN_RAD_S = 3.0
"""Rotation of `Spin`, rad/s, about half a turn a second."""
_SLACK_MM = 20.0
"""A device that is inserted this much deeper than the target without reaching it is in another branch, or slack, and
waits, mm."""
_RETRACT_MM = 5.0
"""`RetractRotate` pulls its tip back to this far before the fork where it took the wrong branch, mm."""
_CAUGHT_S, _CAUGHT_MM = 3.0, 1.0
"""A wire whose tip advances by less than this in this time is caught, s and mm."""
LEAD_MM = 40.0
"""The wire leads by this much before `InTurn` lets the catheter follow, mm."""
BEHIND_MM = 10.0
"""The catheter follows to this far behind the wire's tip, mm, where the wire's tip is to arrive."""
_STAND = (0.0, 0.0)
_ADVANCE = (ADVANCE_MM_S, 0.0)
_RETRACT = (-ADVANCE_MM_S, 0.0)


class Forward:
    """Pushes at a constant velocity, without X-ray, until the wire is inserted 20 mm deeper than the target lies."""

    _rotation = 0.0

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the target's depth."""
        self._deepest = navigation.target.abscissa + _SLACK_MM

    def decide(self, observation: Observation) -> Decision:
        """Push, or wait."""
        going = observation.devices[0][0] < self._deepest
        return Decision(((ADVANCE_MM_S, self._rotation),) if going else (_STAND,))


class Spin(Forward):
    """Pushes as `Forward` does, and rotates at a constant velocity."""

    _rotation = SPIN_RAD_S


class RetractRotate:
    """Pushes, with X-ray always on; where the tip enters a wrong branch, retracts, rotates by 180° and advances again.

    The rule of Madder et al. 2017, which robotic drives offer as rotate-on-retract: a wire turns more freely while it
    is retracted, and its tip comes back to the mouth of the branch with another direction. A wire that is caught is
    freed in the same way.
    """

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the route."""
        self._target = navigation.target.abscissa
        self._fork = navigation.anatomy.tree.departures(navigation.target.branch)
        self._back_to: float | None = None
        self._turn_to: float | None = None
        self._deepest: list[float] = []

    def decide(self, observation: Observation) -> Decision:
        """Push, retract or rotate, depending on what X-ray shows."""
        return Decision((self._velocity(observation),), expose=True)

    def _velocity(self, observation: Observation) -> tuple[float, float]:
        tip, (inserted, rotation) = observation.tip, observation.devices[0]
        if tip is None:
            return _STAND
        if self._back_to is None and self._turn_to is None:
            retract_to = self._retract_to(tip.branch, tip.abscissa)
            if retract_to is None:
                return _ADVANCE
            self._back_to = retract_to
        if self._back_to is not None:
            if tip.abscissa > self._back_to and inserted > 0:
                return _RETRACT
            self._back_to, self._turn_to = None, rotation + np.pi
        left = (self._turn_to or 0.0) - rotation
        if left > 0.05:
            return 0.0, min(SPIN_RAD_S, left / DECISION_PERIOD_S)
        self._turn_to, self._deepest = None, []
        return _ADVANCE

    def _retract_to(self, branch: int, abscissa: float) -> float | None:
        """Return how far the tip is to be retracted, as an abscissa, or None where it advances on the route."""
        if np.isfinite(self._fork[branch]):
            return float(self._fork[branch]) - _RETRACT_MM
        if abscissa > self._target + _RETRACT_MM:
            return self._target - _RETRACT_MM
        self._deepest.append(abscissa)
        before = round(_CAUGHT_S / DECISION_PERIOD_S)
        if len(self._deepest) > before and max(self._deepest) - max(self._deepest[:-before]) < _CAUGHT_MM:
            return abscissa - _RETRACT_MM
        return None


class CatheterAlone:
    """Pushes the catheter at a constant velocity, with the wire's tip at its end; the wire never leads."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the target's depth, or raise `InputError` where there is no catheter."""
        if not navigation.catheters:
            raise InputError("policy: drives a catheter too, and there is none; give a catheter, or another policy")
        self._deepest = navigation.target.abscissa + _SLACK_MM

    def decide(self, observation: Observation) -> Decision:
        """Push the catheter, and the wire in it once both ends meet; or wait."""
        (wire, _), (catheter, _), *_ = observation.devices
        push = _ADVANCE if catheter < self._deepest else _STAND
        return Decision((push if wire <= catheter else _STAND, push))


class InTurn(CatheterAlone):
    """Advances wire and catheter in turn, without X-ray: the wire leads by `LEAD_MM`, then the catheter follows."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the target's depth, and whose tip is to arrive."""
        super().start(navigation, seed)
        self._behind = BEHIND_MM if navigation.arrives == "wire" else 0.0
        self._follows = False

    def decide(self, observation: Observation) -> Decision:
        """Push the one whose turn it is, or wait."""
        (wire, _), (catheter, _), *_ = observation.devices
        leads, follows = wire < min(catheter + LEAD_MM, self._deepest), catheter < wire - self._behind
        self._follows = follows and (self._follows or not leads)
        if self._follows:
            return Decision((_STAND, _ADVANCE))
        return Decision((_ADVANCE if leads else _STAND,))
