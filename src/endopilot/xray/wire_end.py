"""The end of a wire in an image, to a part of a pixel: a bent line that ends, fitted to the pixels around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import map_coordinates, uniform_filter1d
from scipy.special import ndtr

from endopilot.xray.carm import View
from endopilot.xray.tip_posterior import TipEstimate

Image = Float32[np.ndarray, "rows columns"]
_END_PLACES = 4
"""Places of the wire's end that give its first direction, and how far aside of the centerline it runs there."""
_BESIDE_STRAND_PX = 3.0
"""So far on either side the end of a wire that folds is looked for, pixels: the other strand lies in the middle."""
_LEAD_PX, _OF_PIXEL, _STRAIGHT_PX = 12, 0.3, 1.0
"""Length of the wire before its end that shows how far aside it runs, pixels; weight of the evidence of each, since
neighbours share their noise; standard deviation of what a straight line leaves out, pixels."""
_SEEN_SHARE = 0.35
"""An end that is foreshortened to less than this share of its length shows no direction, and is not fitted."""
_FIT_PX = 0.6
"""Standard deviation by which fits of ends err besides, pixels: their median errors were 0.3 to 0.6 in one view of
three arteries, and with 0.35 alone the region of 95 % held 62 % of the tips in one of them."""
_BELIEVABLE = 3.0
"""An end farther than this many standard deviations from the posterior's is another line's."""
BLUR_PX = 0.6
"""Standard deviation of the detector's blur, pixels."""
_RADIUS_PX = 9
"""Half a side of the square that the line is fitted in, pixels."""
_TURNS = np.deg2rad([0.0, -40.0, 40.0, -90.0, 90.0])
"""The line is fitted from each of these angles to the first guess, rad: tips are bent."""
_FITTED = 2
"""So many of these are fitted, those that the pixels fit best before."""
_SINGULAR = 1e-9
_STEPS, _CONVERGED = 12, 1e-5
"""Steps of a fit at most; it ends where one lowers the errors by a smaller share."""
_MOST_BEND = 0.12
"""Largest curvature of the line, 1/pixel: 70° over 3 mm."""
_FARTHEST_PX = 6.0
"""The end is looked for within this distance of the first guess, pixels."""
_OWN_PX = 0.35
"""Standard deviation of what the model of a line leaves out, pixels."""
_CLEAR = 6.0
"""Least contrast of the line, in its own standard deviations, for it to count."""


@dataclass(frozen=True, eq=False)
class WireEnd:
    """An end that was found.

    Attributes:
        place: to the right of the image's middle and up from it, pixels.
        covariance: of the place, pixels².
    """

    place: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]


def fit_end(
    signal: Float32[np.ndarray, "rows columns"],
    guess: Float[np.ndarray, "2"],
    forwards: Float[np.ndarray, "2"],
    width_px: float,
) -> WireEnd | None:
    """Fit the end of a dark line.

    Args:
        signal: the image.
        guess: where the end should be: to the right of the image's middle and up from it, pixels.
        forwards: direction along the line to its end; any length.
        width_px: standard deviation of the line's profile, pixels.

    Returns:
        The end; None if no line ends there, or the image does.
    """
    middle = (len(signal) - 1) / 2
    column, row = np.rint([middle + guess[0], middle - guess[1]]).astype(int)
    if min(row, column) < _RADIUS_PX or max(row, column) >= len(signal) - _RADIUS_PX:
        return None
    square = signal[row - _RADIUS_PX : row + _RADIUS_PX + 1, column - _RADIUS_PX : column + _RADIUS_PX + 1]
    side = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    right, up = (part.ravel().astype(float) for part in np.meshgrid(side + column - middle, middle - row - side))
    near = np.exp(-0.5 * ((right - guess[0]) ** 2 + (up - guess[1]) ** 2) / (0.6 * _RADIUS_PX) ** 2)
    line = _Line(right, up, near, -square.ravel().astype(float), width_px)
    angle = float(np.arctan2(forwards[1], forwards[0]))
    starts = [np.array([guess[0], guess[1], angle + turn, 0.0]) for turn in _TURNS]
    starts.sort(key=lambda start: line.errors(start)[0])
    low, high = guess - _FARTHEST_PX, guess + _FARTHEST_PX
    best = min((line.fit(start, low, high) for start in starts[:_FITTED]), key=lambda x: line.errors(x)[0])
    cost, amplitude, norm, slope, _ = line.errors(best)
    variance = cost / max(float((near**2).sum()) - 8, 1.0)
    if amplitude * norm < _CLEAR * np.sqrt(variance) or np.abs(best[:2] - guess).max() > 0.98 * _FARTHEST_PX:
        return None
    spread = variance * np.linalg.pinv(slope.T @ slope)[:2, :2]
    return WireEnd(best[:2], spread + _OWN_PX**2 * np.eye(2))


def refined(
    found: TipEstimate,
    views: Sequence[View],
    signals: Sequence[Image],
    evidence: Sequence[Image],
    radius_mm: float,
) -> TipEstimate:
    """Return a tip after each image's fit of the wire's end: a Kalman update of its place and the vessel's shift.

    Args:
        found: the tip.
        views: of the images, in the CT's frame as the vessel is registered.
        signals: the images, without contrast.
        evidence: how much likelier each pixel is on a wire than off it, a logarithm.
        radius_mm: of the wire.
    """
    mean, spread = found.mean, found.spread
    wire = found.wire[-_END_PLACES:] - found.position

    def seen(
        view: View, row: Float[np.ndarray, "k 2"], error: Float[np.ndarray, "k"], own: Float[np.ndarray, "k k"]
    ) -> bool:
        """Take an error in pixels, along some directions of the image, if it is believable."""
        nonlocal mean, spread
        slope = row @ view.slope(mean[:3] + mean[3:])
        both = np.hstack([slope, slope])
        expected = both @ spread @ both.T + own
        if error @ np.linalg.solve(expected, error) > _BELIEVABLE**2:
            return False
        gain = spread @ both.T @ np.linalg.inv(expected)
        rest = np.eye(6) - gain @ both
        mean, spread = mean + gain @ error, rest @ spread @ rest.T + gain @ own @ gain.T  # stays positive
        return True

    for view, signal, image in zip(views, signals, evidence, strict=True):
        at = mean[:3] + mean[3:]
        per_mm = float(np.linalg.norm(view.slope(at), 2))
        forwards = view.project(at) - view.project(at + wire[0])
        seen_px, there_mm = float(np.linalg.norm(forwards)), float(np.linalg.norm(wire[0]))
        if seen_px < _SEEN_SHARE * per_mm * there_mm:
            continue
        axes = np.array([forwards, [-forwards[1], forwards[0]]]) / seen_px
        if not found.folded:  # the other strand goes on
            slope = axes @ np.hstack([view.slope(at)] * 2)
            seen(view, axes, *_ends(image, view.project(at), axes, slope @ spread @ slope.T))
        guess, width_px = view.project(mean[:3] + mean[3:]), float(np.hypot(0.5 * radius_mm * per_mm, BLUR_PX))
        for aside in (0.0, -_BESIDE_STRAND_PX, _BESIDE_STRAND_PX)[: 3 if found.folded else 1]:
            end = fit_end(signal, guess + aside * axes[1], forwards, width_px)
            if end is not None and seen(view, np.eye(2), end.place - guess, end.covariance + _FIT_PX**2 * np.eye(2)):
                break
    return replace(found, mean=mean, spread=spread)


def _ends(
    image: Image, guess: Float[np.ndarray, "2"], axes: Float[np.ndarray, "2 2"], expected: Float[np.ndarray, "2 2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Return how far along and aside a wire ends from a guess, by the evidence of an image, and its covariance.

    Args:
        image: the evidence.
        guess: to the right of the image's middle and up from it, pixels.
        axes: unit vectors along the wire and across it.
        expected: covariance of the end about the guess, along and across, pixels².
    """
    reach, sides = np.ceil(2.5 * np.sqrt(np.diag(expected)))
    along, across = np.arange(-reach - _LEAD_PX, reach + 1), np.arange(-sides, sides + 1)
    right, up = guess[:, None, None] + axes[0][:, None, None] * along[:, None] + axes[1][:, None, None] * across
    middle = (len(image) - 1) / 2
    score = map_coordinates(image, [middle - up, middle + right], order=1)
    prior = -0.5 * across**2 / expected[1, 1]
    prior -= np.logaddexp.reduce(prior)
    log = _OF_PIXEL * np.cumsum(np.logaddexp.reduce(score + prior, axis=1)) - 0.5 * along**2 / expected[0, 0]
    weight = np.exp(log - log[_LEAD_PX:].max())
    weight[:_LEAD_PX] = 0.0
    lately = np.exp(uniform_filter1d(score, _LEAD_PX // 2, axis=0, origin=_LEAD_PX // 4 - 1) + prior)
    weight = (weight / weight.sum())[:, None] * lately / lately.sum(axis=1, keepdims=True)
    off = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)
    mean = np.einsum("ij,ijk->k", weight, off)
    posterior = np.einsum("ij,ijk,ijl->kl", weight, off - mean, off - mean) + _STRAIGHT_PX**2 * np.eye(2)
    # What the image alone says: the posterior without the prior.
    precision = np.linalg.inv(posterior)
    left = precision - np.diag(0.9 / np.maximum(np.diag(expected), np.diag(posterior)))
    if np.linalg.eigvalsh(left)[0] <= 0:  # a slanted posterior says less than the prior on some axis
        left = precision
    own = np.linalg.inv(left)
    return own @ precision @ mean, own


class _Line:
    """A bent line that ends, on a flat background: its errors in a square of pixels, and the parameters of the least.

    Parameters are the end's place, pixels, its direction, rad, and its curvature, 1/pixel.
    """

    def __init__(self, right: np.ndarray, up: np.ndarray, near: np.ndarray, dark: np.ndarray, width_px: float) -> None:
        self._right, self._up, self._near, self._width = right, up, near, width_px
        flat = np.stack([np.ones_like(right), right - right.mean(), up - up.mean()], axis=-1)
        self._flat = np.linalg.qr(near[:, None] * flat)[0]
        self._dark = self._above(near * dark)

    def _above(self, values: np.ndarray) -> np.ndarray:
        """Return what no flat background explains."""
        return values - self._flat @ (self._flat.T @ values)

    def errors(self, x: np.ndarray) -> tuple[float, float, float, np.ndarray, np.ndarray]:
        """Return the sum of squared errors, the line's darkness, its norm, the errors' slope, and the errors.

        The darkness is the best one for these parameters; the slope is that by them, the darkness following.
        """
        cos, sin, w = np.cos(x[2]), np.sin(x[2]), self._width
        right, up = self._right - x[0], self._up - x[1]
        behind, left = -(cos * right + sin * up), cos * up - sin * right
        bow = np.maximum(behind, 0.0)
        aside = left - 0.5 * x[3] * bow**2
        profile, end = np.exp(-0.5 * (aside / w) ** 2), ndtr(behind / w)
        by_aside = -aside / w**2 * profile * end
        by_behind = profile * np.exp(-0.5 * (behind / w) ** 2) / (w * np.sqrt(2 * np.pi)) - by_aside * x[3] * bow
        slopes = [
            by_behind * cos + by_aside * sin,
            by_behind * sin - by_aside * cos,
            -by_behind * left + by_aside * behind,
            -0.5 * by_aside * bow**2,
        ]
        shape = self._above(self._near[:, None] * np.stack([profile * end, *slopes], axis=-1))
        line, slope = shape[:, 0], shape[:, 1:]
        square = float(line @ line) + _SINGULAR
        amplitude = float(line @ self._dark) / square
        error = amplitude * line - self._dark
        darker = (self._dark @ slope - 2 * amplitude * (line @ slope)) / square
        slope = amplitude * slope + np.outer(line, darker)
        return float(error @ error), amplitude, float(np.sqrt(square)), slope, error

    def fit(self, start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the parameters of the least errors near a start, by Levenberg and Marquardt's steps.

        Args:
            start: first parameters.
            low, high: bounds of the end's place.
        """
        bounds = np.array([*low, -np.inf, -_MOST_BEND]), np.array([*high, np.inf, _MOST_BEND])
        x, damping = start, 0.1
        cost, *_, slope, error = self.errors(x)
        for _ in range(_STEPS):
            square = slope.T @ slope
            square[np.diag_indices(4)] += damping * np.diag(square) + _SINGULAR
            tried = np.clip(x - np.linalg.solve(square, slope.T @ error), *bounds)
            new, *_, new_slope, new_error = self.errors(tried)
            if new < cost:
                done = cost - new < _CONVERGED * cost
                x, cost, slope, error, damping = tried, new, new_slope, new_error, 0.2 * damping
                if done:
                    break
            else:
                damping *= 8.0
        return x
