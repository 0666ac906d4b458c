"""What lies on which pixels of a cine, as masks and in COCO's code; what shapes the beam, and what the C-arm makes of
it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

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


_SHUTTER = 0.1
"""How far the collimator's edges reach into the image at most, share of its side: 0 to 54 of 512 pixels in 24 public
cines, and little in half of them; the square root is drawn evenly."""
_PENUMBRA_MM = 0.9
"""Blur of the collimator's edges at the detector, standard deviation, mm: a focal spot of 0.8 mm through blades a fifth
of the way from the source has 0.8 mm · 4 / √12."""
CLOSED = -0.6
"""What a monitor shows beyond the collimator's edges, logarithm of the light: a grey of 35 to 60 in public cines."""
_WEDGE_SHARE, _WEDGE, _WEDGE_RAMP = 0.5, (0.3, 0.8), (0.1, 0.25)
"""Share of the cines with a wedge filter, its attenuation, and its ramp as a share of the image's side: assumptions."""
_LEADS = 3
"""Cables of the electrocardiogram in the image are fewer than this: an assumption."""
_CABLE = ((0.35, 0.08), (9.0, 0.05), (2.5, 0.35))
"""Of a cable, its electrode and the stud in it: radius on the detector, mm, and attenuation; assumptions."""
_SHOULDER = 0.25
"""What lies beyond is pressed into this much of the grey scale's 0.9 to either side, logarithm of the light."""
_BRIGHT = 80
"""Percentile of the background in the middle of the grey scale: vessels are darker than it."""
_HARMONISED_MM = 15.0
"""Details of the image wider than this on the detector, standard deviation, mm, are pressed: an assumption."""


@dataclass(frozen=True, eq=False)
class Beam:
    """Collimator, wedge filter and cables.

    Attributes:
        edges: of the collimator: left, right, upper and lower; pixels.
        field: share of the beam that the collimator lets through.
        attenuation: of wedge filter and cables.
    """

    edges: tuple[int, int, int, int]
    field: Float32[np.ndarray, "rows columns"]
    attenuation: Float32[np.ndarray, "rows columns"]

    @classmethod
    def draw(cls, random: np.random.Generator, patient: Float32[np.ndarray, "rows columns"], pixel_mm: float) -> Beam:
        """Draw what is in the beam of a patient, whose attenuation is given: the wedge covers the brightest side."""
        pixels = len(patient)
        at, blur = np.arange(pixels), _PENUMBRA_MM / pixel_mm
        left, right, upper, lower = (round(float(share) * pixels) for share in _SHUTTER * random.random(4) ** 2)
        columns, rows = (
            ndtr((at - low + 0.5) / blur) * ndtr((pixels - high - 0.5 - at) / blur)
            for low, high in ((left, right), (upper, lower))
        )
        attenuation = np.zeros_like(patient)
        if random.random() < _WEDGE_SHARE:
            attenuation += _wedge(random, patient)
        for _ in range(int(random.integers(_LEADS))):
            attenuation += _cable(random, pixels, pixel_mm)
        field = np.outer(rows, columns).astype(np.float32)
        return cls((left, pixels - right, upper, pixels - lower), field, attenuation)


def _wedge(random: np.random.Generator, patient: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "r c"]:
    """Return the attenuation of a filter whose edge lies across the image towards its brightest side."""
    middle = np.linspace(-0.5, 0.5, len(patient))
    turn = np.arange(0, 2 * np.pi, np.pi / 8)
    sides = np.cos(turn)[:, None, None] * middle + np.sin(turn)[:, None, None] * middle[:, None]
    brightest = sides[int(np.argmin([patient[side > 0.25].mean() for side in sides]))]
    begin, ramp = random.uniform(0.05, 0.25), random.uniform(*_WEDGE_RAMP)
    return (random.uniform(*_WEDGE) * np.clip((brightest - begin) / ramp, 0, 1)).astype(np.float32)


def _cable(random: np.random.Generator, pixels: int, pixel_mm: float) -> Float32[np.ndarray, "rows columns"]:
    """Return the attenuation of a cable that runs from above to an electrode, which may lie outside the image."""
    share, places = np.linspace(0, 1, 64)[:, None], random.uniform((-0.1, -0.1), (1.1, 1.6), (3, 2)) * pixels
    places[0, 1] = -1
    line = (1 - share) ** 2 * places[0] + 2 * share * (1 - share) * places[1] + share**2 * places[2]
    drawn = np.zeros((pixels, pixels), dtype=np.float32)
    for part, (radius, attenuation) in zip((line, line[-2:], line[-2:]), _CABLE, strict=True):
        drawn += np.float32(attenuation) * stroke(part, np.full(len(part), radius / pixel_mm), pixels)
    return gaussian_filter(drawn, _PENUMBRA_MM / 2 / pixel_mm)


def shown(light: Float32[np.ndarray, "rows columns"], beam: Beam) -> Float32[np.ndarray, "rows columns"]:
    """Return what a monitor shows of the logarithm of the light: pressed beyond `CLOSED` on either side of the middle,
    so that nothing is black or white, and even beyond the collimator's edges."""
    within = np.clip(light, CLOSED, -CLOSED)
    within += np.float32(_SHOULDER) * np.tanh((light - within) / np.float32(_SHOULDER))
    return np.float32(CLOSED) + beam.field * (within - np.float32(CLOSED))


def harmonised(
    light: Float32[np.ndarray, "rows columns"], beam: Beam, pixel_mm: float, span: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return what the C-arm takes off the logarithm of the light: of its slow part what spans more than `span`, and
    then the level that lies in the middle of the monitor's grey scale.

    Bright lungs and a dark liver then fit a monitor, and fine details keep their contrast.
    """
    slow, inside = gaussian_filter(light, _HARMONISED_MM / pixel_mm, mode="nearest"), beam.field > 0.5
    low, high = np.percentile(slow[inside], (5, 95))
    pressed = np.float32(1 - span / max(high - low, span)) * slow
    return pressed + np.float32(np.percentile((light - pressed)[inside], _BRIGHT))
