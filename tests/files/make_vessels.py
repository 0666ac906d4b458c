"""Masks of tubes along given lines, voxel by voxel, for the cases of this folder."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from endopilot.types import Volume


def line(*corners: Sequence[float]) -> np.ndarray:
    """Return points every 0.2 mm along straight pieces."""
    pieces = []
    for start, end in itertools.pairwise(np.array(corners, dtype=float)):
        count = max(2, int(np.linalg.norm(end - start) / 0.2))
        pieces.append(np.linspace(start, end, count))
    return np.concatenate(pieces)


def hairpin(limb_mm: float, gap_mm: float) -> np.ndarray:
    """Return a line up one limb along z, round a half circle and down the other, whose axes are `gap_mm` apart."""
    angle = np.linspace(np.pi, 0.0, 60)
    half = gap_mm / 2
    bend = np.stack([half * np.cos(angle), 0 * angle, limb_mm + half * np.sin(angle)], axis=1)
    return np.concatenate([line((-half, 0, 0), (-half, 0, limb_mm)), bend, line((half, 0, limb_mm), (half, 0, 0))])


def tubes(*lines: tuple[np.ndarray, float], voxel_mm: Sequence[float] = (0.5, 0.5, 0.5)) -> Volume:
    """Return the mask of the union of tubes of constant radius, with 3 mm of margin."""
    spacing = np.array(voxel_mm, dtype=float)
    lower = np.min([points.min(axis=0) - radius for points, radius in lines], axis=0) - 3.0
    upper = np.max([points.max(axis=0) + radius for points, radius in lines], axis=0) + 3.0
    size = np.ceil((upper - lower) / spacing).astype(int) + 1
    voxels = np.zeros(size[::-1], dtype=bool)
    for points, radius in lines:
        for point in points:
            low = np.maximum(np.floor((point - radius - lower) / spacing).astype(int), 0)
            high = np.minimum(np.ceil((point + radius - lower) / spacing).astype(int) + 1, size)
            axes = [lower[i] + spacing[i] * np.arange(low[i], high[i]) - point[i] for i in range(3)]
            square = axes[2][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[0] ** 2
            voxels[tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))] |= square < radius**2
    return Volume(voxels, spacing, lower, np.eye(3))


def thinned_at(mask: Volume, point: Sequence[float], length_mm: float, across: int, axis: int = 2) -> Volume:
    """Leave only `across` × `across` voxels over a length along one axis around a point of a straight tube."""
    voxels = mask.voxels.copy()
    centre = np.rint(mask.world_to_index(np.array(point, dtype=float))).astype(int)
    half = max(1, round(length_mm / float(mask.spacing_mm[axis]) / 2))
    window = [slice(max(0, c - 9), c + 10) for c in centre]
    window[axis] = slice(centre[axis] - half, centre[axis] - half + max(1, round(length_mm / mask.spacing_mm[axis])))
    keep = [slice(c, c + across) for c in centre]
    keep[axis] = window[axis]
    column = voxels[tuple(keep[::-1])].copy()
    voxels[tuple(window[::-1])] = False
    voxels[tuple(keep[::-1])] = column | True
    return Volume(voxels, mask.spacing_mm, mask.origin_mm, mask.direction)


def with_voxels(mask: Volume, start: Sequence[float], end: Sequence[float]) -> Volume:
    """Add a straight run of single voxels from one place to another."""
    voxels = mask.voxels.copy()
    along = np.linspace(np.array(start, dtype=float), np.array(end, dtype=float), 400)
    index = np.unique(np.rint(mask.world_to_index(along)).astype(int), axis=0)
    voxels[tuple(index[:, ::-1].T)] = True
    return Volume(voxels, mask.spacing_mm, mask.origin_mm, mask.direction)


def length_of(anatomy) -> float:
    """Return the length of all branches of an anatomy together, mm."""
    return sum(float(b.centerline.abscissa[-1] - b.centerline.abscissa[0]) for b in anatomy.tree.branches)
