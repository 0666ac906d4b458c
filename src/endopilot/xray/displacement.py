"""How far a vessel lies in an exposure from where registration has it, by the wire in the images: `displacements`.

A wire lies in the lumen. For each shift of the vessel, the evidence of a wire is summed along every way from the
catheter, at each place the best within the lumen; with how far ways are likely to go, that is how likely the images
make the shift. The vessel either lies where it is registered, but for what the lumen's room hides, or elsewhere by a
normal distribution: two hypotheses, whose wires are then followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import maximum_filter

from endopilot.types import Anatomy
from endopilot.xray.carm import Pose, View
from endopilot.xray.corridor import Corridor
from endopilot.xray.corridor_view import Evidence
from endopilot.xray.image import isocenter_of
from endopilot.xray.registration import Registration
from endopilot.xray.tip_posterior import TipEstimate

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


@dataclass(frozen=True, eq=False)
class Displacement:
    """A shift of the vessel.

    Attributes:
        shift: LPS mm.
        covariance: mm².
        log_odds: logarithm of how likely it is against a vessel that lies where it is registered.
    """

    shift: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    log_odds: float


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
    corridor: Corridor,
    views: Sequence[View],
    evidence: Sequence[Evidence],
    covariance: Float[np.ndarray, "3 3"],
    ends: Sequence[Float[np.ndarray, "n"]],
) -> Displacement:
    """Return the likeliest shift of the vessel.

    Args:
        corridor: of the vessel.
        views: of the images.
        evidence: of a wire in each pixel, a logarithm, around the corridor as far as shifts reach.
        covariance: of the shift before it is seen, mm².
        ends: for each passage how likely a wire ends in each section, a logarithm.
    """
    rows = np.concatenate([view.slope(corridor.passages[0].middle[-1]) for view in views])
    # Shifts that no view shows are none: with one view, those along its beam.
    seen = np.linalg.svd(rows)[2][: min(2 * len(views), 3)]
    spread = np.sqrt(np.einsum("ai,ij,aj->a", seen, covariance, seen))
    along = [_STEP_MM * np.arange(-np.ceil(_REACH * s / _STEP_MM), np.ceil(_REACH * s / _STEP_MM) + 1) for s in spread]
    tried = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(along)) @ seen
    prior = -0.5 * np.einsum("ti,ij,tj->t", tried, np.linalg.inv(covariance), tried)
    score = np.zeros((sum(len(one.middle[::_EVERY]) for one in corridor.passages), len(tried)), dtype=np.float32)
    for view, image in zip(views, evidence, strict=True):
        score += _read(corridor, view, image, tried @ view.slope(corridor.passages[0].middle[-1]).T)
    # What is seen of the wire begins at the same place of the image, wherever the vessel lies.
    catheter = corridor.passages[0]
    begins = catheter.abscissa[0] + 0.5 * np.ptp(catheter.abscissa)
    behind = catheter.abscissa[::_EVERY, None] + tried @ np.cross(catheter.first[0], catheter.second[0])
    score[: len(behind)] *= np.clip(behind - begins, 0.0, 1.0)
    best, low, sums = np.full(len(tried), -np.inf), 0, []
    for passage, log in zip(corridor.passages, ends, strict=True):
        high = low + len(passage.middle[::_EVERY])
        before = sums[passage.parent][-1] if passage.parent >= 0 else 0.0
        sums.append(before + np.cumsum(score[low:high], axis=0) * (_INDEPENDENT * _EVERY))
        best = np.logaddexp(best, np.logaddexp.reduce(sums[-1] + log[::_EVERY, None], axis=0))
        low = high
    here = int((tried**2).sum(axis=1).argmin())
    log = best + prior
    share = np.exp(log - np.logaddexp.reduce(log))
    mean = share @ tried
    off = tried - mean
    left = covariance - seen.T @ (seen @ covariance @ seen.T) @ seen
    return Displacement(
        shift=mean,
        covariance=(share[:, None] * off).T @ off + _STEP_MM**2 / 12 * np.eye(3) + left,
        log_odds=float(np.logaddexp.reduce(log) - np.logaddexp.reduce(prior) - best[here]),
    )


def _read(
    corridor: Corridor, view: View, image: Evidence, shifts_px: Float[np.ndarray, "t 2"]
) -> Float32[np.ndarray, "m t"]:
    """Return the best evidence within the lumen at every fourth section, for each shift of the image."""
    points = np.concatenate([one.middle[::_EVERY] for one in corridor.passages])
    per_mm = view.scale / ((points - view.source) @ view.axes[2])
    room_px = np.concatenate([one.room[::_EVERY] for one in corridor.passages]) * per_mm
    wide = np.abs(room_px[:, None] - _ROOMS_PX).argmin(axis=1)
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
    tangent = np.concatenate([np.cross(one.first, one.second)[::_EVERY] for one in corridor.passages])
    across = np.sqrt(np.maximum(1 - (tangent @ view.axes[2]) ** 2, 0.04)).astype(np.float32)
    return found * across[:, None]
