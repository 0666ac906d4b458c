"""The vessel's wall as triangles, light enough for a web page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import zoom
from skimage.measure import marching_cubes

from endopilot.types import DistanceMap

MAX_TRIANGLES = 45_000  # triangles of a wall at most: some 1.5 MB in a page


class WallMesh(NamedTuple):
    """Vertices, LPS mm, and the indices of the corners of each triangle."""

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]


def wall_mesh(distance_map: DistanceMap, *, max_triangles: int = MAX_TRIANGLES) -> WallMesh:
    """Return the surface where the distance to the wall is zero. Above `max_triangles`, the smooth distance map is
    first resampled on a coarser grid, which keeps the shape better than removing triangles."""
    values, origin = _cropped(distance_map)
    spacing = np.full(3, distance_map.spacing_mm)
    vertices, triangles = _march(values, spacing)
    while len(triangles) > max_triangles:
        factor = min(np.sqrt(max_triangles / len(triangles)) * 0.98, 0.95)
        # Without grid_mode the first and last grid points stay where they are.
        coarse = np.asarray(zoom(values, factor, order=1, grid_mode=False))
        spacing = spacing * (np.array(values.shape) - 1) / (np.array(coarse.shape) - 1)
        values = coarse
        vertices, triangles = _march(values, spacing)
    return WallMesh(vertices[:, ::-1] + origin, triangles)


def _march(
    values: Float32[np.ndarray, "nz ny nx"], spacing: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    vertices, triangles, _, _ = marching_cubes(values, level=0.0, spacing=tuple(spacing))
    return vertices.astype(float), triangles.astype(np.int64)


def _cropped(distance_map: DistanceMap) -> tuple[Float32[np.ndarray, "nz ny nx"], Float[np.ndarray, "3"]]:
    inside = np.asarray(distance_map.values) > 0
    found = [np.flatnonzero(inside.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    start = np.array([max(index[0] - 2, 0) for index in found])
    stop = np.array([index[-1] + 3 for index in found])
    # A lumen that reaches the edge of the map is closed there.
    padded = np.full(np.minimum(stop, inside.shape) - start + 2, -distance_map.spacing_mm, dtype=np.float32)
    padded[1:-1, 1:-1, 1:-1] = distance_map.values[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
    return padded, distance_map.origin_mm + (start[::-1] - 1) * distance_map.spacing_mm
