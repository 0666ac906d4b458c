"""Where the coronary arteries begin, in lumens without an aorta, and how sure that is.

Every open end of every piece is scored as the ostium of the right and of the left artery by what anatomy demands:
calibre, taper, course, first heading and first fork, and the place of the two ostia relative to each other. Each score
is a logarithmic likelihood with heavy tails (Student's t), so no single quantity decides. The probability of an
ostium is the share of all hypotheses, an absent artery among them, that agree with it within `SAME_MM`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.coronary_ends import OpenEnd

Side = Literal["rca", "lca"]

SAME_MM = 6.0
"""Ends nearer each other than this are the same ostium."""

LEFT_FROM_RIGHT_MM = np.array([14.0, 28.0, 16.0])
"""The left ostium as seen from the right one, LPS mm: the right sinus of Valsalva faces forwards and lies lower."""

LEFT_FROM_RIGHT_SD_MM = np.array([7.0, 7.0, 8.0])

HEADING = {"rca": np.array([-0.78, -0.5, 0.37]), "lca": np.array([0.96, -0.12, 0.24])}
"""First heading: the right artery leaves to the right and forwards, the left main to the left."""

COURSE = {"rca": np.array([-0.15, 0.3, -0.94]), "lca": np.array([0.84, -0.25, -0.48])}
"""Where the tree lies, from the ostium: the right one round the groove below it, the left one to the left."""

CALIBRE, CALIBRE_SD = 1.0, 0.25
TAPER, TAPER_SD = 0.6, 0.2
WIDENING_SD = 0.15
HEADING_SD_DEG, COURSE_SD_DEG = 40.0, 35.0
OPENING_DEG, OPENING_SD_DEG = 105.0, 20.0
"""Branches leave forwards: a fork whose branches open farther than this is entered from the side."""

ABSENT = -14.0
"""Score of an artery that the lumen does not hold: below that of any ostium that looks like one."""

NEITHER = -9.5
"""Score below which two arteries are rather something else, or in other axes. Both of a patient score −2 to −6."""

ALONE = -5.5
"""The same for a single artery, which scores 0 to −3."""

_FREEDOM = 3.0


@dataclass(frozen=True, eq=False)
class OstiumCandidate:
    """A place where an artery may begin.

    Attributes:
        position: tip of the open end, LPS mm.
        piece: which of the separate lumens it belongs to.
        probability: share of the hypotheses that put the ostium here.
    """

    position: Float[np.ndarray, "3"]
    piece: int
    probability: float


def rank_ostia(pieces: Sequence[Sequence[OpenEnd]], side: Side) -> tuple[list[OstiumCandidate], float]:
    """Return the places where an artery may begin, most probable first, and the probability that it is absent.

    What is missing to 1 is the probability that nothing in the lumen is as coronary arteries are.

    Args:
        pieces: the open ends of every lumen that may be a coronary artery.
        side: which artery is asked for.
    """
    ends = [(piece, end) for piece, own in enumerate(pieces) for end in own]
    owner = np.array([piece for piece, _ in ends])
    place = np.array([end.position for _, end in ends])
    single = {name: np.array([end_score(end, name) for _, end in ends]) for name in ("rca", "lca")}
    both = single["rca"][:, None] + single["lca"] + _pair_score(place[None] - place[:, None])
    both = np.where(owner[:, None] == owner, -np.inf, both)
    right = np.concatenate([both, single["rca"][:, None] + ABSENT], axis=1)  # last column: no left artery
    table = np.concatenate([right, np.append(single["lca"] + ABSENT, 2 * ABSENT)[None]])
    neither = NEITHER if len(pieces) > 1 else ABSENT + ALONE
    top = max(float(table.max()), neither)
    weight = np.exp(table - top)
    share = weight.sum(axis=1 if side == "rca" else 0) / (weight.sum() + np.exp(neither - top))
    found, left = [], share[:-1].copy()
    while left.max(initial=0.0) > 0.0:
        best = int(left.argmax())
        same = (np.linalg.norm(place - place[best], axis=1) < SAME_MM) & (owner == owner[best])
        found.append(OstiumCandidate(place[best], int(owner[best]), float(left[same].sum())))
        left[same] = 0.0
    return sorted(found, key=lambda candidate: -candidate.probability), float(share[-1])


def end_score(end: OpenEnd, side: Side) -> float:
    """Return the logarithmic likelihood, up to a constant, that the right or left artery begins at an end."""
    heading = _angle_deg(end.heading, HEADING[side]) / HEADING_SD_DEG
    course = _angle_deg(end.course, COURSE[side]) / COURSE_SD_DEG
    return shape_score(end) + _log_t(heading**2) + _log_t(course**2)


def shape_score(end: OpenEnd) -> float:
    """Return the logarithmic likelihood, up to a constant, that any arterial tree begins at an end."""
    deviations = (
        (min(end.calibre, CALIBRE) - CALIBRE) / CALIBRE_SD,
        (min(end.taper, TAPER) - TAPER) / TAPER_SD,
        end.widening / WIDENING_SD,
        max(end.opening_deg - OPENING_DEG, 0.0) / OPENING_SD_DEG,
    )
    return sum(_log_t(deviation**2) for deviation in deviations)


def _pair_score(offset: Float[np.ndarray, "r l 3"]) -> Float[np.ndarray, "r l"]:
    square = (((offset - LEFT_FROM_RIGHT_MM) / LEFT_FROM_RIGHT_SD_MM) ** 2).sum(axis=-1)
    return -0.5 * (_FREEDOM + 3) * np.log1p(square / _FREEDOM)


def _log_t(square: float) -> float:
    """Return the logarithm of Student's t at a squared deviation, as a share of its peak."""
    return -0.5 * (_FREEDOM + 1) * float(np.log1p(square / _FREEDOM))


def _angle_deg(one: Float[np.ndarray, "3"], two: Float[np.ndarray, "3"]) -> float:
    cosine = float(one @ two) / max(float(np.linalg.norm(one) * np.linalg.norm(two)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
