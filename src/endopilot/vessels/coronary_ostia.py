"""Where the coronary arteries begin, in lumens without an aorta, and how sure that is.

Every open end of every piece is scored as the ostium of the right and of the left artery by what anatomy demands:
calibre, taper, course, first heading and first fork, the place of the two ostia relative to each other, and that no
vessel runs through the aorta between them. Each score is a logarithmic likelihood with heavy tails (Student's t), so no
single quantity decides; its weight was fitted to perturbed masks of real patients (docs/concepts/ostium.md). The
probability of an ostium is the share of all hypotheses that agree with it within `SAME_MM`; among them are an absent
artery, arteries that touch, other axes, and none of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from endopilot.types import Centerline, VesselTree
from endopilot.vessels.ends import OpenEnd

Side = Literal["rca", "lca"]

SAME_MM = 8.0  # ends of one lumen nearer than this are of one stub: corners of a cut, or a branch at the ostium

LEFT_FROM_RIGHT = np.array([0.40, 0.79, 0.46])
"""Direction of the left ostium as seen from the right one, LPS: the right sinus of Valsalva faces forwards and lies
lower. In seven real patients within 13° of this."""

LEFT_FROM_RIGHT_SD_DEG = 14.0

BETWEEN_MM, BETWEEN_SD = 35.6, 0.12  # distance of the ostia, mm, and its logarithm's SD; 31 to 39 in seven patients
AORTA_UP = np.array([-0.40, -0.30, 0.87])  # axis of the aortic root, LPS: up, to the right, and forwards

AORTA_BEHIND_MM = 7.0
"""The aorta's axis passes this far behind and to the right of the middle between the ostia, which lie some 125° apart
on its wall."""

AORTA_MM, AORTA_SD_MM = 15.0, 3.0  # no artery comes nearer to the aorta's axis; 15.8 to 19.4 mm in seven patients
AORTA_REACH_MM = (-5.0, 40.0)  # stretch of the aorta's axis, from the level between the ostia, looked at

HEADING = {"rca": np.array([-0.78, -0.5, 0.37]), "lca": np.array([0.96, -0.12, 0.24])}
"""First heading: the right artery leaves to the right and forwards, the left main to the left."""

COURSE = {"rca": np.array([-0.15, 0.3, -0.94]), "lca": np.array([0.84, -0.25, -0.48])}
"""Where the tree lies, from the ostium: the right one round the groove below it, the left one to the left."""

CALIBRE, CALIBRE_SD = 1.0, 0.25
TAPER, TAPER_SD = 0.6, 0.2
WIDENING_SD = 0.15
HEADING_SD_DEG, COURSE_SD_DEG = 40.0, 35.0
OPENING_DEG, OPENING_SD_DEG = 105.0, 20.0  # branches leave forwards: a wider fork is entered from the side

WEIGHT = {"calibre": 0.6, "taper": 0.4, "widening": 0.4, "opening": 0.6, "heading": 2.0, "course": 1.2}
"""What each likelihood counts: those of the lumen's width say in part the same."""

ABSENT = -14.0  # score of an artery that the lumen does not hold: below that of any ostium that looks like one
ASKED = 1.0  # logarithm of how much likelier the artery asked for is in the lumen than not, before it is looked at
NEITHER = -14.0  # score below which two arteries are rather something else. Both of a patient score −1 to −6
ALONE = -9.0  # the same for a single artery, which scores 0 to −5
TOUCHING = -8.0  # what it costs to take one lumen for both arteries, which touch or run together with their veins

OTHER_AXES = {
    axes: (
        np.array([1.0 if one == of else -1.0 for one, of in zip(axes, "lps", strict=True)]),
        -2.5 if axes == "ras" else -5.0,
    )
    for axes in ("ras", "rps", "las", "lpi", "rai", "rpi", "lai")
}
"""Axes that a file may be in instead of LPS: the signs that turn it over, and the logarithm of how likely that is."""

UNSTATED = 1.5  # what is added for RAS axes where the file does not state its own

_FREEDOM = 3.0

Dominance = Literal["right", "balanced", "left"]

CRUX_FROM_OSTIUM_MM = np.array([12.0, 43.0, -44.0])
"""The crux as seen from the right ostium, LPS mm: behind and below it. In six real patients within 13 mm of this."""

REACHED_MM = 20.0  # an artery so near to the crux reaches it; in seven patients the other stays 34 mm away


@dataclass(frozen=True, eq=False)
class OstiumCandidate:
    """A place (LPS mm, mean of one stub's ends) where an artery may begin, its piece of lumen, and its probability."""

    position: Float[np.ndarray, "3"]
    piece: int
    probability: float


@dataclass(frozen=True, eq=False)
class OstiumRanking:
    """How the hypotheses about a lumen's arteries share the probability of 1: `touching` is where the artery would
    begin if one lumen held both, `axes` those of `OTHER_AXES` that explain the lumen best, each with its probability.
    """

    candidates: list[OstiumCandidate]
    absent: float
    touching: OstiumCandidate
    axes: tuple[str, float]


def rank_ostia(
    pieces: Sequence[Sequence[OpenEnd]], vessels: Float[np.ndarray, "n 3"] | None = None, *, stated: bool = True
) -> dict[Side, OstiumRanking]:
    """Return where each artery asked for may begin, and what else the lumen may hold. `pieces` are open ends of every
    lumen that may be an artery; no point of `vessels` (LPS mm) may lie in the aorta; `stated`: are the file's axes?
    What is missing to 1 is the probability of no coronary arteries."""
    ends = [end for own in pieces for end in own]
    owner = np.array([piece for piece, own in enumerate(pieces) for _ in own])
    place = np.array([end.position for end in ends])
    vessels = np.empty((0, 3)) if vessels is None else vessels
    axes = {"lps": (np.ones(3), 0.0)} | OTHER_AXES
    scores = {name: prior + _scores(ends, owner, vessels, flip) for name, (flip, prior) in axes.items()}
    scores["ras"] += 0.0 if stated else UNSTATED
    neither = NEITHER if len(pieces) > 1 else ABSENT + ALONE
    return {"rca": _ranking(place, owner, scores, neither, 1), "lca": _ranking(place, owner, scores, neither, 0)}


def _ranking(
    place: Float[np.ndarray, "n 3"],
    owner: Int[np.ndarray, "n"],
    scores: dict[str, Float[np.ndarray, "n1 n1"]],
    neither: float,
    other: int,
) -> OstiumRanking:
    """Return how the hypotheses share the probability; the table's axis `other` is that of the artery not asked for."""
    absent = (-1, slice(None)) if other == 1 else (slice(None), -1)
    top = max(neither, *(float(table.max()) for table in scores.values()))
    weights = {name: np.exp(table - top) for name, table in scores.items()}
    for table in weights.values():
        table[absent] *= np.exp(-ASKED)
    total = sum(float(table.sum()) for table in weights.values()) + float(np.exp(neither - top))
    table = weights["lps"] / total
    one = np.where(owner[:, None] == owner, table[:-1, :-1], 0.0)
    touching = int(one.sum(axis=other).argmax())
    share = table.sum(axis=other)
    elsewhere = {name: float(weights[name].sum()) / total for name in OTHER_AXES}
    likeliest = max(elsewhere, key=lambda name: elsewhere[name])
    return OstiumRanking(
        _merged(place, owner, share[:-1]),
        float(share[-1]),
        OstiumCandidate(place[touching], int(owner[touching]), float(one.sum())),
        (likeliest, elsewhere[likeliest]),
    )


def _scores(
    ends: Sequence[OpenEnd],
    owner: Int[np.ndarray, "n"],
    vessels: Float[np.ndarray, "m 3"],
    flip: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n1 n1"]:
    """Return the score of every pair of a right and a left ostium in turned axes; the last ones stand for none."""
    place = flip * np.array([end.position for end in ends])
    single = {name: np.array([end_score(end, name, flip) for end in ends]) for name in ("rca", "lca")}
    both = single["rca"][:, None] + single["lca"] + _pair_score(place, flip * vessels)
    both += np.where(owner[:, None] == owner, TOUCHING, 0.0)
    np.fill_diagonal(both, -np.inf)
    right = np.concatenate([both, single["rca"][:, None] + ABSENT], axis=1)
    return np.concatenate([right, np.append(single["lca"] + ABSENT, 2 * ABSENT)[None]])


def _merged(
    place: Float[np.ndarray, "n 3"], owner: Int[np.ndarray, "n"], share: Float[np.ndarray, "n"]
) -> list[OstiumCandidate]:
    found, left = [], share.copy()
    while left.max(initial=0.0) > 0.0:
        best = int(left.argmax())
        same = (np.linalg.norm(place - place[best], axis=1) < SAME_MM) & (owner == owner[best])
        middle = np.average(place[same], axis=0, weights=left[same])
        found.append(OstiumCandidate(middle, int(owner[best]), float(left[same].sum())))
        left[same] = 0.0
    return sorted(found, key=lambda candidate: -candidate.probability)


def end_score(end: OpenEnd, side: Side, flip: Float[np.ndarray, "3"] | float = 1.0) -> float:
    """Return the log-likelihood, up to a constant, that an artery begins at an end; `flip` turns its axes to LPS."""
    deviations = {
        "calibre": (min(end.calibre, CALIBRE) - CALIBRE) / CALIBRE_SD,
        "taper": (min(end.taper, TAPER) - TAPER) / TAPER_SD,
        "widening": end.widening / WIDENING_SD,
        "opening": max(end.opening_deg - OPENING_DEG, 0.0) / OPENING_SD_DEG,
    }
    shape = sum(WEIGHT[name] * float(_log_t(deviation**2)) for name, deviation in deviations.items())
    heading = WEIGHT["heading"] * _log_t((_angle_deg(flip * end.heading, HEADING[side]) / HEADING_SD_DEG) ** 2)
    course = WEIGHT["course"] * _log_t((_angle_deg(flip * end.course, COURSE[side]) / COURSE_SD_DEG) ** 2)
    return shape + float(heading + course)


def course_off_deg(tree: VesselTree) -> dict[str, float]:
    """Return how far the direction from a tree's ostium to its middle is from `COURSE` of either artery, degrees."""
    lines = [branch.centerline.points for branch in tree.branches]
    course = np.concatenate(lines).mean(axis=0) - lines[0][0]
    course /= np.linalg.norm(course)
    return {side: float(_angle_deg(course, usual)) for side, usual in COURSE.items()}


def _pair_score(place: Float[np.ndarray, "n 3"], vessels: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n n"]:
    """Return how well every end as the right ostium goes with every end as the left one."""
    offset = place[None] - place[:, None]
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-6)
    apart = np.log(distance / BETWEEN_MM) / BETWEEN_SD
    turn = _angle_deg(offset, LEFT_FROM_RIGHT) / LEFT_FROM_RIGHT_SD_DEG
    inside = np.minimum(_aorta_clearance(place, offset, vessels) - AORTA_MM, 0.0) / AORTA_SD_MM
    return np.asarray(_log_t(apart**2) + _log_t(turn**2) + _log_t(inside**2))


def _aorta_clearance(
    place: Float[np.ndarray, "n 3"], offset: Float[np.ndarray, "n n 3"], vessels: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "n n"]:
    """Return how near vessels come to the axis of the aorta that each pair of ostia would belong to, mm."""
    up = AORTA_UP / np.linalg.norm(AORTA_UP)
    behind = np.cross(up, offset)
    behind /= np.maximum(np.linalg.norm(behind, axis=-1, keepdims=True), 1e-6)
    centre = place[:, None] + 0.5 * offset + AORTA_BEHIND_MM * behind
    height = vessels @ up - (centre @ up)[..., None]
    across = vessels - np.outer(vessels @ up, up)
    axis = centre - (centre @ up)[..., None] * up
    square = (across**2).sum(axis=1) - 2.0 * axis @ across.T + (axis**2).sum(axis=-1)[..., None]
    beside = (height > AORTA_REACH_MM[0]) & (height < AORTA_REACH_MM[1])
    return np.asarray(np.sqrt(np.where(beside, np.maximum(square, 0.0), AORTA_MM**2).min(axis=-1, initial=AORTA_MM**2)))


def _log_t(square: Float[np.ndarray, "..."] | float) -> Float[np.ndarray, "..."] | np.float64:
    return -0.5 * (_FREEDOM + 1) * np.log1p(square / _FREEDOM)


def _angle_deg(one: Float[np.ndarray, "... 3"], two: Float[np.ndarray, "3"]) -> Float[np.ndarray, "..."] | np.float64:
    cosine = one @ two / np.maximum(np.linalg.norm(one, axis=-1) * np.linalg.norm(two), 1e-9)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


@dataclass(frozen=True, eq=False)
class Crux:
    """Where the grooves between ventricles and to the atria meet, LPS mm within 15 mm, and which artery reaches it."""

    position: Float[np.ndarray, "3"]
    dominance: Dominance

    def abscissa(self, line: Centerline) -> float | None:
        """Return where a line passes the crux, mm; None if it does not come near."""
        gap = np.linalg.norm(line.points - self.position, axis=1)
        return float(line.abscissa[gap.argmin()]) if gap.min() < REACHED_MM else None


def find_crux(
    right_ostium: Float[np.ndarray, "3"], right: Float[np.ndarray, "n 3"], left: Float[np.ndarray, "m 3"]
) -> Crux | None:
    """Return the crux from the right ostium and points of both trees (LPS mm); None where they end before it."""
    position = right_ostium + CRUX_FROM_OSTIUM_MM
    reached = [bool(np.linalg.norm(tree - position, axis=1).min() < REACHED_MM) for tree in (right, left)]
    if not any(reached):
        return None
    return Crux(position, "balanced" if all(reached) else "right" if reached[0] else "left")
