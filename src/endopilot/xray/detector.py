"""The tip of a wire found in X-ray images: `TipDetector`.

Ridges say how likely each pixel is on a wire (`ridge`); where it ends, and how far the vessel lies off, is one
posterior (`tip_posterior`), and the end is fitted to the pixels there (`wire_end`).
Contrast in the vessel is estimated and taken away first: a filled branch is a dark line too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.ndimage import label as connected_parts
from scipy.special import ndtr

from endopilot.devices.device import Wire
from endopilot.files import read_json
from endopilot.settings import Finite, OpenShare, Positive, settings
from endopilot.types import Anatomy
from endopilot.xray.absorbers import catheter_lumen_points, lumen_points
from endopilot.xray.carm import View
from endopilot.xray.projector import splat
from endopilot.xray.tip_posterior import Seat, TipEstimate, estimate_tip, possible_shifts
from endopilot.xray.vessel_grid import VesselGrid, make_grid, with_catheter
from endopilot.xray.wire_end import BLUR_PX, refined

Signal = Float32[np.ndarray, "rows columns"]
SCALES_PX = (1.0, 1.7, 2.8)
"""Standard deviations of the Gaussians whose second derivatives are taken; a coronary wire is some 1.7 pixels wide."""
_BESIDE_PX = 8.0
_MOST = 12.0
"""Features are cut off here, in standard deviations of the quantum noise."""
PARAMETERS = Path(__file__).parent / "ridge.json"


@dataclass(frozen=True, eq=False)
class RidgeEvidence:
    """A logistic regression on ridges.

    Attributes:
        weight: of the features and of the products of any two.
        offset: constant term.
    """

    weight: Float[np.ndarray, "terms"]
    offset: float

    @classmethod
    def read(cls, path: Path = PARAMETERS) -> RidgeEvidence:
        """Read the parameters; those of the package if no file is given."""
        found = read_json(path)
        return cls(np.array(found["weight"]), float(found["offset"]))

    def __call__(self, signal: Signal, photons: float, rough: Signal | float = 0.0) -> Signal:
        """Return the logarithm of how much likelier each pixel is on a wire than off it, of what `features` takes."""
        found = features(signal, photons, rough)
        count = len(found)
        square = np.zeros((count, count), dtype=np.float32)
        square[np.triu_indices(count)] = self.weight[count:] / _MOST
        # The same as `products` times the weights, without an image for each product.
        terms = square @ found + self.weight[:count, None].astype(np.float32)
        return (np.einsum("fn,fn->n", terms, found) + np.float32(self.offset)).reshape(signal.shape)


def features(signal: Signal, photons: float, rough: Signal | float = 0.0) -> Float32[np.ndarray, "f n"]:
    """Return the features of the flat image's pixels: ridges and darkness over the noise, and that.

    A pixel of usual brightness counts so many photons; `rough` is the standard deviation of the coarsest ridges that
    are neither wire nor noise, powers of e.
    """
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


def _curvatures(image: Signal) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Return the mean of the two principal curvatures of the flat image's pixels, and half their difference."""
    (rows, columns), padded = image.shape, np.pad(image, 2, mode="edge")

    def beside(down: int, right: int) -> Float32[np.ndarray, "n"]:
        return padded[2 + down : 2 + down + rows, 2 + right : 2 + right + columns].ravel()

    here = 2 * beside(0, 0)
    down, right = beside(2, 0) - here + beside(-2, 0), beside(0, 2) - here + beside(0, -2)
    mixed = beside(1, 1) - beside(1, -1) - beside(-1, 1) + beside(-1, -1)
    return 0.125 * (down + right), 0.125 * np.sqrt((down - right) ** 2 + 4 * mixed**2)


def _smoother(image: Signal, done_px: float, scale_px: float) -> Signal:
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
_KEPT_LINES = 8
"""Lines of so many images from before, or doses, are kept for the next exposures."""
_HIDDEN_MM = 1.5
"""Standard deviation that a tip on such a line has more, mm."""
CATHETER_MM = 8.0
"""Length of the catheter behind the ostium in which a wire is followed, mm."""
_PLACES_MM = 1.0
"""Distance of the places at which a wire may end, before its end is fitted, mm."""
_SLACK_MM = 0.3
"""How far outside the lumen the wire's axis may seem to lie, mm."""
_NEAR_PX = 10.0
"""A tip is where it is found if it lies within this, pixels of each image: 2 mm in the vessel."""


@settings
class DetectorConfig:
    """How far an image is trusted."""

    displaced: OpenShare = 0.8
    """Share of the exposures in which the vessel lies elsewhere than registration has it."""
    displaced_mm: Positive = 2.0
    """How far it lies from there then, along each axis: standard deviation, mm."""
    hidden: OpenShare = 0.02
    """Share of the wire that is not seen, whatever the evidence against it."""
    alike: OpenShare = 0.05
    """Share of the places off the wire that look like one, whatever the evidence."""
    least_log_odds: Finite = 3.0
    """There is a wire where the images are likelier with one by this logarithm."""
    sure: OpenShare = 0.92
    """A tip is ambiguous where less of the posterior lies within 10 pixels of it."""


class TipDetector:
    """Finds the tip of one wire in one vessel."""

    def __init__(
        self,
        anatomy: Anatomy,
        device: Wire,
        config: DetectorConfig | None = None,
        evidence: RidgeEvidence | None = None,
    ) -> None:
        """Take the vessel and the wire; `evidence` is for a wire in a pixel, the package's if not given."""
        self._anatomy, self._radius_mm = anatomy, device.tip_radius_mm
        self.config, self._evidence = config or DetectorConfig(), evidence or RidgeEvidence.read()
        self.grid: VesselGrid = with_catheter(make_grid(anatomy.tree, step_mm=_PLACES_MM), anatomy, CATHETER_MM)
        self._room_mm = self.grid.radius - device.tip_radius_mm + _SLACK_MM
        self._seat = Seat(anatomy)
        behind, size = catheter_lumen_points(anatomy)
        near = np.linalg.norm(behind - anatomy.insertion.position, axis=1) <= 1.25 * CATHETER_MM
        points, volume = lumen_points(anatomy)
        self._known_lines: list[tuple[Signal, float, Bool[np.ndarray, "rows columns"]]] = []
        self._vessel = anatomy.tree.line.points
        self._filled = np.concatenate([points, behind[near]]), np.concatenate([volume, size[near]])

    def find(self, *image: Any, **how: Any) -> TipEstimate | None:
        """Return the tip, found or ambiguous; None where there is no wire. The arguments are those of `estimate`."""
        found = self.estimate(*image, **how)
        return None if found.status == "not found" else found

    def estimate(
        self,
        views: Sequence[View],
        signals: Sequence[Signal],
        photons: Sequence[float],
        inserted_length: float | None,
        before: Sequence[Signal] | None = None,
        expected: Float[np.ndarray, "places"] | None = None,
        displaced: Float[np.ndarray, "3 3"] | None = None,
        contrast: Sequence[Signal] | None = None,
    ) -> TipEstimate:
        """Return where the tip is in the images of one exposure if there is a wire, and how likely that is.

        Args:
            views: of the images, in the CT's frame (`Registration.views`).
            signals: from `XrayImager.signal`.
            photons: that a pixel of usual brightness counts, in each image.
            inserted_length: Δ by the robot's encoder, mm; None where there is none.
            before: images of the same views without a wire: lines in them that this exposure's noise, that of
                `photons`, would show are none of its; none if not given.
            expected: as `estimate_tip` takes it.
            displaced: covariance of how far the vessel lies from where the views have it, if it does not lie there,
                mm²; the configuration's if not given.
            contrast: how much darker contrast makes each image, in whatever shape it fills, as other times show it,
                powers of e, infinite where nothing is seen; none but what fills the CT's lumen if not given.
        """
        config, before = self.config, before or []
        dark = contrast or [np.zeros_like(one) for one in signals]
        seen = [self._look(*one) for one in zip(views, signals, photons, dark, strict=True)]
        plain, evidence = [one for one, _ in seen], [one for _, one in seen]
        lines = [self._lines(*one) for one in zip(views, before, photons, strict=False)]
        for image, line in zip(evidence, lines, strict=False):
            image[line] = 0.0
        covariance = config.displaced_mm**2 * np.eye(3) if displaced is None else displaced
        ostium = np.asarray(self._anatomy.insertion.position)
        shifts = possible_shifts(views, ostium, covariance, config.displaced)
        for view, image in zip(views, plain, strict=True):
            shifts = replace(shifts, log=shifts.log + self._seat(view, image, shifts.mm @ view.slope(ostium).T))
        found = estimate_tip(self.grid, self._room_mm, views, evidence, shifts, inserted_length, expected)
        found = refined(found, views, plain, evidence, self._radius_mm)
        there = [replace(view, source=view.source - found.shift) for view in views]
        at = [np.clip(np.rint(view.pixel(found.position, len(signals[0]))), 0, len(signals[0]) - 1) for view in there]
        hidden = any(line[tuple(pixel.astype(int))] for line, pixel in zip(lines, at, strict=False))
        return self._judged(found, there, hidden=hidden)

    def _look(self, view: View, signal: Signal, photons: float, dark: Signal) -> tuple[Signal, Signal]:
        """Return an image without contrast, and how likely its pixels are on a wire, none far from the vessel."""
        evidence = np.zeros_like(signal)
        box = _box_around(view, self.grid.middle, len(signal))
        plain = self.without_contrast(view, signal, box)
        rough = np.where(np.isfinite(dark[box]), _SHAPE * dark[box], 0).astype(np.float32)
        evidence[box] = own_share(dark[box], photons) * self._saturated(self._evidence(plain[box], photons, rough))
        return plain, evidence

    def _lines(self, view: View, before: Signal, photons: float) -> Bool[np.ndarray, "rows columns"]:
        """Return the pixels near lines of an image without a wire around the vessel, as an exposure would show them.

        The image is looked at once for each number of photons: with more, an exposure shows fainter lines.
        """
        for image, count, near in self._known_lines:
            if image is before and count == photons:
                return near
        box, near = _box_around(view, self._vessel, len(before), _AROUND_MM), np.zeros(before.shape, dtype=bool)
        line = self._saturated(self._evidence(before[box], photons)) > _LINE
        parts: Any = connected_parts(line, np.ones((3, 3)))
        label = parts[0]
        large = np.bincount(label.ravel()) >= _LINE_PX
        large[0] = False
        near[box] = binary_dilation(large[label], iterations=_MOVED_PX)
        self._known_lines = [*self._known_lines[1 - _KEPT_LINES :], (before, photons, near)]
        return near

    def _judged(self, found: TipEstimate, views: Sequence[View], *, hidden: bool) -> TipEstimate:
        """Return an estimate with its status, seen in views of the CT's frame where the vessel lies.

        An ambiguous one is as uncertain as the places are far apart; on a line from before (`hidden`) the wire may end
        elsewhere.
        """
        if found.log_odds < self.config.least_log_odds:
            return replace(found, status="not found")
        slopes = [view.slope(found.position) for view in views]
        sd_px = max(float(np.linalg.norm(slope @ found.covariance @ slope.T, 2)) for slope in slopes) ** 0.5
        share = found.share * (1 - 2 * float(ndtr(-_NEAR_PX / sd_px)))
        if share >= self.config.sure and not hidden:
            return replace(found, share=share)
        spread = found.spread.copy()
        spread[:3, :3] += _HIDDEN_MM**2 * np.eye(3) if hidden else 0.0
        return replace(found, share=share, status="ambiguous", spread=spread)

    def _saturated(self, log_ratio: Signal) -> Signal:
        """Return evidence that no single pixel can overrule all others with."""
        likelier = np.exp(np.clip(log_ratio, -30, 30))
        config = self.config
        return np.log((likelier + config.hidden) / (1 + config.alike * likelier)).astype(np.float32)

    def without_contrast(self, view: View, signal: Signal, box: tuple[slice, slice] | None = None) -> Signal:
        """Return an image without the contrast in the vessel, whose strength is estimated from a part of the image."""
        box = box or (slice(None), slice(None))
        width_mm = 0.5 * self._anatomy.distance_map.spacing_mm
        path_mm = splat(view, len(signal), *self._filled, width_mm=width_mm, blur_px=BLUR_PX)
        path, part = _halved(path_mm[box]), _halved(signal[box])
        filled = path > _FILLED_MM
        if 4 * filled.sum() < _FEWEST_PX:
            return signal
        edges, dark = (one - gaussian_filter(one, _HIGH_PASS_PX / 2, truncate=_TRUNCATE) for one in (path, -part))
        strength = float(dark[filled] @ edges[filled] / (edges[filled] @ edges[filled]))
        return signal + np.float32(strength) * path_mm if strength > _LEAST_CONTRAST else signal


def own_share(dark: Float[np.ndarray, "*n"], photons: float) -> Float[np.ndarray, "*n"]:
    """Return the share of what is seen that no neighbour has told, given by how much contrast darkens each pixel.

    Noise differs from mm to mm; a ridge of contrast that the CT lacks goes on, and says the same again and again.
    """
    ridges = photons * (_SHAPE * np.where(np.isfinite(dark), dark, 0)) ** 2
    return np.isfinite(dark) * (1 + ridges) / (1 + _ALONG_MM * ridges)


def _halved(image: Signal) -> Float32[np.ndarray, "half_rows half_columns"]:
    """Return means of two by two pixels."""
    rows, columns = len(image) // 2, image.shape[1] // 2
    return image[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))


def _box_around(view: View, points: Float[np.ndarray, "n 3"], rows: int, around_mm: float = 0.0) -> tuple[slice, slice]:
    """Return the rows and columns of an image that show points, LPS mm, and what lies around them in space or image."""
    around = _AROUND_PX + around_mm * float(np.linalg.norm(view.slope(points.mean(axis=0)), 2)) + 1
    at = view.pixel(points, rows)
    low = np.clip(at.min(axis=0) - around, 0, rows - 1).astype(int)
    high = np.clip(at.max(axis=0) + around + 1, low + 1, rows).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])
