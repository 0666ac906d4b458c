"""What lies on which pixels: masks of vessel and devices (`frame_masks`), and COCO's code of them (`encoded`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from endopilot.lines import length_along, places_on

CLASSES: Mapping[str, int] = {"vessel": 1, "contrast": 2, "guide": 4, "catheter": 8, "wire": 16}
"""Names of the masks, and their bits in a mask's file: vessel (its whole lumen), contrast (where half of the blood on
the ray or more is contrast), guide (the guiding catheter), catheter (one that is driven) and wire."""
LUMEN_MM = 0.35
"""A ray passes the vessel if its path through the lumen, blurred by half a voxel, is longer, mm: so the mask ends where
the lumen does, within half a pixel, for radii from 0.5 to 2 mm."""
CONTRAST_SHARE = 0.5
_THINNEST_PX = 0.75
"""Half-width of the thinnest line, pixels: thinner ones would have gaps."""


def stroke(
    line: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, "n"], pixels: int
) -> Bool[np.ndarray, "pixels pixels"]:
    """Return the pixels whose middle lies on a line (column, row) with a radius at each point, pixels."""
    mask = np.zeros((pixels, pixels), dtype=bool)
    if len(line) < 2:
        return mask
    along = length_along(line)
    at = np.append(np.arange(0.0, along[-1], 1.0), along[-1])
    places, half = places_on(line, along, at), np.maximum(np.interp(at, along, radius), _THINNEST_PX)
    reach = int(np.ceil(half.max()))
    near = ((places > -reach) & (places < pixels - 1 + reach)).all(axis=1)
    places, half = places[near], half[near]
    around = np.arange(-reach, reach + 1)
    column = np.rint(places[:, 0]).astype(int)[:, None] + around
    row = np.rint(places[:, 1]).astype(int)[:, None] + around
    across, down = (column - places[:, :1]) ** 2, (row - places[:, 1:]) ** 2
    inside = down[:, :, None] + across[:, None, :] <= half[:, None, None] ** 2
    inside &= ((row >= 0) & (row < pixels))[:, :, None] & ((column >= 0) & (column < pixels))[:, None, :]
    number, i, j = np.nonzero(inside)
    mask[row[number, i], column[number, j]] = True
    return mask


def laid_together(masks: Mapping[str, Bool[np.ndarray, "rows columns"]]) -> UInt8[np.ndarray, "rows columns"]:
    """Return masks by name as one image, with the bits of `CLASSES`."""
    together = np.zeros(next(iter(masks.values())).shape, dtype=np.uint8)
    for name, mask in masks.items():
        together |= np.uint8(CLASSES[name]) * mask.view(np.uint8)
    return together


def encoded(mask: Bool[np.ndarray, "rows columns"]) -> dict[str, Any]:
    """Return COCO's run lengths of a mask, column after column: the first is of what the mask leaves out."""
    used = np.flatnonzero(mask.any(axis=0))
    left, right = (used[0], used[-1] + 1) if len(used) else (0, 0)
    flat = np.zeros(1 + (right - left) * len(mask) + 1, dtype=bool)  # between two pixels that the mask leaves out
    flat[1:-1] = mask[:, left:right].T.ravel()
    edges = left * len(mask) + np.flatnonzero(flat[1:] != flat[:-1])
    runs = np.diff(edges, prepend=0, append=mask.size)
    return {"size": list(mask.shape), "counts": (runs if runs[-1] else runs[:-1]).tolist()}


def box_of(mask: Bool[np.ndarray, "rows columns"]) -> list[int]:
    """Return left, top, width and height of what a mask holds, pixels."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]
