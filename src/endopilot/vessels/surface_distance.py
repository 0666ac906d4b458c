"""The signed distance to a lumen's wall on a grid."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from endopilot.imaging.grid import dilated
from endopilot.types import DistanceMap
from endopilot.vessels.surface import BAND_MM, Surface, grid_of

_NEAR_WALL = (2, 5)  # grid steps outside and inside the wall that are exact, the rest at every second point


def distance_map_from_surface(surface: Surface, *, spacing_mm: float, band_mm: float = BAND_MM) -> DistanceMap:
    """Return the signed distance to a closed triangulated wall (LPS mm), kept up to `band_mm` outside it."""
    lower = surface.vertices.min(axis=0) - band_mm
    shape, origin = grid_of(lower, surface.vertices.max(axis=0) + band_mm, spacing_mm)
    inside = surface.inside(shape, origin, spacing_mm)
    surface = surface.refined(3.0 * spacing_mm)
    wanted = dilated(inside, math.ceil(band_mm / spacing_mm) + 2)
    values = _far_field(surface, inside, wanted, origin, spacing_mm, band_mm)
    outside = dilated(inside, _NEAR_WALL[0]) & ~inside
    index = np.argwhere(outside)
    values[outside] = -surface.distance(origin + spacing_mm * index[:, ::-1], limit_mm=band_mm)
    shallow = inside & dilated(~inside, _NEAR_WALL[1])
    index = np.argwhere(shallow)
    values[shallow] = surface.distance(origin + spacing_mm * index[:, ::-1])
    return DistanceMap(values=values, spacing_mm=float(spacing_mm), origin_mm=origin)


def _far_field(
    surface: Surface,
    inside: Bool[np.ndarray, "nz ny nx"],
    wanted: Bool[np.ndarray, "nz ny nx"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    band: float,
) -> Float[np.ndarray, "nz ny nx"]:
    """Return signed distances from every second (far inside, fourth) point, linear between: errs by h²/2ρ at most."""
    half = np.full(tuple((np.array(inside.shape) + 1) // 2 + 1), -band, dtype=np.float32)
    second, asked = inside[::2, ::2, ::2], wanted[::2, ::2, ::2]
    if (deep := second & ~dilated(~second, _NEAR_WALL[1])).any():
        around = dilated(deep, 2) & second
        own = tuple(slice(0, size) for size in second.shape)
        half[own][deep] = _far_field(surface, second, around, origin, 2 * spacing, band)[deep]
        asked = asked & ~deep
    coarse = np.argwhere(asked)
    within = second[tuple(coarse.T)]
    for part, sign, limit in ((coarse[within], 1.0, np.inf), (coarse[~within], -1.0, band)):
        half[tuple(part.T)] = sign * surface.distance(origin + 2 * spacing * part[:, ::-1], limit_mm=limit)
    values = half
    for axis in (2, 1, 0):
        size, first = inside.shape[axis], (slice(None),) * axis
        finer = np.empty((*values.shape[:axis], size, *values.shape[axis + 1 :]), dtype=np.float32)
        even = finer[(*first, slice(None, None, 2))] = values[(*first, slice((size + 1) // 2))]
        after = values[(*first, slice(1, size // 2 + 1))]
        finer[(*first, slice(1, None, 2))] = 0.5 * (even[(*first, slice(size // 2))] + after)
        values = finer
    return values
