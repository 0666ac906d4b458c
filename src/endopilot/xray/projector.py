"""Line integrals through a patient: rays cast through a CT, and clouds of small volumes laid onto the detector."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import gaussian_filter, zoom

from endopilot.types import Volume
from endopilot.xray.absorbers import WATER_MM
from endopilot.xray.carm import Affine, Image, Places, View

_RAY_STEP_MM = 1.5
_COARSE_MM, _COARSE_RAYS, _SIDES_MM = 8.0, 64, 15.0
"""What lies beyond a CT's sides: its voxels, mm, the rays along a side of the image, and how far is averaged, mm."""
_BODY_MM = (161.0, 122.0)
"""Half the breadth and depth of a chest about the CT's middle, mm: 322 and 243 mm, means of men in ANSUR 1988."""
_AIR_HU = -1000.0
_SHARP_PX = 0.17
"""A Gaussian of a standard deviation below this leaves all of a pixel in it, to a part in 10⁷."""

_APART = 8
"""So many pixels lie between the rows of an image that is blurred: columns of one whose rows are a power of two apart
compete for the same lines of the processor's cache, which doubles the time."""


def cast(ct: Volume, view: View, pixels: int, rays: int) -> Float32[np.ndarray, "rays rays"]:
    """Return the attenuation along so many rays a side through a CT, HU, and through the body beyond its sides."""
    # A layer of air ends the volume half a voxel beyond its last middles.
    aired = np.pad(ct.voxels, 1, constant_values=_AIR_HU)
    inside = Volume(aired, ct.spacing_mm, ct.index_to_world(-np.ones(3)), ct.direction)
    beyond = _march(_beyond(ct), view, pixels, _COARSE_RAYS, _COARSE_MM / 2)
    wide = zoom(beyond, rays / _COARSE_RAYS, order=1, grid_mode=True, mode="nearest")
    return _march(inside, view, pixels, rays, _RAY_STEP_MM) + wide


def _beyond(ct: Volume) -> Volume:
    """Return the body around a CT, HU, with air where the CT is. It goes on as the CT's sides do on average, as far as
    a chest reaches, and to head and feet without end: around a CT that holds it whole, with air at its sides, is
    none."""
    size = np.array(ct.voxels.shape[::-1])
    count = np.maximum(np.rint(size * ct.spacing_mm / _COARSE_MM), 2).astype(int)
    index = np.stack(np.meshgrid(*(np.linspace(0, n - 1, k) for n, k in zip(size, count, strict=True)), indexing="ij"))
    sampled = _between(ct.voxels.astype(np.float32), index.reshape(3, -1).astype(np.float32)).reshape(count).T
    spacing = size * ct.spacing_mm / count
    around = np.ceil(max(_BODY_MM) / spacing).astype(int)
    body = np.pad(sampled, around[::-1, None], mode="edge")
    inner = tuple(slice(a + 1, a + n - 1) for a, n in zip(around[::-1], count[::-1], strict=True))
    weight = np.ones_like(body)
    weight[inner] = 1e-6  # the sides alone count
    body, weight = (gaussian_filter(part, _SIDES_MM / spacing[::-1]) for part in (body * weight, weight))
    body /= weight
    body[tuple(slice(a, a + n) for a, n in zip(around[::-1], count[::-1], strict=True))] = _AIR_HU
    grown = Volume(body, spacing, ct.index_to_world((0.5 - around) * size / count - 0.5), ct.direction)
    places = grown.index_to_world(np.stack(np.meshgrid(*map(np.arange, body.shape[::-1]), indexing="ij"), axis=-1))
    across = (places - ct.index_to_world((size - 1) / 2))[..., :2] / _BODY_MM
    body[((across**2).sum(axis=-1) > 1).T] = _AIR_HU
    return grown


def _march(ct: Volume, view: View, pixels: int, rays: int, step_mm: float) -> Float32[np.ndarray, "rays rays"]:
    """Return the attenuation along rays through a volume, HU, that goes on beyond its sides as at its edge."""
    step = pixels / rays
    offset = ((np.arange(rays) + 0.5) * step - pixels / 2) / view.scale
    side, up = np.meshgrid(offset, -offset)
    direction = view.axes[2] + side[..., None] * view.axes[0] + up[..., None] * view.axes[1]
    corners = np.array(np.meshgrid(*([0, n - 1] for n in ct.voxels.shape[::-1]))).reshape(3, -1).T
    depths = (ct.index_to_world(corners) - view.source) @ view.axes[2]
    into = ((direction.reshape(-1, 3) @ ct.direction) / ct.spacing_mm).T.astype(np.float32, order="C")
    begin = (((view.source - ct.origin_mm) @ ct.direction) / ct.spacing_mm)[:, None].astype(np.float32)
    voxels, total = ct.voxels.astype(np.float32, copy=False), np.zeros(rays * rays, dtype=np.float32)
    for depth in np.arange(depths.min(), depths.max(), step_mm, dtype=np.float32):
        total += np.maximum(1 + _between(voxels, begin + depth * into) / 1000, 0)
    slope = np.linalg.norm(direction, axis=-1).astype(np.float32)
    return total.reshape(rays, rays) * np.float32(WATER_MM * step_mm) * slope


def _between(voxels: Float32[np.ndarray, "nz ny nx"], index: Float32[np.ndarray, "3 n"]) -> Float32[np.ndarray, "n"]:
    """Return values between voxels, linearly, and beyond their sides those at the edge; `index` is along x, y and z.
    SciPy's `map_coordinates` does the same in more than three times the time."""
    last = np.array(voxels.shape[::-1])[:, None] - 1
    index = np.clip(index, 0, last, dtype=np.float32)
    low = np.minimum(index.astype(np.intp), np.maximum(last - 1, 0))
    share = index - low.astype(np.float32)
    _, ny, nx = voxels.shape
    flat, step = voxels.ravel(), (1, nx, nx * ny)

    def along(axis: int, at: Int[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
        if axis < 0:
            return flat.take(at, mode="clip")
        here, next_ = along(axis - 1, at), along(axis - 1, at + step[axis])
        return here + share[axis] * (next_ - here)

    return along(2, low[0] + nx * (low[1] + ny * low[2]))


class Shadow:
    """Where small volumes fall on the detector, and line integrals of several quantities of them."""

    def __init__(self, view: View, pixels: int, points: Places, placed: Affine | None = None) -> None:
        """Project volumes at some points, LPS mm, after an affine map, if one is given, onto an image of so many pixels
        along a side."""
        onto = np.eye(3, 4) if placed is None else placed.copy()
        onto[:, 3] -= view.source
        self._pixels, self._count = pixels, len(points)
        x, y, z = np.ascontiguousarray(points.T)
        # Written out: as a product of matrices it is shared among threads, which cost more than they save.
        right, up, depth = (a * x + b * y + c * z + d for a, b, c, d in view.axes @ onto)
        self._per_mm = per_mm = view.scale / depth
        row, column = pixels / 2 - 0.5 - up * per_mm, pixels / 2 - 0.5 + right * per_mm
        inside = (row > 0) & (row < pixels - 1) & (column > 0) & (column < pixels - 1)
        self._inside = slice(None) if inside.all() else np.flatnonzero(inside)
        row, column = row[self._inside], column[self._inside]
        upper, left = row.astype(int), column.astype(int)
        self._down, self._right = row - upper, column - left
        self._low = low = [int(corner.min(initial=pixels)) for corner in (upper, left)]
        self._shape = [
            int(corner.max(initial=-1)) + 2 - least for corner, least in zip((upper, left), low, strict=True)
        ]
        self._first = (upper - low[0]) * self._shape[1] + (left - low[1])

    def of(
        self, volume: Float[np.ndarray, "n"] | float, *, width_mm: float = 0.0, blur_px: float = 0.0
    ) -> Float32[np.ndarray, "pixels pixels"]:
        """Return line integrals of volumes, mm³, or mm² where they are weighted by an attenuation: each is shared among
        four pixels, then blurred by its width in space and by the detector, standard deviations, mm and pixels."""
        image = np.zeros((self._pixels, self._pixels), dtype=np.float32)
        if not len(self._first):
            return image
        mass = (np.broadcast_to(volume, self._count) * self._per_mm**2)[self._inside]
        lower = mass * self._down
        mass -= lower
        sigma = float(np.hypot(width_mm * self._per_mm.mean(), blur_px))
        reach = int(4 * sigma) + 1
        rows, columns = self._shape
        begin = [max(low - reach, 0) for low in self._low]
        end = [min(low + n + reach, self._pixels) for low, n in zip(self._low, self._shape, strict=True)]
        box = np.zeros((end[0] - begin[0], end[1] - begin[1]))
        corner = box[self._low[0] - begin[0] :, self._low[1] - begin[1] :]
        for down, part in enumerate((mass, lower)):
            beside = part * self._right
            for right, share in enumerate((part - beside, beside)):
                laid = np.bincount(self._first, share, minlength=rows * columns).reshape(rows, columns)
                corner[down:rows, right:columns] += laid[: rows - down, : columns - right]
        image[begin[0] : end[0], begin[1] : end[1]] = blurred(box, sigma, mode="constant")
        return image


def blurred(
    image: Float[np.ndarray, "rows columns"] | Image, sigma_px: float, mode: Literal["constant", "reflect"] = "reflect"
) -> Float[np.ndarray, "rows columns"] | Image:
    """Return an image, blurred by a standard deviation in pixels, which may be too small to change it."""
    if sigma_px < _SHARP_PX:
        return image
    rows, columns = image.shape
    apart = np.empty((rows, columns + _APART), image.dtype)[:, :columns]
    apart[:] = image
    return np.asarray(gaussian_filter(apart, sigma_px, mode=mode, output=apart))
