"""The tip of a wire in the images of one exposure: where the wire ends that is followed through the vessel.

How likely the wire ends at a place, against no wire at all, is the tip's posterior: mean, uncertainty and the
probability that there is a wire follow from it. With two views the evidence of both is added, so the depth is found;
with one the vessel gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from endopilot.xray.wire_following import Follower, Leg

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
        ends: how likely a wire that does not fold ends at each place of the grid whatever its length, a logarithm.
        shift: how far the vessel lies from where registration has it, LPS mm.
        shift_covariance: of that, mm².
    """

    log_odds: float
    position: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    share: float
    elsewhere: Float[np.ndarray, "3 3"]
    wire: Float[np.ndarray, "n 3"]
    ends: Float[np.ndarray, "places"]
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


def end_log(length: Float[np.ndarray, "n"], inserted_length: float | None) -> Float[np.ndarray, "n"]:
    """Return how likely a wire ends at some places by the encoder, a logarithm; unnormalised.

    Args:
        length: of the wire up to them, mm; negative in the catheter, where none ends that no encoder tells of.
        inserted_length: by the encoder, mm; None where there is none.
    """
    if inserted_length is None:
        return np.where(length < 0, -np.inf, 0.0)
    shorter, longer = _spread(inserted_length)
    excess = length - inserted_length
    return -0.5 * (excess / np.where(excess > 0, longer, shorter)) ** 2


def estimate_tip(
    follower: Follower, inserted_length: float | None, expected: Float[np.ndarray, "places"] | None = None
) -> TipEstimate:
    """Find the tip of a wire.

    Args:
        follower: of wires through the vessel in the images.
        inserted_length: Δ by the robot's encoder, mm; None where there is none.
        expected: how likely the tip is at each place before the images are seen, a logarithm, by other times.
    """
    grid, legs = follower.grid, follower.forwards()
    by_time = np.zeros(len(grid.parent)) if expected is None else expected
    ends = np.full(len(grid.parent), -np.inf)
    for leg in legs:
        ends[leg.places] = leg.log_scale

    def before(leg: Leg) -> np.ndarray:
        return end_log(leg.length, inserted_length) + by_time[leg.places]

    anywhere = np.logaddexp.reduce(end_log(grid.abscissa, inserted_length) + by_time)
    scores = [leg.log_scale + before(leg) - anywhere + np.log(1 - _FOLDED_SHARE) for leg in legs]
    folds = _folds(
        follower, legs, np.inf if inserted_length is None else inserted_length + 2 * _spread(inserted_length)[1]
    )
    back = [follower.backwards(leg, at, longest_mm(inserted_length)) for leg, at in folds]
    if back:
        anywhere = np.logaddexp.reduce(np.concatenate([before(leg) for leg in back]))
        scores += [leg.log_scale + before(leg) - anywhere + np.log(_FOLDED_SHARE) for leg in back]
    total = float(np.logaddexp.reduce(np.concatenate(scores)))
    # What lies in the catheter alone is a poor sign of a wire: the catheter is a dark line too.
    most = _MOST_OF_CATHETER if inserted_length is not None else 0.0
    catheter = max(float(legs[0].log_scale[-1]) - most, 0.0)
    weights = [np.exp(values - total) for values in scores]
    return _summary(follower, [*legs, *back], weights, total - catheter, ends)


def _folds(follower: Follower, legs: Sequence[Leg], deepest_mm: float) -> list[tuple[Leg, int]]:
    """Return where a wire may fold: the foremost places that it seems to reach, whatever its length there."""
    found: list[tuple[Leg, int]] = []
    middle = follower.grid.middle
    ends = [(value, k, at) for k, leg in enumerate(legs) for at, value in enumerate(leg.log_scale)]
    ends.sort(reverse=True)
    for value, k, at in ends:
        leg = legs[k]
        if value < ends[0][0] - _FOLD_ODDS or len(found) == _FOLDS:
            break
        apart = [np.linalg.norm(middle[leg.places[at]] - middle[one.places[n]]) for one, n in found]
        if 0 < leg.length[at] <= deepest_mm and min(apart, default=np.inf) > _FOLDS_APART_MM:
            found.append((leg, at))
    return found


def _summary(
    follower: Follower,
    legs: Sequence[Leg],
    weights: Sequence[Float[np.ndarray, "n"]],
    log_odds: float,
    ends: Float[np.ndarray, "places"],
) -> TipEstimate:
    """Return mean and covariance around the mode of the posterior, whose weight at each leg's places is given."""
    best = int(np.argmax([weight.max() for weight in weights]))
    at, aside = int(weights[best].argmax()), follower.aside
    counted = [np.flatnonzero(weight > _NOTHING) for weight in weights]
    weight = np.concatenate([each[some] for each, some in zip(weights, counted, strict=True)])
    of = np.concatenate([leg.places[some] for leg, some in zip(legs, counted, strict=True)])
    alpha = np.concatenate([leg.alpha[some] for leg, some in zip(legs, counted, strict=True)])
    mean_px = alpha @ aside
    spread = np.maximum(alpha @ aside**2 - mean_px**2, 0.0) + 1 / 12
    places, within = follower.in_space(of, mean_px, spread)
    mode = places[int((weight * (of == legs[best].places[at])).argmax())]
    near = ((places - mode) ** 2).sum(axis=1) <= MODE_MM**2
    share, mean, covariance = around_mode(places, weight, near, follower.grid.step_mm)
    covariance = covariance + np.einsum("k,kij->ij", weight[near] / share, within[near])
    far = places[~near] - mean
    way, way_px = follower.way(legs[best], at)
    return TipEstimate(
        log_odds=log_odds,
        position=mean,
        covariance=covariance,
        share=share,
        elsewhere=(weight[~near, None] * far).T @ far,
        wire=follower.in_space(way, way_px, np.full(way_px.shape, 1 / 12))[0],
        ends=ends,
    )


def mixed(found: Sequence[tuple[float, TipEstimate]]) -> TipEstimate:
    """Return the likeliest of some estimates, given how likely each is; the others belong to its posterior."""
    (most, chosen), *others = sorted(found, key=lambda one: -one[0])
    share, covariance, elsewhere = most * chosen.share, chosen.covariance, most * chosen.elsewhere
    for weight, other in others:
        off = other.position - chosen.position
        if float(np.linalg.norm(off)) < MODE_MM:
            share, covariance = share + weight * other.share, covariance + weight * np.outer(off, off)
        else:
            elsewhere = elsewhere + weight * np.outer(off, off)
    return replace(chosen, share=share, covariance=covariance, elsewhere=elsewhere)


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
