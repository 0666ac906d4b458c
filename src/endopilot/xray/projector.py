"""Line integrals through a patient: rays cast through a CT, and clouds of small volumes laid onto the detector."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter, map_coordinates

from endopilot.types import Volume
from endopilot.xray.absorbers import WATER_MM
from endopilot.xray.carm import View

_RAY_STEP_MM = 1.5
_SHARP_PX = 0.17
"""A Gaussian of a standard deviation below this leaves all of a pixel in it, to a part in 10⁷."""


def cast(ct: Volume, view: View, pixels: int, rays: int) -> Float32[np.ndarray, "rays rays"]:
    """Return the attenuation along rays through a CT; beyond its sides it goes on as at its edge.

    Args:
        ct: of the patient, HU.
        view: source and detector.
        pixels: of the image along a side.
        rays: along a side.
    """
    step = pixels / rays
    offset = ((np.arange(rays) + 0.5) * step - pixels / 2) / view.scale
    side, up = np.meshgrid(offset, -offset)
    direction = view.axes[2] + side[..., None] * view.axes[0] + up[..., None] * view.axes[1]
    size = np.array(ct.voxels.shape[::-1])
    corners = np.array(np.meshgrid(*([0, n - 1] for n in size))).reshape(3, -1).T
    depths = (ct.index_to_world(corners) - view.source) @ view.axes[2]
    into = ((direction @ ct.direction) / ct.spacing_mm).astype(np.float32)
    begin = (((view.source - ct.origin_mm) @ ct.direction) / ct.spacing_mm).astype(np.float32)
    total = np.zeros((rays, rays), dtype=np.float32)
    for depth in np.arange(depths.min(), depths.max(), _RAY_STEP_MM, dtype=np.float32):
        index = begin + depth * into
        values = map_coordinates(ct.voxels, np.moveaxis(index, -1, 0)[::-1], order=1, mode="nearest", output=np.float32)
        total += np.maximum(1 + values / 1000, 0)
    return total * np.float32(WATER_MM * _RAY_STEP_MM) * np.linalg.norm(direction, axis=-1).astype(np.float32)


def splat(
    view: View,
    pixels: int,
    points: Float[np.ndarray, "n 3"],
    volume: Float[np.ndarray, "n"] | float,
    *,
    width_mm: float = 0.0,
    blur_px: float = 0.0,
) -> Float32[np.ndarray, "pixels pixels"]:
    """Return line integrals of small volumes: each is shared among four pixels, then blurred.

    Args:
        view: source and detector.
        pixels: of the image along a side.
        points: places, LPS mm.
        volume: mm³, or mm² where it is weighted by an attenuation.
        width_mm: standard deviation of each in space, mm.
        blur_px: standard deviation of the detector's blur, pixels.
    """
    image = np.zeros((pixels, pixels), dtype=np.float32)
    in_view = (points - view.source) @ view.axes.T
    per_mm = view.scale / in_view[:, 2]
    at = np.stack([pixels / 2 - 0.5 - in_view[:, 1] * per_mm, pixels / 2 - 0.5 + in_view[:, 0] * per_mm], axis=-1)
    inside = ((at > 0) & (at < pixels - 1)).all(axis=1)
    if not inside.any():
        return image
    at, mass = at[inside], (np.broadcast_to(volume, len(points)) * per_mm**2)[inside]
    sigma = float(np.hypot(width_mm * per_mm.mean(), blur_px))
    reach = int(4 * sigma) + 1
    low = np.maximum(np.floor(at.min(axis=0)).astype(int) - reach, 0)
    high = np.minimum(np.floor(at.max(axis=0)).astype(int) + 2 + reach, pixels)
    rows, columns = high - low
    corner = np.floor(at).astype(int)
    rest, corner = at - corner, corner - low
    box = np.zeros(rows * columns)
    for row in (0, 1):
        for column in (0, 1):
            share = np.abs(1 - row - rest[:, 0]) * np.abs(1 - column - rest[:, 1])
            index = (corner[:, 0] + row) * columns + corner[:, 1] + column
            box += np.bincount(index, mass * share, minlength=rows * columns)
    image[low[0] : high[0], low[1] : high[1]] = blurred(box.reshape(rows, columns), sigma, mode="constant")
    return image


def blurred(
    image: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    sigma_px: float,
    mode: Literal["constant", "reflect"] = "reflect",
) -> Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]:
    """Return an image, blurred by a standard deviation in pixels, which may be too small to change it."""
    return image if sigma_px < _SHARP_PX else np.asarray(gaussian_filter(image, sigma_px, mode=mode))
