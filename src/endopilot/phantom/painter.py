"""Painting a phantom's tissues onto a grid of voxels, each by the share of it that they hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

COARSE_MM = 2.0  # spacing of the grid on which organs are computed, mm
SLAB = 8  # slices rendered at once: a slab stays in the processor's cache


@dataclass(frozen=True, eq=False)
class Grid:
    """The voxel centres along x, y and z, mm."""

    x: Float[np.ndarray, "nx"]
    y: Float[np.ndarray, "ny"]
    z: Float[np.ndarray, "nz"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along z, y and x."""
        return len(self.z), len(self.y), len(self.x)


def window(
    grid: Grid, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> tuple[tuple[slice, slice, slice], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the slices (k, j, i) of the voxels in a box, and their z, y and x, ready to broadcast."""
    spans = [slice(*np.searchsorted(axis, (low[i], high[i]))) for i, axis in enumerate((grid.x, grid.y, grid.z))]
    x, y, z = (axis[span].astype(np.float32) for axis, span in zip((grid.x, grid.y, grid.z), spans, strict=True))
    return (spans[2], spans[1], spans[0]), (z[:, None, None], y[:, None], x)


class Painter:
    """Paints tissues over each other, slab by slab, each voxel by the share that it holds of them."""

    def __init__(self, grid: Grid, coarse: Grid, *, in_plane_mm: float, slice_mm: float) -> None:
        self.sharpness = np.float32(3 / (2 * in_plane_mm + slice_mm))
        self.x, self.y, self.z = (
            _interpolation(fine, rough) for fine, rough in ((grid.x, coarse.x), (grid.y, coarse.y), (grid.z, coarse.z))
        )

    def share(self, depth: np.ndarray) -> np.ndarray:
        """Return how much of each voxel lies within a surface at signed distance `depth`, mm."""
        share = depth * self.sharpness
        share += np.float32(0.5)
        return np.clip(share, 0, 1, out=share)

    def paint(self, image: np.ndarray, depth: np.ndarray, hu: float) -> None:
        """Mix `hu` into the image where the depth is positive."""
        change = np.float32(hu) - image
        change *= self.share(depth)
        image += change

    def fine(self, depth: np.ndarray, rows: slice) -> tuple[np.ndarray, tuple[slice, slice]] | None:
        """Interpolate a coarse depth linearly; return it with the (y, x) box that holds its inside, or None."""
        (left, share), depth = self.z, depth
        used = depth[left[rows][0] : left[rows][-1] + 2]
        _, ys, xs = np.nonzero(used > -1.0)
        if not len(ys):
            return None
        box_y, box_x = _covered(self.y[0], ys), _covered(self.x[0], xs)
        used = _lerp(used, left[rows] - left[rows][0], share[rows], axis=0)
        used = _lerp(used, self.y[0][box_y], self.y[1][box_y], axis=1)
        return _lerp(used, self.x[0][box_x], self.x[1][box_x], axis=2), (box_y, box_x)


def _interpolation(
    fine: Float[np.ndarray, "n"], coarse: Float[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Return, for each fine position, the coarse index to its left and the share of the one to its right."""
    place = (fine - coarse[0]) / COARSE_MM
    left = place.astype(int)
    return left, (place - left).astype(np.float32)


def _lerp(values: np.ndarray, left: np.ndarray, share: np.ndarray, axis: int) -> np.ndarray:
    shaped = share.reshape([-1 if i == axis else 1 for i in range(3)])
    low = np.take(values, left, axis=axis)
    high = np.take(values, left + 1, axis=axis)
    high -= low
    high *= shaped
    high += low
    return high


def smooth_min(a: np.ndarray, b: np.ndarray, width_mm: float = 2.5) -> np.ndarray:
    """Return the smaller of two depths with the edge between them rounded (polynomial smooth minimum)."""
    share = np.clip((b - a) * np.float32(0.5 / width_mm) + np.float32(0.5), 0, 1)
    return b + (a - b) * share - np.float32(width_mm) * share * (1 - share)


def _covered(left: Int[np.ndarray, "n"], coarse: Int[np.ndarray, "m"]) -> slice:
    """Return the fine indices between the outermost of the coarse ones."""
    return slice(*np.searchsorted(left, (coarse.min() - 1, coarse.max() + 1)))
