"""The tip of a wire in the images of one exposure: one posterior of its place and of how far the vessel lies off.

A wire runs in the lumen from the catheter to its tip. In each cross-section the likelihood of a wire is the mean over
the lumen of how much likelier the pixels are on a wire than off it; summed along the way to a place, for each shift of
the vessel, that is how likely the wire ends there. Two views see two coordinates of a cross-section, so their evidence
adds up; with one the vessel gives the depth. A pixel counts once: what a way has covered says nothing of its later
places. The vessel lies where it is registered, or displaced; the guiding catheter's end shows where the ostium lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter
from scipy.signal import fftconvolve
from scipy.special import logsumexp

from endopilot.types import Anatomy
from endopilot.xray.absorbers import CATHETER_MM, catheter_points
from endopilot.xray.carm import View
from endopilot.xray.projector import splat
from endopilot.xray.vessel_grid import VesselGrid

Evidence = Float32[np.ndarray, "rows columns"]
Status = Literal["found", "ambiguous", "not found"]
_SHORTER_SHARE, _LONGER_SHARE, _NEAR_MM = 0.1, 0.04, 2.0
"""The way to the tip differs from the inserted length by 2 mm, and a tenth of it where it is shorter, since wires snake
and loop; it is hardly longer: wires only cut bends short."""
_MOST_OF_CATHETER = 20.0
"""The evidence of a wire in the catheter counts no more than this."""
MODE_MM = 4.0
"""Mean and covariance are those of the posterior within this distance of its mode, mm."""
_NOTHING = 1e-7
"""A place and shift with less of the posterior is left out of the sums."""
_FOLDED_SHARE, _FOLDS, _FOLDS_APART_MM, _FOLD_MM = 0.05, 4, 4, 45
"""Share of the wires that fold back, how many places of a fold are tried, how far apart they are, mm, and the length of
a wire behind its fold, mm."""
_STEP_MM, _REACH = 1.0, 2.0
"""Distance of the shifts that are tried along each axis, mm, and how many standard deviations they reach."""
_ALIKE = 0.25
"""Weight of the wire's evidence for a shift: all cross-sections share what is wrong with the lumen's shape. With 1 the
region of 95 % held 61 to 97 % of shifts, with this 83 to 100 (two synthetic arteries, 0 and 3 mm off)."""
_ROOMS_PX = (1, 2, 3, 5, 8, 12, 18)
"""Half widths of lumina that are told apart, pixels."""
_COVER_MM, _COVER_PX = 3.0, 3.0
"""A place is covered where the way this long before, mm, shows this near to it, pixels."""
_ASIDE = 0.2
"""Root mean square of the sine of the angle between a wire and the centerline: a wire along the beam is one dark spot,
which counts by its length in the image."""
_SEAT_MM, _AHEAD = 10.0, 0.5
"""Length of the catheter whose end is looked for, mm, and the share by which a catheter as long before its end speaks
against it: the wire goes on there."""
_SEAT_PX, _SEAT_WEIGHT, _UNSEEN, _SEAT_SD_MM = 6.0, 0.1, 0.05, 0.5
"""Blur of the ground that is taken off, pixels; weight of the pixels, which share their ground; odds of each place,
over the likeliest's, where other lines hide the catheter; how far off the ostium it ends, mm: an assumption."""


@dataclass(frozen=True, eq=False)
class TipEstimate:
    """Where the tip is, and how sure that is.

    Attributes:
        log_odds: logarithm of how much likelier the images are with a wire than without.
        mean: of the tip's place in the CT and of how far the vessel lies off, LPS mm.
        spread: covariance of these six numbers, mm².
        share: of the posterior that lies near this place; the rest is elsewhere.
        elsewhere: what the rest adds to the covariance of the place, mm².
        wire: places of the wire from the catheter to the tip, LPS mm of the CT.
        ends: how likely a wire that does not fold ends at each place of the grid whatever its length, a logarithm.
        folded: whether the wire folds back before its tip.
        status: "found"; "ambiguous" where the tip may well lie elsewhere; "not found" where there is no wire.
    """

    log_odds: float
    mean: Float[np.ndarray, "6"]
    spread: Float[np.ndarray, "6 6"]
    share: float
    elsewhere: Float[np.ndarray, "3 3"]
    wire: Float[np.ndarray, "n 3"]
    ends: Float[np.ndarray, "places"]
    folded: bool = False
    status: Status = "found"

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Of the tip, LPS mm of the CT."""
        return self.mean[:3]

    @property
    def covariance(self) -> Float[np.ndarray, "3 3"]:
        """Of the position, mm²; that of a tip which is ambiguous holds the places elsewhere."""
        return self.spread[:3, :3] + (self.elsewhere if self.status == "ambiguous" else 0.0)

    @property
    def shift(self) -> Float[np.ndarray, "3"]:
        """How far the vessel lies from where registration has it, LPS mm."""
        return self.mean[3:]


@dataclass(frozen=True, eq=False)
class Shifts:
    """How far the vessel may lie from where it is registered: not at all, the first, or displaced.

    Attributes:
        mm: each shift, LPS.
        log: how likely each is before a wire is seen, a logarithm.
        unseen: covariance of a displaced vessel's shift that no view shows, and of the steps between those tried, mm².
    """

    mm: Float[np.ndarray, "t 3"]
    log: Float[np.ndarray, "t"]
    unseen: Float[np.ndarray, "3 3"]


def possible_shifts(
    views: Sequence[View],
    ostium: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "3 3"],
    share: float,
) -> Shifts:
    """Return the shifts that are tried of a vessel that is displaced with this share and covariance, mm²."""
    rows = np.concatenate([view.slope(ostium) for view in views])
    # Shifts that no view shows are none: with one view, those along its beam.
    seen = np.linalg.svd(rows)[2][: min(2 * len(views), 3)]
    onto = covariance @ seen.T @ np.linalg.inv(seen @ covariance @ seen.T)  # the likeliest shift that is seen so
    spread = np.sqrt(np.einsum("ai,ij,aj->a", seen, covariance, seen))
    along = [_STEP_MM * np.arange(-np.ceil(_REACH * s / _STEP_MM), np.ceil(_REACH * s / _STEP_MM) + 1) for s in spread]
    tried = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along)) @ onto.T
    prior = -0.5 * np.einsum("ti,ij,tj->t", tried, np.linalg.inv(covariance), tried)
    log = np.append(np.log(1 - share), np.log(share) + prior - np.logaddexp.reduce(prior))
    left = covariance - onto @ seen @ covariance
    return Shifts(np.concatenate([np.zeros((1, 3)), tried]), log, left + _STEP_MM**2 / 12 * seen.T @ seen)


class Seat:
    """The end of the guiding catheter, as images show it."""

    def __init__(self, anatomy: Anatomy) -> None:
        """Take the catheter's last straight part, and as much before its end, where none is."""
        points, size = catheter_points(anatomy)
        ostium, heading = np.asarray(anatomy.insertion.position), np.asarray(anatomy.insertion.direction)
        behind = (points - ostium) @ heading
        near = (behind > -_SEAT_MM) & (np.linalg.norm(points - ostium, axis=1) < _SEAT_MM + anatomy.catheter_radius_mm)
        part, behind = points[near], behind[near]
        self._points = np.concatenate([part, part - 2 * behind[:, None] * heading])
        self._size = np.tile(size[near], 2) * CATHETER_MM * np.repeat([1.0, -_AHEAD], len(part))

    def __call__(self, view: View, image: Evidence, shifts_px: Float[np.ndarray, "t 2"]) -> Float[np.ndarray, "t"]:
        """Return how likely an image without contrast makes some shifts of the vessel, right and up, a logarithm."""
        reach = int(np.ceil(np.abs(shifts_px).max())) + 1
        model = splat(view, len(image), self._points, self._size)
        rows, columns = np.nonzero(model)
        if len(rows) < 2:
            return np.zeros(len(shifts_px))
        low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
        model = model[low[0] : high[0], low[1] : high[1]]
        wide = [np.clip(np.arange(a - reach, b + reach), 0, len(image) - 1) for a, b in zip(low, high, strict=True)]
        dark = -image[np.ix_(*wide)]
        model, dark = (one - gaussian_filter(one, _SEAT_PX) for one in (model, dark))
        alike = np.maximum(fftconvolve(dark, model[::-1, ::-1], mode="valid"), 0.0)
        noise = 1.4826 * float(np.median(np.abs(dark)))  # of normal errors; the wire is no noise
        log = _SEAT_WEIGHT * alike**2 / max(2 * noise**2 * float((model**2).sum()), 1e-12)
        per_mm = view.scale / float((self._points[0] - view.source) @ view.axes[2])
        likely = gaussian_filter(np.exp(log - log.max()), _SEAT_SD_MM * per_mm)
        likely = np.log(likely / likely.max() + _UNSEEN)
        return map_coordinates(likely, reach + shifts_px[:, ::-1].T * [[-1], [1]], order=1, mode="nearest")


def end_log(length: Float[np.ndarray, "n"], inserted_length: float | None) -> Float[np.ndarray, "n"]:
    """Return how likely a wire ends so many mm from the ostium by the encoder, mm, a logarithm; unnormalised.

    Where there is no encoder none ends in the catheter, whose lengths are negative.
    """
    if inserted_length is None:
        return np.where(length < 0, -np.inf, 0.0)
    excess = length - inserted_length
    share = np.where(excess > 0, _LONGER_SHARE, _SHORTER_SHARE)
    return -0.5 * (excess / (_NEAR_MM + share * max(inserted_length, 0.0))) ** 2


def estimate_tip(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    views: Sequence[View],
    evidence: Sequence[Evidence],
    shifts: Shifts,
    inserted_length: float | None,
    expected: Float[np.ndarray, "n"] | None = None,
) -> TipEstimate:
    """Find the tip of a wire.

    Args:
        grid: of the vessel, its catheter before it.
        room_mm: how far from the centerline the wire's axis may lie, mm.
        views: of the images.
        evidence: how much likelier each pixel is on a wire than off it, a logarithm.
        shifts: of the vessel.
        inserted_length: Δ by the robot's encoder, mm; None where there is none.
        expected: how likely the tip is at each place before the images are seen, a logarithm, by other times; together,
            how much likelier there is a wire than none.
    """
    way = _way(grid, room_mm, views, evidence, shifts.mm)
    by_time = np.zeros(len(way)) if expected is None else expected
    ends = end_log(grid.abscissa, inserted_length) + by_time
    ends = ends - logsumexp(ends)
    by_shift = logsumexp(way + ends[:, None], axis=0)
    # What lies in the catheter alone is a poor sign of a wire: the catheter is a dark line too.
    most = _MOST_OF_CATHETER if inserted_length is not None else 0.0
    catheter = max(float(way[np.flatnonzero(grid.branch < 0)[-1]].max()) - most, 0.0)
    told = 0.0 if expected is None else float(logsumexp(expected))
    log_odds = float(logsumexp(shifts.log + by_shift)) + told - catheter
    level = shifts.log + _ALIKE * by_shift
    level -= logsumexp(level)
    kept = level > np.log(_NOTHING)
    way, shifts = way[:, kept], replace(shifts, mm=shifts.mm[kept], log=level[kept])
    log = way + ends[:, None] + shifts.log - by_shift[kept]
    place, fold = np.arange(len(way)), np.arange(len(way))
    if inserted_length is not None:
        second = np.zeros(len(way))
        for view, image in zip(views, evidence, strict=True):
            second += _second_strand(grid, room_mm, view, image, shifts.mm[shifts.log.argmax()])
        back, at, seen = _folds(grid, way, shifts.log - by_shift[kept], second)
        before = end_log(2 * grid.abscissa[at] - grid.abscissa[back], inserted_length) + by_time[back]
        before += seen + np.log(_FOLDED_SHARE / (1 - _FOLDED_SHARE)) - np.logaddexp.reduce(before, initial=-np.inf)
        place, fold = np.append(place, back), np.append(fold, at)
        log = np.concatenate([log, way[at] + before[:, None] + shifts.log - by_shift[kept]])
    return _summary(
        grid,
        room_mm,
        shifts,
        log - logsumexp(log),
        (place, fold),
        log_odds=log_odds,
        ends=logsumexp(way + shifts.log - by_shift[kept], axis=1),
    )


def _summary(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    shifts: Shifts,
    log: Float[np.ndarray, "k t"],
    of: tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]],
    *,
    log_odds: float,
    ends: Float[np.ndarray, "n"],
) -> TipEstimate:
    """Return mean and covariance around the mode of a posterior, given where each row's wire ends, and where it folds.

    Rows of wires that do not fold are the places of the grid.
    """
    row, shift = np.nonzero(log > np.log(_NOTHING))
    weight, place = np.exp(log[row, shift]), of[0][row]
    back = row >= len(grid.parent)
    folded = bool(weight[back].sum() > 0.5)
    own = np.where(back == folded, weight, 0.0)
    mode = int(np.bincount(place, own).argmax())
    near = ((grid.middle[place] - grid.middle[mode]) ** 2).sum(axis=1) <= MODE_MM**2
    share, mean, spread = around_mode(np.concatenate([grid.middle[place], shifts.mm[shift]], axis=1), weight, near, 0.0)
    tangent = grid.middle[mode] - grid.middle[max(int(grid.parent[mode]), 0)]
    tangent /= max(float(np.linalg.norm(tangent)), 1e-9)
    spread[:3, :3] += grid.step_mm**2 / 12 * np.eye(3)
    # A wire lies on the wall, anywhere around.
    spread[:3, :3] += max(room_mm[mode], grid.step_mm) ** 2 / 2 * (np.eye(3) - np.outer(tangent, tangent))
    displaced = shifts.mm[shift].any(axis=1)
    spread[3:, 3:] += float(weight[near & displaced].sum()) / share * shifts.unseen
    far = grid.middle[place[~near]] - mean[:3]
    reached = int(of[1][row[(own * (place == mode)).argmax()]])
    path = grid.behind[reached, : grid.depth[reached] + 1]
    path = np.append(path[::-1], path[1 : 1 + int(grid.depth[reached] - grid.depth[mode])])
    return TipEstimate(
        log_odds=log_odds,
        mean=mean,
        spread=spread,
        share=share,
        elsewhere=(weight[~near, None] * far).T @ far,
        wire=np.concatenate([grid.middle[path[:-1]], mean[None, :3]]),
        ends=ends,
        folded=folded,
    )


def _folds(
    grid: VesselGrid, way: Float[np.ndarray, "n t"], log: Float[np.ndarray, "t"], second: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Return where wires may end that fold, where they fold, and the evidence of the strand behind the fold.

    They fold at the foremost places that a wire seems to reach, whatever its length there.
    """
    reached = np.where(grid.abscissa > 0, logsumexp(way + log, axis=1), -np.inf)
    rows = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for _ in range(_FOLDS):
        at = int(reached.argmax())
        if not np.isfinite(reached[at]):
            break
        back = grid.behind[at, 1 : min(round(_FOLD_MM / grid.step_mm), int(grid.depth[at]))]
        back = back[grid.branch[back] >= 0]
        rows.append((back, np.full(len(back), at), np.cumsum(second[back])))
        reached[grid.distance[at] < _FOLDS_APART_MM] = -np.inf
    back, at, seen = (np.concatenate(part) for part in zip(*rows, strict=True))
    return back, at, seen


def _second_strand(
    grid: VesselGrid, room_mm: Float[np.ndarray, "n"], view: View, image: Evidence, shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Return the evidence that two strands of a wire lie at each place, over that of one, a logarithm.

    Half of the time one strand hides the other.
    """
    points = grid.middle + shift
    shown, per_mm = view.project(points), view.scale / ((points - view.source) @ view.axes[2])
    ahead = shown - shown[np.maximum(grid.parent, 0)]
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
    room_px = np.maximum(room_mm * per_mm, 1.0)
    aside = np.arange(-np.ceil(room_px.max()), np.ceil(room_px.max()) + 1)
    at = shown[:, None] + aside[:, None] * across[:, None]
    middle = (len(image) - 1) / 2
    likelier = np.exp(map_coordinates(image, [middle - at[..., 1], middle + at[..., 0]], order=1))
    likelier *= np.abs(aside) <= room_px[:, None]
    apart = (np.abs(aside[:, None] - aside) > _COVER_PX).astype(float)
    count = (np.abs(aside) <= room_px[:, None]).astype(float)
    one = likelier.sum(axis=1) / count.sum(axis=1)
    pairs = np.einsum("ni,ij,nj->n", likelier, apart, likelier)
    number = np.maximum(np.einsum("ni,ij,nj->n", count, apart, count), 1.0)
    return _new_mm(grid, shown, per_mm) * np.log(0.5 + 0.5 * pairs / number / np.maximum(one, 1e-6))


def _way(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    views: Sequence[View],
    evidence: Sequence[Evidence],
    shifts: Float[np.ndarray, "t 3"],
) -> Float[np.ndarray, "n t"]:
    """Return the evidence of a wire on the way to each place, for each shift of the vessel."""
    catheter = np.flatnonzero(grid.branch < 0)
    ostium = grid.middle[catheter[-1]]
    score = np.zeros((len(grid.parent), len(shifts)), dtype=np.float32)
    for view, image in zip(views, evidence, strict=True):
        score += _read(grid, room_mm, view, image, shifts @ view.slope(ostium).T)
    # What is seen of the wire begins at the same place of the image, wherever the vessel lies.
    heading = grid.middle[catheter[1]] - grid.middle[catheter[0]]
    behind = grid.abscissa[catheter, None] + shifts @ (heading / np.linalg.norm(heading))
    score[catheter] *= np.clip((behind - 0.5 * grid.abscissa[catheter[0]]) / grid.step_mm, 0.0, 1.0)
    for run in grid.runs():
        score[run] = np.cumsum(score[run], axis=0) + (score[grid.parent[run[0]]] if grid.parent[run[0]] >= 0 else 0.0)
    return score.astype(float)


def _read(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    view: View,
    image: Evidence,
    shifts_px: Float[np.ndarray, "t 2"],
) -> Float32[np.ndarray, "n t"]:
    """Return the mean likelihood of a wire over the lumen at each place, a logarithm, for each shift of the image."""
    points, shown = grid.middle, view.project(grid.middle)
    per_mm = view.scale / ((points - view.source) @ view.axes[2])
    wide = np.abs((room_mm * per_mm)[:, None] - _ROOMS_PX).argmin(axis=1)
    middle = (len(image) - 1) / 2
    row = np.rint(middle - shown[:, 1:] - shifts_px[:, 1]).astype(np.int32)
    column = np.rint(middle + shown[:, :1] + shifts_px[:, 0]).astype(np.int32)
    seen = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < len(image))
    np.clip(row, 0, len(image) - 1, out=row)
    np.clip(column, 0, len(image) - 1, out=column)
    low, high = (row.min(), column.min()), (row.max() + 1, column.max() + 1)
    likelier = np.exp(image[low[0] : high[0], low[1] : high[1]])
    found = np.empty(row.shape, dtype=np.float32)
    for kind, half in enumerate(_ROOMS_PX):
        of = np.flatnonzero(wide == kind)
        if len(of):
            mean = np.log(np.maximum(uniform_filter(likelier, 2 * half + 1), 1e-6))
            found[of] = mean[row[of] - low[0], column[of] - low[1]]
    return seen * found * _new_mm(grid, shown, per_mm)[:, None].astype(np.float32)


def _new_mm(
    grid: VesselGrid, shown: Float[np.ndarray, "n 2"], per_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return how much of each step shows in an image, mm: little of a wire along the beam, nothing of one covered."""
    step = np.linalg.norm(shown - shown[np.maximum(grid.parent, 0)], axis=1)
    step[0] = step[1]
    new = grid.step_mm * np.hypot(np.minimum(step / (per_mm * grid.step_mm), 1.0), _ASIDE)
    first = round(_COVER_MM / grid.step_mm)
    behind = grid.behind[:, first:]
    near = np.linalg.norm(shown[behind] - shown[:, None], axis=-1) < _COVER_PX
    covered = near & (np.arange(behind.shape[1]) + first <= grid.depth[:, None])
    return np.where(covered.any(axis=1), 0.0, new)


def around_mode(
    places: Float[np.ndarray, "n d"], weight: Float[np.ndarray, "n"], near: Bool[np.ndarray, "n"], cell_mm: float
) -> tuple[float, Float[np.ndarray, "d"], Float[np.ndarray, "d d"]]:
    """Return the share of a posterior that lies near its mode, its mean there, and its covariance.

    Neighbouring places lie `cell_mm` apart.
    """
    share = float(weight[near].sum())
    weight = weight[near] / share
    mean = weight @ places[near]
    off = places[near] - mean
    return share, mean, (weight[:, None] * off).T @ off + cell_mm**2 / 12 * np.eye(places.shape[1])
