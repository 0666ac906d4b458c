"""The end of a wire in an image, to a part of a pixel: a bent line that ends, fitted to the pixels around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import least_squares
from scipy.special import ndtr

_RADIUS_PX = 9
"""Half a side of the square that the line is fitted in, pixels."""
_TURNS = np.deg2rad([0.0, -40.0, 40.0, -90.0, 90.0])
"""The line is fitted from each of these angles to the first guess, rad: tips are bent."""
_FITTED = 2
"""So many of these are fitted, those that the pixels fit best before."""
_SINGULAR = 1e-9
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
    dark, angle = -square.ravel().astype(float), float(np.arctan2(forwards[1], forwards[0]))
    flat = np.stack([np.ones_like(right), right - right.mean(), up - up.mean()], axis=-1)
    near = np.exp(-0.5 * ((right - guess[0]) ** 2 + (up - guess[1]) ** 2) / (0.6 * _RADIUS_PX) ** 2)

    def design(x: np.ndarray) -> np.ndarray:
        return near[:, None] * np.column_stack([_line(x, right, up, width_px), flat])

    def residuals(x: np.ndarray) -> np.ndarray:
        terms = design(x)
        square = terms.T @ terms + _SINGULAR * np.eye(terms.shape[1])
        return terms @ np.linalg.solve(square, terms.T @ (near * dark)) - near * dark

    low = np.array([guess[0] - _FARTHEST_PX, guess[1] - _FARTHEST_PX, -np.inf, -_MOST_BEND])
    high = np.array([guess[0] + _FARTHEST_PX, guess[1] + _FARTHEST_PX, np.inf, _MOST_BEND])
    starts = [np.array([guess[0], guess[1], angle + turn, 0.0]) for turn in _TURNS]
    starts.sort(key=lambda start: float((residuals(start) ** 2).sum()))
    best = None
    for start in starts[:_FITTED]:
        found = least_squares(residuals, start, bounds=(low, high), x_scale=(1.0, 1.0, 0.3, 0.05), max_nfev=12)
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    variance = 2 * best.cost / max(float((near**2).sum()) - 8, 1.0)
    terms = design(best.x)
    amplitude = float(np.linalg.lstsq(terms, near * dark, rcond=None)[0][0])
    sure = np.sqrt(variance * np.linalg.pinv(terms.T @ terms)[0, 0])
    if amplitude < _CLEAR * sure or np.abs(best.x[:2] - guess).max() > 0.98 * _FARTHEST_PX:
        return None
    spread = variance * np.linalg.pinv(best.jac.T @ best.jac)[:2, :2]
    return WireEnd(best.x[:2], spread + _OWN_PX**2 * np.eye(2))


def _line(x: np.ndarray, right: np.ndarray, up: np.ndarray, width_px: float) -> np.ndarray:
    """Return how dark a bent line with an end makes each pixel: x is the end's place, direction and curvature."""
    cos, sin = np.cos(x[2]), np.sin(x[2])
    behind = -(cos * (right - x[0]) + sin * (up - x[1]))
    aside = -sin * (right - x[0]) + cos * (up - x[1]) - 0.5 * x[3] * np.maximum(behind, 0.0) ** 2
    return np.exp(-0.5 * (aside / width_px) ** 2) * ndtr(behind / width_px)
