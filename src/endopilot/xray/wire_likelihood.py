"""What the images of one exposure say of a wire, for each place of its tip and each shift of the vessel.

A wire runs in the lumen from the catheter to its tip. In each cross-section the likelihood of a wire is the mean over
the lumen of how much likelier the pixels are on a wire than off it; summed along the way to a place, for each shift of
the vessel, that is how likely the wire ends there. Two views see two coordinates of a cross-section, so their evidence
adds up; with one the vessel gives the depth. A pixel counts once: what a way has covered says nothing of its later
places. The vessel lies where it is registered, or displaced; the guiding catheter's end shows where the ostium lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter
from scipy.signal import fftconvolve
from scipy.special import logsumexp

from endopilot.types import Anatomy
from endopilot.xray.absorbers import CATHETER_MM, catheter_points
from endopilot.xray.carm import Image, Vector, View
from endopilot.xray.projector import Shadow
from endopilot.xray.tip_posterior import Told, VesselGrid

_SHORTER_SHARE, _LONGER_SHARE, _NEAR_MM = 0.1, 0.04, 2.0
"""The way to the tip differs from the inserted length by 2 mm, and a tenth of it where it is shorter, since wires snake
and loop; it is hardly longer: wires only cut bends short."""
_FOLDED_SHARE, _FOLD_MM = 0.1, 45.0
"""Share of the wires that fold back (5 of 36 in three arteries), and the longest part behind a fold, mm."""
_STEP_MM, _REACH = 1.0, 2.0
"""Distance of the shifts that are tried along each axis, mm, and how many standard deviations they reach."""
_NOTHING = 1e-7
"""Shifts, and places that a wire reaches, with less of the posterior are left out of the sums."""
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
    views: Sequence[View], ostium: Vector, covariance: Float[np.ndarray, "3 3"], share: float
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

    def __call__(self, view: View, image: Image, shifts_px: Float[np.ndarray, "t 2"]) -> Float[np.ndarray, "t"]:
        """Return how likely an image without contrast makes some shifts of the vessel, right and up, a logarithm."""
        reach = int(np.ceil(np.abs(shifts_px).max())) + 1
        model = Shadow(view, len(image), self._points).of(self._size)
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


def end_log(length: Float[np.ndarray, "n"], inserted_length: float) -> Float[np.ndarray, "n"]:
    """Return how likely a wire ends so many mm from the ostium by the encoder, mm, a logarithm; unnormalised."""
    excess = length - inserted_length
    share = np.where(excess > 0, _LONGER_SHARE, _SHORTER_SHARE)
    return -0.5 * (excess / (_NEAR_MM + share * max(inserted_length, 0.0))) ** 2


def tell(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    way: Float[np.ndarray, "n t"],
    shifts: Shifts,
    prior: Float[np.ndarray, "n"],
) -> tuple[Told, float]:
    """Return what the evidence of wires to each place, for each shift of the vessel, says of the tip, and the logarithm
    of how much likelier it is with a wire than without. The prior is of each place, a logarithm, from -inf to 0."""
    prior = prior - logsumexp(prior)
    by_shift = logsumexp(way + prior[:, None], axis=0)
    log_odds = float(logsumexp(shifts.log + by_shift))
    level = shifts.log + _ALIKE * by_shift
    level -= logsumexp(level)
    kept = level > np.log(_NOTHING)
    shifts = Shifts(shifts.mm[kept], shifts.log[kept], shifts.unseen)
    log = way[:, kept] + (level - by_shift)[kept]
    of_place = logsumexp(log, axis=1)
    weight = np.exp(log - of_place[:, None])
    shift = weight @ shifts.mm
    pairs = (shifts.mm[:, :, None] * shifts.mm[:, None]).reshape(-1, 9)
    displaced = weight @ shifts.mm.any(axis=1)
    tangent = grid.middle - grid.middle[np.maximum(grid.parent, 0)]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    spread = np.zeros((len(way), 6, 6))
    # A wire lies on the wall, anywhere around.
    across = np.eye(3) - tangent[:, :, None] * tangent[:, None]
    spread[:, :3, :3] = np.maximum(room_mm, grid.step_mm)[:, None, None] ** 2 / 2 * across
    spread[:, 3:, 3:] = (weight @ pairs).reshape(-1, 3, 3) - shift[:, :, None] * shift[:, None]
    spread[:, 3:, 3:] += displaced[:, None, None] * shifts.unseen
    told = Told(np.arange(len(way)), of_place, np.concatenate([0 * shift, shift], axis=1), spread)
    return told, log_odds


def or_folded(grid: VesselGrid, told: Told, ends: Float[np.ndarray, "n"], inserted_length: float) -> Told:
    """Return what is said of a tip that may lie behind the place that the wire reaches, as far as the encoder says."""
    likely = told.log > (told.log + ends).max() + np.log(_NOTHING)
    behind = grid.behind[:, 1 : round(_FOLD_MM / grid.step_mm)]
    within = (grid.branch[behind] >= 0) & (np.arange(behind.shape[1]) < grid.depth[:, None])
    reached, back = np.nonzero(within & likely[:, None])
    back = behind[reached, back]
    share = np.log(_FOLDED_SHARE * grid.step_mm / _FOLD_MM)
    fold = share + end_log(2 * grid.abscissa[reached] - grid.abscissa[back], inserted_length) - ends[back]
    log = told.log.copy()
    np.logaddexp.at(log, back, told.log[reached] + fold)
    return told._replace(log=log)


def way_to(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    views: Sequence[View],
    evidence: Sequence[Image],
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
    grid: VesselGrid, room_mm: Float[np.ndarray, "n"], view: View, image: Image, shifts_px: Float[np.ndarray, "t 2"]
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
