"""Policies for a wire in a catheter that need no model: what a planner of both has to beat."""

from __future__ import annotations

from endopilot.errors import InputError
from endopilot.navigation.baseline_policies import ADVANCE_MM_S
from endopilot.navigation.policy import Decision, Observation
from endopilot.tasks.navigation import Navigation

_SLACK_MM = 20.0
"""No device is inserted deeper than this beyond the target, mm: it is in another branch then, or slack."""
LEAD_MM = 40.0
"""The wire leads by this much before `InTurn` lets the catheter follow, mm."""
BEHIND_MM = 10.0
"""The catheter follows to this far behind the wire's tip, mm, where the wire's tip is to arrive."""


class CatheterAlone:
    """Pushes the catheter at a constant velocity, with the wire's tip at its end; the wire never leads."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the target's depth.

        Raises:
            InputError: there is no catheter.
        """
        check_catheter(navigation)
        self._deepest = navigation.target.abscissa + _SLACK_MM

    def decide(self, observation: Observation) -> Decision:
        """Push the catheter, and the wire in it once both ends meet; or wait."""
        catheter = observation.catheters[0][0]
        speed = ADVANCE_MM_S if catheter < self._deepest else 0.0
        meets = observation.inserted_length <= catheter
        return Decision(speed if meets else 0.0, 0.0, catheters=((speed, 0.0),))


class InTurn:
    """Advances wire and catheter in turn, without X-ray: the wire leads by `LEAD_MM`, then the catheter follows."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Take the target's depth.

        Raises:
            InputError: there is no catheter.
        """
        check_catheter(navigation)
        self._deepest = navigation.target.abscissa + _SLACK_MM
        self._behind = BEHIND_MM if navigation.arrives == "wire" else 0.0
        self._follows = False

    def decide(self, observation: Observation) -> Decision:
        """Push the one whose turn it is, or wait."""
        wire, catheter = observation.inserted_length, observation.catheters[0][0]
        leads, follows = wire < min(catheter + LEAD_MM, self._deepest), catheter < wire - self._behind
        self._follows = follows and (self._follows or not leads)
        if self._follows:
            return Decision(0.0, 0.0, catheters=((ADVANCE_MM_S, 0.0),))
        return Decision(ADVANCE_MM_S if leads else 0.0, 0.0)


def check_catheter(navigation: Navigation) -> None:
    """Check that a navigation has a catheter, for policies that drive one.

    Raises:
        InputError: it has none.
    """
    if not navigation.catheters:
        raise InputError("policy: drives a catheter too, and there is none; give a catheter, or another policy")
