"""The end of a wire in an image, to a part of a pixel: a bent line that ends, fitted to the pixels around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import ndtr

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
