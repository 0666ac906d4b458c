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
    return Shadow(view, pixels, points).of(volume, width_mm=width_mm, blur_px=blur_px)


class Shadow:
    """Where small volumes fall on the detector, for the line integrals of several quantities of them."""

    def __init__(self, view: View, pixels: int, points: Float[np.ndarray, "n 3"]) -> None:
        """Project the volumes.

        Args:
            view: source and detector.
            pixels: of the image along a side.
            points: places, LPS mm.
        """
        self._pixels, self._count = pixels, len(points)
        in_view = (points - view.source) @ view.axes.T
        self._per_mm = view.scale / in_view[:, 2]
        row, column = pixels / 2 - 0.5 - in_view[:, 1] * self._per_mm, pixels / 2 - 0.5 + in_view[:, 0] * self._per_mm
        inside = (row > 0) & (row < pixels - 1) & (column > 0) & (column < pixels - 1)
        self._inside = np.flatnonzero(inside)
        if len(self._inside) < len(points):
            row, column = row[self._inside], column[self._inside]
        self._corner = np.floor(row).astype(int), np.floor(column).astype(int)
        self._rest = row - self._corner[0], column - self._corner[1]

    def of(
        self, volume: Float[np.ndarray, "n"] | float, *, width_mm: float = 0.0, blur_px: float = 0.0
    ) -> Float32[np.ndarray, "pixels pixels"]:
        """Return line integrals of the volumes; arguments as `splat` has."""
        pixels = self._pixels
        image = np.zeros((pixels, pixels), dtype=np.float32)
        if not len(self._inside):
            return image
        mass = (np.broadcast_to(volume, self._count) * self._per_mm**2)[self._inside]
        sigma = float(np.hypot(width_mm * self._per_mm.mean(), blur_px))
        reach = int(4 * sigma) + 1
        low = [max(int(corner.min()) - reach, 0) for corner in self._corner]
        high = [min(int(corner.max()) + 2 + reach, pixels) for corner in self._corner]
        rows, columns = high[0] - low[0], high[1] - low[1]
        first = (self._corner[0] - low[0]) * columns + (self._corner[1] - low[1])
        box = np.zeros(rows * columns)
        for down in (0, 1):
            for right in (0, 1):
                share = np.abs(1 - down - self._rest[0]) * np.abs(1 - right - self._rest[1])
                box += np.bincount(first + (down * columns + right), mass * share, minlength=rows * columns)
        image[low[0] : high[0], low[1] : high[1]] = blurred(box.reshape(rows, columns), sigma, mode="constant")
        return image


def blurred(
    image: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    sigma_px: float,
    mode: Literal["constant", "reflect"] = "reflect",
) -> Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]:
    """Return an image, blurred by a standard deviation in pixels, which may be too small to change it."""
    return image if sigma_px < _SHARP_PX else np.asarray(gaussian_filter(image, sigma_px, mode=mode))
