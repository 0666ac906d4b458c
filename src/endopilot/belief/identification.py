"""What explains all exposures of a navigation so far: `explain`, a motion of the vessel or another belief; `identify`.

Members that differ in the parameters of all hypotheses replay the way of the devices so far. What they show at each
exposure is compared with what X-ray did, and what they take of their drive since the one before with what it read
(`models.hypotheses`). Members of the next generation are drawn around what is then believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.belief.belief import Belief, Past
from endopilot.belief.drives import UNKNOWN, ahead_of_valve_n, force_sd_n
from endopilot.belief.patient_motion import FoundMotion, find_motion
from endopilot.errors import InputError
from endopilot.models.hypotheses import HEART, HYPOTHESES, LUMEN, Family, Posterior
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation

_BETTER = 3.0
"""What is found must explain all exposures better by this logarithm."""
_LEAST_GAIN, _MOST_MISFIT = 6.0, 0.8
"""A motion is believed that makes the exposures likelier by this logarithm, and leaves no larger misfit."""
_LARGEST_MAP = 50_000_000
"""Points of a distance map beyond which no other lumen is tried: it would take gigabytes."""
_MODEL_MM = np.array([0.5, 0.3])
"""Standard deviations of a good member's errors along and across its wire, mm."""
_DEVIATIONS = 1.28
"""Half of an interval that holds with 80 %, in standard deviations."""
_UNSURE = 0.5
"""A parameter is unknown where its hypothesis is less likely, or its interval wider than this share of what was likely
before; and so is what explains the images where none of the hypotheses is likelier."""
_GENERATIONS, _KINDS, _EACH, _VESSELS = 2, 16, 4, 3
"""Generations of members; kinds of wires in vessels in each, so many of each, and lumens and walls among them, which
stay the same: making a lumen takes a second."""
_MOST = 60_000_000
"""Evaluations of nodes after which no other generation is driven: in an aorta one takes ten seconds of a core, and all
that the second adds to the first is narrower intervals."""
_SAME_LUMEN = 0.02
"""A lumen that differs by less is taken as given."""
_NARROWEST = 0.1
"""Members of a generation are spread over this share of what is other at least."""


@dataclass(frozen=True, eq=False)
class Identified:
    """What explains the exposures.

    Attributes:
        interval: of each parameter, the range in which it is with 80 %; None where the exposures hardly tell it.
        wall: of which kind the wall is.
        explains: whether a hypothesis does; none of them is likelier if not.
        words: what was found, in words.
    """

    interval: Mapping[str, tuple[float, float] | None]
    wall: Literal["compliant", "rigid", "unknown"]
    explains: bool
    words: str


def identify(belief: Belief, past: Past) -> tuple[Belief, Identified]:
    """Find what explains the exposures of a navigation so far.

    Returns:
        The belief that takes its place, at the same moment, and what was found.
    """
    lumens = len(past.exposures) > 1 and belief.navigation.anatomy.distance_map.values.size <= _LARGEST_MAP
    family = Family([each for each in HYPOTHESES if each.name != HEART and (lumens or each.name != LUMEN)])
    shown = np.array([belief.unmoved(each, period) for period, each in past.exposures.items()])
    advances, found = _advances(belief, past), family.as_given()
    drawn = first = family.drawn(found.mean, np.eye(len(found.mean)), _KINDS, _EACH, vessels=_VESSELS)
    for generation in range(_GENERATIONS):
        if generation:
            if belief.budget is not None and belief.budget.spent > _MOST:
                break
            spread = np.diag(np.clip(2 * found.sd, _NARROWEST, 1.0))
            drawn = family.drawn(found.mean, spread, _KINDS, _EACH, vessels=_VESSELS, seed=generation)
            drawn[:, family.costly] = first[:, family.costly]
        seen, scale = _replayed(belief, past, advances, [family.world(each) for each in drawn])
        found = family.update(drawn, seen, np.column_stack([shown, [read for _, read in advances]]), scale)
    belief.vessels.keep([family.world(each) for each in first])
    made = belief.like(_members(family, found, belief))
    made.replay(past)
    return made, _stated(family, found)


def _advances(belief: Belief, past: Past) -> list[tuple[list[int], float]]:
    """Return the periods before each exposure, since the last one, in which the wire advanced, and with what force in
    the mean, N, less the valve's; none where drives lose their motion, or measure no force: it is 0 then."""
    found, begun = [], 1
    for exposed in past.exposures:
        read = dict[int, float]()
        for period in range(begun, exposed + 1):
            pushed_n = ahead_of_valve_n(*past.measured[period][1:], belief.valve)
            if pushed_n is not None and not belief.drives.lose:
                read[period] = pushed_n
        found.append((list(read), float(np.mean(list(read.values()))) if read else 0.0))
        begun = exposed + 1
    return found


def _replayed(
    belief: Belief, past: Past, advances: list[tuple[list[int], float]], members: list[World]
) -> tuple[Float[np.ndarray, "members exposures 4"], Float[np.ndarray, "exposures 4"]]:
    """Return where members show their tips at each exposure, LPS mm, and the force that they took of their drive since
    the one before, N; and how well these are known, beside the image."""
    tips = np.full((len(members), len(past.exposures), 3), np.nan)
    directions, forces = tips.copy(), np.zeros(tips.shape[:2])
    walls = [each.compliant_wall_n_mm2 for each in members]
    for wall in dict.fromkeys(walls):
        rows = np.array([k for k, each in enumerate(walls) if each == wall])
        try:
            tried = belief.like([members[k] for k in rows])
        except InputError:  # the wire does not fit
            continue
        tried.replay(past)
        position, direction = (np.stack(each, axis=1) for each in zip(*tried.shown, strict=True))
        times_s = DECISION_PERIOD_S * np.array(list(past.exposures))
        beside = np.array([[members[k].registered_mm(time_s) for time_s in times_s.tolist()] for k in rows])
        tips[rows] = np.where(tried.simulator.valid[:, None, None], position + beside, np.nan)
        directions[rows] = direction
        pushed, rest = np.array(tried.pushed), np.zeros(len(rows))
        forces[rows] = np.stack([pushed[at].mean(axis=0) if at else rest for at, _ in advances], axis=1)
    along = np.nanmedian(directions, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    measured = np.array([np.diag(each.covariance) for each in past.exposures.values()])
    own = _MODEL_MM[1] ** 2 + (_MODEL_MM[0] ** 2 - _MODEL_MM[1] ** 2) * along**2
    unread = [not at for at, _ in advances]
    force_sd = np.where(unread, 1.0, force_sd_n(np.median(forces, axis=0)))
    return np.dstack([tips, forces]), np.column_stack([np.sqrt(measured + own), force_sd])


def _members(family: Family, found: Posterior, belief: Belief) -> list[World]:
    """Return members around the likeliest explanation, in its lumen, with its wall and registration."""
    kinds, count = belief.config.stiffness_levels, belief.config.members
    drawn = family.drawn(found.center, found.factor, kinds, -(-count // kinds), vessels=1)[:count]
    drawn[0] = found.center
    best = family.world(found.center)
    if abs(best.lumen_factor - 1) < _SAME_LUMEN:
        best = replace(best, lumen_factor=1.0)
    alike = "lumen_factor", "compliant_wall_n_mm2", "registration_mm", "drift_mm_min"
    shared = {name: getattr(best, name) for name in alike}
    return [replace(family.world(each), **shared) for each in drawn]


def _stated(family: Family, found: Posterior) -> Identified:
    """Return what is stated of what was found."""
    interval = dict[str, tuple[float, float] | None]()
    for k, each in enumerate(family.parameters):
        known = found.sd[k] <= _UNSURE
        interval[each.name] = family.interval(found, each.name, _DEVIATIONS) if known else None
    ends, explains = interval.pop("compliance"), found.none < _UNSURE
    wall = "unknown"
    if ends is not None and (ends[1] < _UNSURE or ends[0] > 0.1):
        wall = "compliant" if ends[0] > 0.1 else "rigid"
    likely = [
        hypothesis for hypothesis, share in zip(family.hypotheses, found.probability, strict=True) if share > _UNSURE
    ]
    open_to = [each for hypothesis in likely for each in hypothesis.parameters]
    stated = [each.words.format(*ends) for each in open_to if (ends := interval.get(each.name)) is not None]
    words = ", ".join([*(stated or [each.name for each in likely] or ["as given"]), f"{wall} wall"])
    return Identified(interval, wall, explains, words if explains else f"unknown; likeliest {words}")


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
    if tried.evidence < belief.evidence + _BETTER:
        return None
    if own:
        drives.begin(past.measured[-1][0])
    return Explanation(tried, past, None, found, own)
