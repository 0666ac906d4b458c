"""A corridor as a view shows it: where in the image each of its places lies, for evidence that is read there."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from endopilot.xray.carm import View
from endopilot.xray.corridor import STEP_MM, Corridor, Passage

Evidence = Float32[np.ndarray, "rows columns"]
_COVER_PX = 3
"""Pixels this near to the wire's way are darkened by it."""
_ASIDE = 0.2
"""Root mean square of the sine of the angle between a wire and the centerline."""
_EDGE_PX = _COVER_PX + 2
"""Pixels without evidence around the part of an image that shows the corridor."""


class CorridorView:
    """Where the open places of all passages lie in one image.

    Attributes:
        view: source and detector, in the CT's frame.
        box: rows and columns that show the corridor.
        new: for each passage how long each section's step is in the image, as a share of one across the beam.
    """

    def __init__(self, corridor: Corridor, view: View, rows: int) -> None:
        """Project the corridor into an image of so many rows and columns."""
        self.view, self._middle = view, (rows - 1) / 2
        widest_mm = max(float(passage.offsets[-1]) for passage in corridor.passages)
        self.box = box_around(view, np.concatenate([one.middle for one in corridor.passages]), rows, widest_mm)
        self._shape = tuple(side.stop - side.start + 2 * _EDGE_PX for side in self.box)
        self._first = np.array([side.start - _EDGE_PX for side in self.box])
        self._corner, self._rest = [], []
        for passage in corridor.passages:
            at = _shown(passage, view, self._middle - self._first)
            np.clip(at, 0, np.array(self._shape)[:, None] - 2, out=at)
            corner = at.astype(np.int32)
            at -= corner
            self._corner.append(corner[0] * np.int32(self._shape[1]) + corner[1])
            self._rest.append(at)
        self.new = [_new_pixels(one, view) for one in corridor.passages]
        disc = np.argwhere(
            np.hypot(*np.mgrid[-_COVER_PX : _COVER_PX + 1, -_COVER_PX : _COVER_PX + 1]) < _COVER_PX + 0.5
        )
        self._disc = (disc - _COVER_PX) @ [self._shape[1], 1]

    def cut(self, image: Evidence) -> Float32[np.ndarray, "part_rows part_columns"]:
        """Return the part of an image that shows the corridor, with an edge of zeros: `read` and `darken` take it."""
        return np.pad(image[self.box], _EDGE_PX)

    def read(self, part: Evidence, passage: int, places: slice) -> Float32[np.ndarray, "k"]:
        """Return an image between its pixels at some of a passage's open places, in their order."""
        flat, width, corner = part.ravel(), self._shape[1], self._corner[passage][places]
        down, right = self._rest[passage][:, places]
        upper, lower = flat[corner], flat[corner + width]
        upper += right * (flat[corner + 1] - upper)
        lower += right * (flat[corner + (width + 1)] - lower)
        return upper + down * (lower - upper)

    def darken(self, part: Evidence, way: Float[np.ndarray, "k 3"]) -> None:
        """Take away the evidence of the pixels that a way, LPS mm, has darkened."""
        right_up = self.view.project(way)
        at = np.stack([self._middle - right_up[:, 1], self._middle + right_up[:, 0]], axis=-1) - self._first
        at = np.clip(np.rint(at).astype(int), _COVER_PX, np.array(self._shape) - 1 - _COVER_PX)
        part.ravel()[(at @ [self._shape[1], 1])[:, None] + self._disc] = 0.0


def box_around(
    view: View, points: Float[np.ndarray, "n 3"], rows: int, around_mm: float = 0.0, around_px: int = 0
) -> tuple[slice, slice]:
    """Return the rows and columns of an image that show points, LPS mm, and what lies around them in space or image."""
    right_up, middle = view.project(points), (rows - 1) / 2
    around = around_px + around_mm * float(np.linalg.norm(view.slope(points.mean(axis=0)), 2)) + 1
    at = np.stack([middle - right_up[:, 1], middle + right_up[:, 0]])
    low = np.clip(at.min(axis=1) - around, 0, rows - 1).astype(int)
    high = np.clip(at.max(axis=1) + around + 1, low + 1, rows).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])


def _shown(passage: Passage, view: View, middle: Float[np.ndarray, "2"]) -> Float32[np.ndarray, "2 k"]:
    """Return rows and columns of a passage's open places, given those of the image's middle."""
    offsets, kept = passage.offsets.astype(np.float32), passage.cells

    def in_view(axis: Float[np.ndarray, "3"], scale: float) -> Float32[np.ndarray, "k"]:
        parts = (passage.middle - view.source) @ axis, passage.first @ axis, passage.second @ axis
        centre, first, second = (np.float32(scale) * part.astype(np.float32)[:, None] for part in parts)
        return ((centre + first * offsets)[:, :, None] + (second * offsets)[:, None, :]).ravel()[kept]

    at = np.stack([in_view(view.axes[1], -view.scale), in_view(view.axes[0], view.scale)])
    at /= in_view(view.axes[2], 1.0)
    at += middle.astype(np.float32)[:, None]
    return at


def _new_pixels(passage: Passage, view: View) -> Float32[np.ndarray, "n"]:
    """Return how long each section's step is in the image, as a share of one across the beam.

    A wire along the beam is one dark spot. Its pixels must not count anew in every section that they lie in.
    """
    tangent = np.cross(passage.first, passage.second)
    ahead = view.project(passage.middle + 0.5 * STEP_MM * tangent)
    depth = (passage.middle - view.source) @ view.axes[2]
    step = np.linalg.norm(ahead - view.project(passage.middle - 0.5 * STEP_MM * tangent), axis=1)
    return np.hypot(np.minimum(step * depth / (view.scale * STEP_MM), 1.0), _ASIDE).astype(np.float32)
