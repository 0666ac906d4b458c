"""How far a vessel lies in an exposure from where registration has it, by the wire and the catheter: `displacements`.

The guiding catheter ends at the ostium, and a wire lies in the lumen. For each shift of the vessel, the evidence of a
wire is summed along every way from the catheter, at each place the best within the lumen: the joint posterior of tip
and shift on a coarse grid. The vessel lies where it is registered, or displaced: two hypotheses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter
from scipy.signal import fftconvolve

from endopilot.types import Anatomy
from endopilot.xray.absorbers import CATHETER_MM, catheter_points
from endopilot.xray.carm import Pose, View
from endopilot.xray.image import isocenter_of
from endopilot.xray.projector import splat
from endopilot.xray.registration import Registration
from endopilot.xray.tip_posterior import TipEstimate
from endopilot.xray.vessel_grid import VesselGrid
from endopilot.xray.wire_following import Evidence

_DRIFTS_MM = 0.3
"""A vessel that lies shifted drifts by this from exposure to exposure, mm: an assumption."""
_EVERY = 4
"""Every so many cross-sections are read, 1 mm apart."""
_STEP_MM, _REACH = 1.0, 2.5
"""Distance of the shifts that are tried along each axis, mm, and how many standard deviations they reach."""
_ROOMS_PX = (1, 3, 5, 8)
"""Half widths of lumina that are told apart, pixels."""
_TEMPERED = 0.35
_INDEPENDENT = 0.0625
"""Weight of the sums: places in a lumen choose the best pixel of many, and neighbours share theirs."""
_MODE_MM = 2.0
"""The moments of the shift are those of its posterior within this distance of the mode, mm."""
_NEGLIGIBLE = 0.02
"""A hypothesis less likely than this is left out."""
_SEAT_MM, _AHEAD = 10.0, 0.5
"""Length of the catheter whose end is looked for, mm, and the share by which a catheter as long before its end speaks
against it: the wire goes on there."""
_SEAT_PX, _SEAT_WEIGHT, _UNSEEN, _SEAT_SD_MM = 6.0, 0.1, 0.02, 0.5
"""Blur of the ground that is taken off, pixels; weight of the pixels, which share their ground; odds of each place,
over the likeliest's, where other lines hide the catheter; how far off the ostium it ends, mm: an assumption."""


Displacement = tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]
"""How likely a vessel lies so far from where it is registered, LPS mm, and the covariance of that, mm²."""


class Displaced:
    """Where a vessel lies from where it is registered, by all exposures so far.

    Attributes:
        shift: LPS mm of the CT, the likeliest.
        covariance: mm².
    """

    def __init__(self, anatomy: Anatomy, registration: Registration, sd_mm: float) -> None:
        """Begin with what registration leaves open, and how far a vessel may lie off besides, mm along each axis."""
        points, pose = anatomy.tree.line.points[::8], registration.pose
        isocenter = isocenter_of(anatomy)
        steps = np.linalg.cholesky(registration.covariance).T
        moved = [Pose.of_vector(pose.vector + step).move(points, isocenter) for step in steps]
        off = np.array(moved) - pose.move(points, isocenter)
        self.shift = np.zeros(3)
        self.covariance = np.einsum("kni,knj->ij", off, off) / len(points) + sd_mm**2 * np.eye(3)

    def views(self, views: Sequence[View]) -> list[View]:
        """Return views, in the CT's frame as it is registered, in that of the vessel as it lies."""
        return [replace(view, source=view.source - self.shift) for view in views]

    def update(self, found: TipEstimate) -> None:
        """Take what an exposure shows, a Kalman update; one view shows a shift across its beam alone."""
        if found.status == "found" and found.shift.any():
            gain = self.covariance @ np.linalg.inv(self.covariance + found.shift_covariance)
            self.shift = self.shift + gain @ found.shift
            self.covariance = (np.eye(3) - gain) @ self.covariance + _DRIFTS_MM**2 * np.eye(3)


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
        self._size = size * CATHETER_MM * np.repeat([1.0, -_AHEAD], len(part))

    def __call__(self, view: View, image: Evidence, shifts_px: Float[np.ndarray, "t 2"]) -> Float[np.ndarray, "t"]:
        """Return how likely an image makes some shifts of the vessel, pixels to the right and up, a logarithm.

        Args:
            view: of the image.
            image: logarithm of the light, contrast taken off.
            shifts_px: of the vessel.
        """
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
        log = _SEAT_WEIGHT * alike**2 / max(2 * float(dark.var() * (model**2).sum()), 1e-12)
        per_mm = view.scale / float((self._points[0] - view.source) @ view.axes[2])
        likely = gaussian_filter(np.exp(log - log.max()), _SEAT_SD_MM * per_mm)
        likely = np.log(likely / likely.max() + _UNSEEN)
        return map_coordinates(likely, reach + shifts_px[:, ::-1].T * [[-1], [1]], order=1, mode="nearest")


def displacements(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    views: Sequence[View],
    evidence: Sequence[Evidence],
    seats: Sequence[tuple[Seat, Evidence]],
    covariance: Float[np.ndarray, "3 3"],
    share: float,
    ends: Float[np.ndarray, "n"],
) -> list[Displacement]:
    """Return where the vessel may lie by the images, and how likely: where it is registered, and where it is displaced.

    Args:
        grid: of the vessel, its catheter before it.
        room_mm: how far from the centerline the wire's axis may lie, mm.
        views: of the images.
        evidence: of a wire in each pixel, a logarithm, around the vessel as far as shifts reach.
        seats: the end of the catheter, and the image that it is looked for in.
        covariance: of the shift before it is seen, mm².
        share: how likely the vessel is displaced, before it is seen.
        ends: how likely a wire ends at each place, a logarithm.
    """
    runs = [run[::_EVERY] for run in grid.runs()]
    catheter, ostium = runs[0], grid.middle[np.flatnonzero(grid.branch < 0)[-1]]
    rows = np.concatenate([view.slope(ostium) for view in views])
    # Shifts that no view shows are none: with one view, those along its beam.
    seen = np.linalg.svd(rows)[2][: min(2 * len(views), 3)]
    spread = np.sqrt(np.einsum("ai,ij,aj->a", seen, covariance, seen))
    along = [_STEP_MM * np.arange(-np.ceil(_REACH * s / _STEP_MM), np.ceil(_REACH * s / _STEP_MM) + 1) for s in spread]
    tried = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along)) @ seen
    prior = -0.5 * np.einsum("ti,ij,tj->t", tried, np.linalg.inv(covariance), tried)
    score = np.zeros((sum(map(len, runs)), len(tried)), dtype=np.float32)
    log = prior - np.logaddexp.reduce(prior)
    for view, image, (seat, plain) in zip(views, evidence, seats, strict=True):
        shifts_px = tried @ view.slope(ostium).T
        score += _read(grid, room_mm, np.concatenate(runs), view, image, shifts_px)
        log += seat(view, plain, shifts_px)
    # What is seen of the wire begins at the same place of the image, wherever the vessel lies.
    heading = grid.middle[catheter[1]] - grid.middle[catheter[0]]
    begins = 0.5 * grid.abscissa[catheter[0]]
    behind = grid.abscissa[catheter, None] + tried @ (heading / np.linalg.norm(heading))
    score[: len(behind)] *= np.clip(behind - begins, 0.0, 1.0)
    best, low = np.full(len(tried), -np.inf), 0
    sums: dict[int, np.ndarray] = {}
    for run, whole in zip(runs, grid.runs(), strict=True):
        before = sums.get(int(grid.parent[whole[0]]), 0.0)
        total = before + np.cumsum(score[low : low + len(run)], axis=0) * (_INDEPENDENT * _EVERY)
        sums[int(whole[-1])], low = total[-1], low + len(run)
        best = np.logaddexp(best, np.logaddexp.reduce(total + ends[run, None], axis=0))
    log += best
    still = len(tried) // 2
    odds = np.logaddexp.reduce(log) - log[still] + prior[still] - np.logaddexp.reduce(prior)
    odds += np.log(share / (1 - share))
    near = np.linalg.norm(tried - tried[log.argmax()], axis=1) <= _MODE_MM
    weight = np.exp(log[near] - np.logaddexp.reduce(log[near]))
    mean = weight @ tried[near]
    off = tried[near] - mean
    left = covariance - seen.T @ (seen @ covariance @ seen.T) @ seen
    found = (weight[:, None] * off).T @ off + _STEP_MM**2 / 12 * np.eye(3) + left
    displaced = float(1 / (1 + np.exp(-np.clip(odds, -50, 50))))
    both = [(1 - displaced, np.zeros(3), np.zeros((3, 3))), (displaced, mean, found)]
    return [one for one in both if one[0] > _NEGLIGIBLE]


def _read(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    places: Int[np.ndarray, "m"],
    view: View,
    image: Evidence,
    shifts_px: Float[np.ndarray, "t 2"],
) -> Float32[np.ndarray, "m t"]:
    """Return the best evidence within the lumen at some places, for each shift of the image."""
    points = grid.middle[places]
    per_mm = view.scale / ((points - view.source) @ view.axes[2])
    wide = np.abs((room_mm[places] * per_mm)[:, None] - _ROOMS_PX).argmin(axis=1)
    right_up, middle = view.project(points), (len(image) - 1) / 2
    row = np.rint(middle - right_up[:, 1:] - shifts_px[:, 1]).astype(np.int32)
    column = np.rint(middle + right_up[:, :1] + shifts_px[:, 0]).astype(np.int32)
    np.clip(row, 0, len(image) - 1, out=row)
    np.clip(column, 0, len(image) - 1, out=column)
    low, high = (row.min(), column.min()), (row.max() + 1, column.max() + 1)
    part = np.exp(image[low[0] : high[0], low[1] : high[1]] / _TEMPERED)
    found = np.empty(row.shape, dtype=np.float32)
    for kind, half in enumerate(_ROOMS_PX):
        of = np.flatnonzero(wide == kind)
        if len(of):
            mean = np.log(uniform_filter(part, 2 * half + 1) + 1e-9)
            found[of] = mean[row[of] - low[0], column[of] - low[1]]
    tangent = points - grid.middle[np.maximum(grid.parent[places], 0)]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    across = np.sqrt(np.maximum(1 - (tangent @ view.axes[2]) ** 2, 0.04)).astype(np.float32)
    return found * across[:, None]
