"""Analytic volumes for the imaging tests: tubes and balls whose insides are known in closed form."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from endopilot.types import Volume

FAT_HU, BLOOD_HU = -90.0, 400.0


def empty_grid(shape, spacing_mm, origin_mm) -> Volume:
    """Return a volume of zeros along the LPS axes; `shape` is (nz, ny, nx)."""
    spacing = np.broadcast_to(np.asarray(spacing_mm, dtype=float), 3).copy()
    return Volume(np.zeros(shape, dtype=np.float32), spacing, np.asarray(origin_mm, dtype=float), np.eye(3))


def positions(grid: Volume) -> np.ndarray:
    """Return the LPS position of every voxel, (nz, ny, nx, 3)."""
    k, j, i = np.indices(grid.voxels.shape)
    return grid.index_to_world(np.stack([i, j, k], axis=-1).astype(float))


def inside_tube(grid: Volume, points: np.ndarray, radius) -> np.ndarray:
    """Return where voxels lie within `radius` mm (one, or one a point) of a dense polyline."""
    reach = np.broadcast_to(radius, len(points))
    distance, nearest = KDTree(points).query(positions(grid), distance_upper_bound=reach.max())
    return distance < np.append(reach, 0.0)[nearest]


def scan(grid: Volume, hu: np.ndarray, *, blur_mm: float = 0.25, noise_hu: float = 20.0, seed: int = 0) -> Volume:
    """Return what a scanner makes of `hu`: blurred, noisy, whole numbers."""
    noise = np.random.default_rng(seed).normal(0.0, noise_hu, hu.shape)
    image = gaussian_filter(hu, blur_mm / grid.spacing_mm[::-1]) + noise
    return Volume(np.round(image).astype(np.int16), grid.spacing_mm, grid.origin_mm, grid.direction)


def dice(a: np.ndarray, b: np.ndarray) -> float:
    """Return the overlap 2|A∩B| / (|A| + |B|)."""
    return float(2 * (a & b).sum() / (a.sum() + b.sum()))
