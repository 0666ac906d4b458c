"""How far a vessel lies in an exposure from where registration has it, by the wire in the images: `displacements`.

A wire lies in the lumen. For each shift of the vessel, the evidence of a wire is summed along every way from the
catheter, at each place the best within the lumen; with how far ways are likely to go, that is how likely the images
make the shift. The vessel lies where it is registered, or so shifted: two hypotheses, whose wires are both followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import maximum_filter

from endopilot.types import Anatomy
from endopilot.xray.carm import Pose, View
from endopilot.xray.image import isocenter_of
from endopilot.xray.registration import Registration
from endopilot.xray.tip_posterior import TipEstimate
from endopilot.xray.vessel_grid import VesselGrid
from endopilot.xray.wire_following import Evidence

_EVERY = 4
"""Every so many cross-sections are read, 1 mm apart."""
_STEP_MM, _REACH = 0.8, 2.5
"""Distance of the shifts that are tried along each axis, mm, and how many standard deviations they reach."""
_ROOMS_PX = (1, 3, 5, 8)
"""Half widths of lumina that are told apart, pixels."""
_INDEPENDENT = 0.25
"""Weight of the sums: places in a lumen choose the best pixel of many, and neighbours share theirs."""
_DRIFTS_MM = 0.3
"""A vessel that lies shifted drifts by this from exposure to exposure, mm: an assumption."""


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


def displacements(
    grid: VesselGrid,
    room_mm: Float[np.ndarray, "n"],
    views: Sequence[View],
    evidence: Sequence[Evidence],
    covariance: Float[np.ndarray, "3 3"],
    ends: Float[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the vessel's shift, LPS mm, and its covariance, mm², by the images.

    Args:
        grid: of the vessel, its catheter before it.
        room_mm: how far from the centerline the wire's axis may lie, mm.
        views: of the images.
        evidence: of a wire in each pixel, a logarithm, around the vessel as far as shifts reach.
        covariance: of the shift before it is seen, mm².
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
    for view, image in zip(views, evidence, strict=True):
        score += _read(grid, room_mm, np.concatenate(runs), view, image, tried @ view.slope(ostium).T)
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
    share = np.exp(best + prior - np.logaddexp.reduce(best + prior))
    mean = share @ tried
    off = tried - mean
    left = covariance - seen.T @ (seen @ covariance @ seen.T) @ seen
    return mean, (share[:, None] * off).T @ off + _STEP_MM**2 / 12 * np.eye(3) + left


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
    part = image[low[0] : high[0], low[1] : high[1]]
    found = np.empty(row.shape, dtype=np.float32)
    for kind, half in enumerate(_ROOMS_PX):
        of = np.flatnonzero(wide == kind)
        if len(of):
            found[of] = maximum_filter(part, 2 * half + 1)[row[of] - low[0], column[of] - low[1]]
    tangent = points - grid.middle[np.maximum(grid.parent[places], 0)]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    across = np.sqrt(np.maximum(1 - (tangent @ view.axes[2]) ** 2, 0.04)).astype(np.float32)
    return found * across[:, None]
