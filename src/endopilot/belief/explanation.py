"""What explains all exposures of a navigation so far: `explain`, a motion of the vessel or another belief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from endopilot.belief.belief import Belief, Past
from endopilot.belief.drives import UNKNOWN
from endopilot.belief.identification import Identified, identify
from endopilot.belief.patient_motion import FoundMotion, find_motion
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation

BETTER = 3.0
"""What is found must explain all exposures better by this logarithm."""
_LEAST_GAIN, _MOST_MISFIT = 6.0, 0.8
"""A motion is believed that makes the exposures likelier by this logarithm, and leaves no larger misfit."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What explains the exposures.

    Attributes:
        belief: that takes the place of another, at the end of what became of the navigation.
        past: that, with the proximal ends where they are then believed to have been.
        identified: what was found of devices, lumen and wall; None if nothing was.
        moves: how the vessel was found to move; None if it was not.
        own_drives: whether the belief has drives of its own.
    """

    belief: Belief
    past: Past
    identified: Identified | None
    moves: FoundMotion | None
    own_drives: bool

    def go_on(self, past: Past) -> None:
        """Follow what became of the navigation meanwhile, and tell it where the proximal ends are believed."""
        begun = len(self.past.proximal)
        past.proximal[:begun] = self.past.proximal
        if self.own_drives:
            past.proximal[begun:] = self.belief.rerun(past, begun)
        else:
            self.belief.replay(past, begun)


def explain(
    belief: Belief,
    past: Past,
    navigation: Navigation,
    given: Sequence[World],
    *,
    moves: FoundMotion | None,
    seeks_motion: bool,
    changes: bool,
) -> Explanation | None:
    """Return what explains the exposures, None if nothing does.

    Args:
        belief: that does not.
        past: of the navigation; it is left as it is.
        navigation: as it is given.
        given: members as they were at first.
        moves: how the vessel was found to move before.
        seeks_motion: whether a motion of the vessel may explain them.
        changes: whether other devices, lumens and walls may, if no motion does.
    """
    found = _moved(belief, past, navigation, given, moves) if seeks_motion else None
    return _changed(belief, past, given, moves) if found is None and changes else found


def _changed(belief: Belief, past: Past, given: Sequence[World], moves: FoundMotion | None) -> Explanation:
    """Return which devices, lumen and wall explain the exposures, or drives that lose more than is known."""
    found, identified = identify(belief, past)
    if len(past.proximal) > 1 and not belief.drives.lose:
        other = belief.like(given, drives=belief.drives.of_robot(UNKNOWN))
        proximal = other.rerun(past)
        if other.evidence > found.evidence:
            return Explanation(other, Past(proximal, past.exposures, past.measured), None, moves, True)
    return Explanation(found, past, identified, moves, False)


def _moved(
    belief: Belief, past: Past, navigation: Navigation, given: Sequence[World], moves: FoundMotion | None
) -> Explanation | None:
    """Return how a motion of the vessel explains the exposures, None if none does."""
    members, drives, own = belief.members, belief.drives, False
    if moves is None:
        members = given
        if drives.unknown:  # its encoder may be right, and the image was wrong
            drives, past, own = drives.of_robot(navigation.robot), past.by_encoders(), True
    tried = belief.like(members, drives=drives)
    tried.replay(past)
    found = moves
    for _ in range(2):  # the wire as it lies in a vessel that lies still, and in one that moves
        best = tried.best
        tip, direction = (np.array([each[best] for each in some]) for some in zip(*tried.shown, strict=True))
        seen = np.array([belief.in_laboratory(each, period) for period, each in past.exposures.items()])
        times_s = DECISION_PERIOD_S * np.array(list(past.exposures))
        ostium = np.asarray(navigation.anatomy.insertion.position)
        found = find_motion(tip, direction, seen, times_s, ostium, known=navigation.known_motion)
        if found.gain < _LEAST_GAIN or found.misfit > _MOST_MISFIT:
            return None
        tried = belief.like(members, motion=found.motion, drives=drives)
        tried.replay(past)
    if tried.evidence < belief.evidence + BETTER:
        return None
    if own:
        drives.begin(past.measured[-1][0])
    return Explanation(tried, past, None, found, own)
