"""Which hypotheses explain what X-ray showed: `identify`.

Members that differ in the parameters of all hypotheses replay the way of the devices so far. What they show at each
exposure is compared with what X-ray did, and what they take of their drive since the one before with what it read
(`models.hypotheses`). Members of the next generation are drawn around what is then believed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.belief.belief import Belief, Past
from endopilot.belief.drives import force_sd_n
from endopilot.errors import InputError
from endopilot.models.hypotheses import HEART, HYPOTHESES, LUMEN, Family, Posterior
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S

_LARGEST_MAP = 50_000_000
"""Points of a distance map beyond which no other lumen is tried: it would take gigabytes."""
_ADVANCES_MM_S = 0.5
"""A slower advance says nothing by its force: the valve's friction hides it."""
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
    read_n, found = np.array([read for _, read in _advances(belief, past)]), family.as_given()
    drawn = first = family.drawn(found.mean, np.eye(len(found.mean)), _KINDS, _EACH, vessels=_VESSELS)
    for generation in range(_GENERATIONS):
        if generation:
            if belief.budget is not None and belief.budget.spent > _MOST:
                break
            spread = np.diag(np.clip(2 * found.sd, _NARROWEST, 1.0))
            drawn = family.drawn(found.mean, spread, _KINDS, _EACH, vessels=_VESSELS, seed=generation)
            drawn[:, family.costly] = first[:, family.costly]
        seen, scale = _replayed(belief, past, [family.world(each) for each in drawn])
        found = family.update(drawn, seen, np.column_stack([shown, read_n]), scale)
    belief.vessels.keep([family.world(each) for each in first])
    made = belief.like(_members(family, found, belief))
    made.replay(past)
    return made, _stated(family, found)


def _advances(belief: Belief, past: Past) -> list[tuple[list[int], float]]:
    """Return the periods before each exposure, since the last one, in which the wire advanced, and with what force in
    the mean, N, less the valve's; none where drives lose their motion, or measure no force: it is 0 then."""
    friction_n, drag_n_s_mm = belief.valve
    found, begun = [], 1
    for exposed in past.exposures:
        periods, read = [], []
        for period in range(begun, exposed + 1):
            _, load, commanded = past.measured[period]
            if load and commanded and commanded[0][0] > _ADVANCES_MM_S and not belief.drives.lose:
                periods.append(period)
                read.append(load[0][0] - friction_n - drag_n_s_mm * commanded[0][0])
        found.append((periods, float(np.mean(read)) if read else 0.0))
        begun = exposed + 1
    return found


def _replayed(
    belief: Belief, past: Past, members: list[World]
) -> tuple[Float[np.ndarray, "members exposures 4"], Float[np.ndarray, "exposures 4"]]:
    """Return where members show their tips at each exposure, LPS mm, and the force that they took of their drive since
    the one before, N; and how well these are known, beside the image."""
    tips = np.full((len(members), len(past.exposures), 3), np.nan)
    directions, forces, advances = tips.copy(), np.zeros(tips.shape[:2]), _advances(belief, past)
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
