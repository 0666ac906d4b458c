"""The tip of a wire in the images of one exposure: where the wire ends that is followed through the vessel.

How likely the wire ends at a place, against no wire at all, is the tip's posterior: mean, uncertainty and the
probability that there is a wire follow from it. With two views the evidence of both is added, so the depth is found;
with one the vessel gives it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from endopilot.xray.corridor import STEP_MM, Corridor
from endopilot.xray.corridor_view import CorridorView
from endopilot.xray.wire_following import Follower, Leg, places_of

_SHORTER_SHARE, _LONGER_SHARE, _NEAR_MM = 0.1, 0.04, 2.0
"""The way to the tip differs from the inserted length by 2 mm, and a tenth of it where it is shorter, since wires snake
and loop; it is hardly longer: wires only cut bends short."""
_LONGEST = 4.0
"""No way is longer than the inserted length by more than so many standard deviations."""
_MOST_OF_CATHETER = 20.0
"""The evidence of a wire in the catheter counts no more than this."""
MODE_MM = 4.0
"""Mean and covariance are those of the posterior within this distance of its mode, mm."""
_NOTHING = 1e-8
"""A place with less of the posterior is left out of the sums."""
_FOLDED_SHARE = 0.05
"""Share of the wires that fold back."""
_FOLDS, _FOLDS_APART_MM, _FOLD_ODDS = 4, 4.0, 60.0
"""How many places of a fold are tried, how far apart they are, mm, and by which logarithm a wire up to one may be less
likely than the likeliest."""

Status = Literal["found", "ambiguous", "not found"]
Expected = Callable[[int, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class TipEstimate:
    """Where the tip is, and how sure that is.

    Attributes:
        log_odds: logarithm of how much likelier the images are with a wire than without.
        position: of the tip, LPS mm of the CT.
        covariance: of the position, mm².
        share: of the posterior that lies near this position; the rest is elsewhere.
        elsewhere: what the rest adds to the covariance, mm².
        status: "found"; "ambiguous" where the tip may well lie elsewhere; "not found" where there is no wire.
        wire: places of the wire from the catheter to the tip, LPS mm.
        ends: branch (-1 in the catheter), abscissa, mm, and how likely a wire that does not fold ends there whatever
            its length, a logarithm, of every section.
    """

    log_odds: float
    position: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    share: float
    elsewhere: Float[np.ndarray, "3 3"]
    wire: Float[np.ndarray, "n 3"]
    ends: Float[np.ndarray, "sections 3"]
    status: Status = "found"
    shift: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    shift_covariance: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))


def longest_mm(inserted_length: float | None) -> float:
    """Return how long the way to the tip is at most, by the robot's encoder, mm; any length without one."""
    return np.inf if inserted_length is None else inserted_length + _LONGEST * _spread(inserted_length)[1]


def _spread(inserted_length: float | None) -> tuple[float, float]:
    """Return by how much the way to the tip is shorter and longer than the inserted length: standard deviations, mm."""
    if inserted_length is None:
        return np.inf, np.inf
    wire_mm = max(inserted_length, 0.0)
    return _NEAR_MM + _SHORTER_SHARE * wire_mm, _NEAR_MM + _LONGER_SHARE * wire_mm


def end_log(
    branch: int,
    abscissa: Float[np.ndarray, "n"],
    length: Float[np.ndarray, "n"],
    inserted_length: float | None,
    expected: Expected | None,
) -> Float[np.ndarray, "n"]:
    """Return how likely a wire ends at some places before images are seen, a logarithm; unnormalised.

    Args:
        branch: that they lie in; -1 for the catheter.
        abscissa: of the places, mm.
        length: of the wire up to them, mm.
        inserted_length, expected: as `estimate_tip` takes them.
    """
    shorter, longer = _spread(inserted_length)
    excess = length - (inserted_length or 0.0)
    log = -0.5 * (excess / np.where(excess > 0, longer, shorter)) ** 2
    if inserted_length is None and branch < 0:
        log = np.full(len(excess), -np.inf)
    return log if expected is None else log + expected(branch, abscissa)


def estimate_tip(
    corridor: Corridor,
    shown: Sequence[CorridorView],
    evidence: Sequence[Float32[np.ndarray, "rows columns"]],
    inserted_length: float | None,
    expected: Expected | None = None,
) -> TipEstimate:
    """Find the tip of a wire.

    Args:
        corridor: of the vessel.
        shown: it in each view, as registration has them.
        evidence: for each view the logarithm of how much likelier each pixel is on a wire than off it.
        inserted_length: Δ by the robot's encoder, mm; None where there is none.
        expected: how likely the tip is at places of a branch before the images are seen, a logarithm, by other times.
    """
    follower = Follower(corridor, shown, evidence)
    legs = follower.forwards()

    def weighed(some: Sequence[Leg], everywhere: Sequence[np.ndarray], share: float) -> list[np.ndarray]:
        whole = np.logaddexp.reduce(np.concatenate(everywhere)) - np.log(share)
        return [leg.log_scale + before(leg) - whole for leg in some]

    def before(leg: Leg) -> np.ndarray:
        abscissa = leg.passage.abscissa[leg.section]
        return end_log(leg.passage.branch, abscissa, leg.length, inserted_length, expected)

    ends = np.concatenate(
        [np.column_stack([np.full(len(leg.section), leg.passage.branch), leg.length, leg.log_scale]) for leg in legs]
    )
    places = [(one.branch, one.abscissa, one.abscissa) for one in corridor.passages]
    scores = weighed(legs, [end_log(*place, inserted_length, expected) for place in places], 1 - _FOLDED_SHARE)
    folds = _folds(legs, np.inf if inserted_length is None else inserted_length + 2 * _spread(inserted_length)[1])
    back = [one for leg, at in folds for one in follower.backwards(leg, at, longest_mm(inserted_length))]
    if back:
        scores += weighed(back, [before(leg) for leg in back], _FOLDED_SHARE)
        legs += back
    total = float(np.logaddexp.reduce(np.concatenate(scores)))
    # What lies in the catheter alone is a poor sign of a wire: the catheter is a dark line too.
    most = _MOST_OF_CATHETER if inserted_length is not None else 0.0
    catheter = max(float(legs[0].log_scale[-1]) - most, 0.0)
    weights = [np.exp(values - total) for values in scores]
    return _summary(follower, legs, weights, total - catheter, ends)


def _folds(legs: Sequence[Leg], deepest_mm: float) -> list[tuple[Leg, int]]:
    """Return where a wire may fold: the foremost places that it seems to reach, whatever its length there."""
    found: list[tuple[Leg, int]] = []
    ends = [(value, k, at) for k, leg in enumerate(legs) for at, value in enumerate(leg.log_scale)]
    ends.sort(reverse=True)
    for value, k, at in ends:
        leg = legs[k]
        if value < ends[0][0] - _FOLD_ODDS or len(found) == _FOLDS:
            break
        place = leg.passage.middle[leg.section[at]]
        apart = [np.linalg.norm(place - one.passage.middle[one.section[n]]) for one, n in found]
        if 0 < leg.length[at] <= deepest_mm and min(apart, default=np.inf) > _FOLDS_APART_MM:
            found.append((leg, at))
    return found


def _summary(
    follower: Follower,
    legs: Sequence[Leg],
    weights: Sequence[Float[np.ndarray, "n"]],
    log_odds: float,
    ends: Float[np.ndarray, "sections 3"],
) -> TipEstimate:
    """Return mean and covariance around the mode of the posterior, whose weight in each leg's sections is given."""
    best = int(np.argmax([weight.max() for weight in weights]))
    section = int(weights[best].argmax())
    here = legs[best].alpha[section, ..., None]
    mode = (here * legs[best].passage.places(legs[best].section[section : section + 1])[0]).sum(
        axis=(0, 1)
    ) / here.sum()
    parts = [_counted(leg, weight) for leg, weight in zip(legs, weights, strict=True)]
    places, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    near = ((places - mode) ** 2).sum(axis=1) <= MODE_MM**2
    # A cell has a size: that of a section's step and of its grid.
    share, mean, covariance = around_mode(places, weight, near, STEP_MM)
    far = places[~near] - mean
    elsewhere = (weight[~near, None] * far).T @ far
    return TipEstimate(
        log_odds=log_odds,
        position=mean,
        covariance=covariance,
        share=share,
        elsewhere=elsewhere,
        wire=places_of(follower.way(legs[best], section)),
        ends=ends,
    )


def around_mode(
    places: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"], near: Bool[np.ndarray, "n"], cell_mm: float
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the share of a posterior that lies near its mode, its mean there, and its covariance.

    Args:
        places: LPS mm.
        weight: of each.
        near: which lie near the mode.
        cell_mm: distance of neighbouring places, mm.
    """
    share = float(weight[near].sum())
    weight = weight[near] / share
    mean = weight @ places[near]
    off = places[near] - mean
    return share, mean, (weight[:, None] * off).T @ off + cell_mm**2 / 12 * np.eye(3)


def _counted(leg: Leg, weight: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Return the places of a leg that count in the posterior, LPS mm, and their weights."""
    sections = np.flatnonzero(weight > _NOTHING)
    share = weight[sections, None, None] * leg.alpha[sections]
    kept = np.flatnonzero(share.ravel() > _NOTHING)
    which, row, column = np.unravel_index(kept, share.shape)
    return leg.passage.place(leg.section[sections[which]], row, column), share.ravel()[kept]
