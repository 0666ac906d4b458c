"""The tip of a wire found in X-ray images: `TipDetector`.

Ridges say how likely each pixel is on a wire; where it ends, and how far the vessel lies off, is one
posterior (`wire_likelihood`, `tip_posterior`), and the end is fitted to the pixels there (`wire_end`).
Contrast in the vessel is estimated and taken away first: a filled branch is a dark line too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_dilation, gaussian_filter, uniform_filter
from scipy.ndimage import label as connected_parts
from scipy.special import ndtr

from endopilot.devices.device import Wire
from endopilot.files import read_json
from endopilot.types import Anatomy
from endopilot.xray.absorbers import catheter_lumen_points, lumen_points
from endopilot.xray.carm import Image, Places, View
from endopilot.xray.projector import Shadow
from endopilot.xray.tip_posterior import TipEstimate, Told, VesselGrid
from endopilot.xray.wire_end import BLUR_PX, refined
from endopilot.xray.wire_likelihood import Seat, Shifts, end_log, or_folded, possible_shifts, tell, way_to

Line = Bool[np.ndarray, "rows columns"]
SCALES_PX = (1.0, 1.7, 2.8)
"""Standard deviations of the Gaussians whose second derivatives are taken; a coronary wire is some 1.7 pixels wide."""
_BESIDE_PX = 8.0
_MOST = 12.0
"""Features are cut off here, in standard deviations of the quantum noise."""
PARAMETERS = Path(__file__).parent / "ridge.json"


def ridge_evidence(signal: Image, photons: float, rough: Image | float = 0.0) -> Image:
    """Return the logarithm of how much likelier each pixel is on a wire than off it: a logistic regression on ridges,
    the `features`, whose arguments these are, and the products of any two."""
    found, (weight, offset) = features(signal, photons, rough), _trained()
    square = np.zeros((len(found), len(found)), dtype=np.float32)
    square[np.triu_indices(len(found))] = weight[len(found) :] / _MOST
    # The same as `products` times the weights, without an image for each product.
    terms = square @ found + weight[: len(found), None].astype(np.float32)
    return (np.einsum("fn,fn->n", terms, found) + np.float32(offset)).reshape(signal.shape)


@cache
def _trained() -> tuple[Float[np.ndarray, "terms"], float]:
    found = read_json(PARAMETERS)
    return np.array(found["weight"]), float(found["offset"])


def features(signal: Image, photons: float, rough: Image | float = 0.0) -> Float32[np.ndarray, "f n"]:
    """Return the features of the flat image's pixels: ridges and darkness over the noise, and that. A pixel of usual
    brightness counts so many photons; `rough` is the standard deviation of the coarsest ridges that are neither wire
    nor noise, powers of e."""
    smooth = [gaussian_filter(signal, scale, mode="nearest") for scale in SCALES_PX]
    around = _smoother(smooth[-1], SCALES_PX[-1], _BESIDE_PX).ravel()
    noise = np.hypot(np.exp(-0.5 * around) / np.float32(np.sqrt(photons)), np.ravel(rough).astype(np.float32))
    found = np.empty((2 * len(SCALES_PX) + 2, len(around)), dtype=np.float32)
    for number, (scale, image) in enumerate(zip(SCALES_PX, smooth, strict=True)):
        mean, half = _curvatures(image)
        # The Hessian of white noise, smoothed, falls with the third power of the scale.
        weight = np.float32(scale**3) / noise
        found[2 * number], found[2 * number + 1] = weight * (mean + half), weight * (mean - half)
    found[-2] = (around - smooth[0].ravel()) / noise * np.float32(SCALES_PX[0])
    found[-1] = np.log(noise)
    return np.clip(found, -_MOST, _MOST, out=found)


def _curvatures(image: Image) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Return the mean of the two principal curvatures of the flat image's pixels, and half their difference."""
    (rows, columns), padded = image.shape, np.pad(image, 2, mode="edge")

    def beside(down: int, right: int) -> Float32[np.ndarray, "n"]:
        return padded[2 + down : 2 + down + rows, 2 + right : 2 + right + columns].ravel()

    here = 2 * beside(0, 0)
    down, right = beside(2, 0) - here + beside(-2, 0), beside(0, 2) - here + beside(0, -2)
    mixed = beside(1, 1) - beside(1, -1) - beside(-1, 1) + beside(-1, -1)
    return 0.125 * (down + right), 0.125 * np.sqrt((down - right) ** 2 + 4 * mixed**2)


def _smoother(image: Image, done_px: float, scale_px: float) -> Image:
    """Return an image, smoothed already, smoothed to a larger standard deviation: every other pixel will do."""
    rows, columns = image.shape
    part = gaussian_filter(image[::2, ::2], 0.5 * float(np.sqrt(scale_px**2 - done_px**2)))
    part = np.pad(part, ((0, 1), (0, 1)), mode="edge")
    down = np.empty((2 * len(part) - 2, part.shape[1]), dtype=np.float32)
    down[::2], down[1::2] = part[:-1], 0.5 * (part[:-1] + part[1:])
    whole = np.empty((len(down), 2 * part.shape[1] - 2), dtype=np.float32)
    whole[:, ::2], whole[:, 1::2] = down[:, :-1], 0.5 * (down[:, :-1] + down[:, 1:])
    return whole[:rows, :columns]


def products(values: Float32[np.ndarray, "*n f"]) -> Float32[np.ndarray, "*n terms"]:
    """Return features and the products of any two."""
    rows, columns = np.triu_indices(values.shape[-1])
    return np.concatenate([values, values[..., rows] * values[..., columns] / np.float32(_MOST)], axis=-1)


_HIGH_PASS_PX, _AROUND_PX = 12.0, 24
"""Contrast is what is darker than its surroundings, blurred by this; and how much of an image around the vessel is
looked at, pixels."""
_AROUND_MM = 10.0
"""And around the whole vessel's centerline, where lines from before are looked for, mm: lumen and catheter."""
_TRUNCATE = 2.0
"""Blurs reach so many standard deviations."""
_FILLED_MM, _FEWEST_PX = 0.3, 10
"""Contrast is looked for where this much of the lumen lies behind a pixel, mm, if there are so many pixels."""
_LEAST_CONTRAST = 0.01
"""Contrast below this, 1/mm, is none."""
_SHAPE, _ALONG_MM = 0.35, 10.0
"""Ridges of contrast that the CT's lumen does not explain, in the coarsest feature, are this share of the contrast
around (0.32 to 0.40, root mean square in frames of two real left arteries), and as long as this, mm: an assumption."""
_LINE, _LINE_PX, _MOVED_PX = 0.86, 60, 2
"""An image from before shows a line where the evidence for a wire is larger than this over so many pixels together; it
may be displaced by so many pixels."""
_HIDDEN_MM = 1.5
"""Standard deviation that a tip on such a line has more, mm."""
CATHETER_MM = 8.0
"""Length of the catheter behind the ostium in which a wire is followed, mm."""
_PLACES_MM = 1.0
"""Distance of the places at which a wire may end, before its end is fitted, mm."""
_SLACK_MM = 0.3
"""How far outside the lumen the wire's axis may seem to lie, mm."""
_MODE_MM, _NEAR_PX = 4.0, 10.0
"""Mean and covariance are those of the posterior within this distance of its mode, mm; a tip is where it is found if it
lies within this, pixels of each image: 2 mm in the vessel."""
_MOST_OF_CATHETER = 20.0
"""The evidence of a wire in the catheter counts no more than this beside an encoder, and nothing without one."""
_DISPLACED_SHARE, DISPLACED_MM = 0.8, 2.0
"""Share of the exposures in which the vessel lies elsewhere than registration has it, and how far it lies from there
then, along each axis: standard deviation, mm."""
_HIDDEN_SHARE, _ALIKE_SHARE = 0.02, 0.05
"""Share of the wire that is not seen, whatever the evidence against it, and of the places off it that look like one."""
_LEAST_LOG_ODDS, _SURE = 3.0, 0.95
"""There is a wire where the images are likelier with one by this logarithm; its tip is ambiguous where less of the
posterior lies within 10 pixels of it."""


class Exposure(NamedTuple):
    """What one exposure shows: its views, images without contrast, evidence of a wire and lines from before; and for
    each shift of the vessel the evidence of a wire to each place, a logarithm."""

    views: Sequence[View]
    plain: Sequence[Image]
    evidence: Sequence[Image]
    lines: Sequence[Line]
    shifts: Shifts
    way: Float[np.ndarray, "places shifts"]


class TipDetector:
    """Finds the tip of one wire in one vessel."""

    def __init__(self, anatomy: Anatomy, device: Wire) -> None:
        """Take the vessel and the wire."""
        self._anatomy, self._radius_mm = anatomy, device.tip_radius_mm
        self.grid: VesselGrid = VesselGrid.of(anatomy.tree, step_mm=_PLACES_MM).with_catheter(anatomy, CATHETER_MM)
        self._room_mm = self.grid.radius - device.tip_radius_mm + _SLACK_MM
        self._seat = Seat(anatomy)
        behind, size = catheter_lumen_points(anatomy)
        near = np.linalg.norm(behind - anatomy.insertion.position, axis=1) <= 1.25 * CATHETER_MM
        points, volume = lumen_points(anatomy)
        self._vessel = anatomy.tree.line.points
        self._filled = np.concatenate([points, behind[near]]), np.concatenate([volume, size[near]])

    def estimate(
        self,
        views: Sequence[View],
        signals: Sequence[Image],
        photons: Sequence[float],
        inserted_length: float,
        lines: Sequence[Line] = (),
        displaced: Float[np.ndarray, "3 3"] | None = None,
    ) -> TipEstimate:
        """Return where the tip is in the images of one exposure if there is a wire, and how likely that is, given Δ by
        the robot's encoder, mm; the other arguments are those of `look`."""
        seen, ends = self.look(views, signals, photons, lines, displaced), end_log(self.grid.abscissa, inserted_length)
        told, log_odds = self.tell(seen, ends)
        return self.judge(seen, or_folded(self.grid, told, ends, inserted_length), ends, log_odds)

    def look(
        self,
        views: Sequence[View],
        signals: Sequence[Image],
        photons: Sequence[float],
        lines: Sequence[Line] = (),
        displaced: Float[np.ndarray, "3 3"] | None = None,
        contrast: Sequence[Image] | None = None,
    ) -> Exposure:
        """Return the evidence of a wire in the images of one exposure, whose views are in the CT's frame.

        A pixel of usual brightness counts so many photons in each. `lines` are those of images of the same views
        without a wire; `displaced` is the covariance of how far the vessel lies from where the views have it, if it
        does not lie there, mm², by `DISPLACED_MM` if not given. `contrast` is how much darker contrast makes each
        image, in whatever shape it fills, as other times show it, powers of e, infinite where nothing is seen; none but
        what fills the CT's lumen if not given.
        """
        dark = contrast or [np.zeros_like(one) for one in signals]
        plain, evidence = zip(*map(self._read, views, signals, photons, dark), strict=True)
        for image, line in zip(evidence, lines, strict=False):
            image[line] = 0.0
        covariance = DISPLACED_MM**2 * np.eye(3) if displaced is None else displaced
        ostium = np.asarray(self._anatomy.insertion.position)
        shifts = possible_shifts(views, ostium, covariance, _DISPLACED_SHARE)
        for view, image in zip(views, plain, strict=True):
            shifts = replace(shifts, log=shifts.log + self._seat(view, image, shifts.mm @ view.slope(ostium).T))
        way = way_to(self.grid, self._room_mm, views, evidence, shifts.mm)
        return Exposure(views, plain, evidence, lines, shifts, way)

    def judge(self, seen: Exposure, told: Told, ends: Float[np.ndarray, "places"], log_odds: float) -> TipEstimate:
        """Return where the tip is, given what `tell` says, and how likely it is at each place before, a logarithm. An
        ambiguous one is as uncertain as the places are far apart; on a line from before the wire may end elsewhere."""
        found = self.grid.estimate(told, ends, _MODE_MM)
        found = refined(found, seen.views, seen.plain, seen.evidence, self._radius_mm)
        found = replace(found, log_odds=log_odds)
        if log_odds < _LEAST_LOG_ODDS:
            return replace(found, status="not found")
        views = [replace(view, source=view.source - found.shift) for view in seen.views]
        slopes, side = [view.slope(found.position) for view in views], len(seen.plain[0]) - 1
        at = [np.clip(np.rint(view.pixel(found.position, side + 1)), 0, side).astype(int) for view in views]
        hidden = any(line[tuple(pixel)] for line, pixel in zip(seen.lines, at, strict=False))
        sd_px = max(float(np.linalg.norm(slope @ found.covariance @ slope.T, 2)) for slope in slopes) ** 0.5
        found = replace(found, share=found.share * (1 - 2 * float(ndtr(-_NEAR_PX / sd_px))))
        if found.share >= _SURE and not hidden:
            return found
        spread = found.spread.copy()
        spread[:3, :3] += _HIDDEN_MM**2 * np.eye(3) if hidden else 0.0
        return replace(found, status="ambiguous", spread=spread)

    def tell(self, seen: Exposure, ends: Float[np.ndarray, "places"]) -> tuple[Told, float]:
        """Return what an exposure says of the tip at each place, and of whether there is a wire, a logarithm."""
        told, log_odds = tell(self.grid, self._room_mm, seen.way, seen.shifts, ends)
        # What lies in the catheter alone is a poor sign of a wire: the catheter is a dark line too.
        catheter = self.grid.branch < 0
        most = _MOST_OF_CATHETER if np.isfinite(ends[catheter]).any() else 0.0
        return told, log_odds - max(float(seen.way[catheter][-1].max()) - most, 0.0)

    def lines(self, view: View, before: Image, photons: float) -> Line:
        """Return the pixels near lines of an image without a wire around the vessel, as an exposure of so many photons
        would show them; more show fainter ones."""
        box, near = _box_around(view, self._vessel, len(before), _AROUND_MM), np.zeros(before.shape, dtype=bool)
        line = self._saturated(ridge_evidence(before[box], photons)) > _LINE
        parts: Any = connected_parts(line, np.ones((3, 3)))
        label = parts[0]
        large = np.bincount(label.ravel()) >= _LINE_PX
        large[0] = False
        near[box] = binary_dilation(large[label], iterations=_MOVED_PX)
        return near

    def _read(self, view: View, signal: Image, photons: float, dark: Image) -> tuple[Image, Image]:
        """Return an image without contrast, and how likely its pixels are on a wire, none far from the vessel."""
        evidence = np.zeros_like(signal)
        box = _box_around(view, self.grid.middle, len(signal))
        plain = self.without_contrast(view, signal, box)
        rough = np.where(np.isfinite(dark[box]), _SHAPE * dark[box], 0).astype(np.float32)
        evidence[box] = own_share(dark[box], photons) * self._saturated(ridge_evidence(plain[box], photons, rough))
        return plain, evidence

    def _saturated(self, log_ratio: Image) -> Image:
        """Return evidence that no single pixel can overrule all others with."""
        likelier = np.exp(np.clip(log_ratio, -30, 30))
        return np.log((likelier + _HIDDEN_SHARE) / (1 + _ALIKE_SHARE * likelier)).astype(np.float32)

    def without_contrast(self, view: View, signal: Image, box: tuple[slice, slice] | None = None) -> Image:
        """Return an image without the contrast in the vessel, whose strength is estimated from a part of the image."""
        box = box or (slice(None), slice(None))
        width_mm = 0.5 * self._anatomy.distance_map.spacing_mm
        points, sizes = self._filled
        path_mm = Shadow(view, len(signal), points).of(sizes, width_mm=width_mm, blur_px=BLUR_PX)
        path, part = (uniform_filter(one[box], 2)[::2, ::2] for one in (path_mm, signal))
        filled = path > _FILLED_MM
        if 4 * filled.sum() < _FEWEST_PX:
            return signal
        edges, dark = (one - gaussian_filter(one, _HIGH_PASS_PX / 2, truncate=_TRUNCATE) for one in (path, -part))
        strength = float(dark[filled] @ edges[filled] / (edges[filled] @ edges[filled]))
        return signal + np.float32(strength) * path_mm if strength > _LEAST_CONTRAST else signal


def own_share(dark: Float[np.ndarray, "*n"], photons: float) -> Float[np.ndarray, "*n"]:
    """Return the share of what is seen that no neighbour has told, given by how much contrast darkens each pixel: noise
    differs from mm to mm; a ridge of contrast that the CT lacks goes on, and says the same again and again."""
    ridges = photons * (_SHAPE * np.where(np.isfinite(dark), dark, 0)) ** 2
    return np.isfinite(dark) * (1 + ridges) / (1 + _ALONG_MM * ridges)


def _box_around(view: View, points: Places, rows: int, around_mm: float = 0.0) -> tuple[slice, slice]:
    """Return the rows and columns of an image that show points, LPS mm, and what lies around them in space or image."""
    around = _AROUND_PX + around_mm * float(np.linalg.norm(view.slope(points.mean(axis=0)), 2)) + 1
    at = view.pixel(points, rows)
    low = np.clip(at.min(axis=0) - around, 0, rows - 1).astype(int)
    high = np.clip(at.max(axis=0) + around + 1, low + 1, rows).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])
