"""The end of a wire in an image, to a part of a pixel: a bent line that ends, fitted to the pixels around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates, uniform_filter1d
from scipy.optimize import leastsq
from scipy.special import ndtr

from endopilot.xray.carm import Image, View
from endopilot.xray.tip_posterior import TipEstimate

_END_PLACES = 4
"""Places of the wire's end that give its first direction, and how far aside of the centerline it runs there."""
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
_DOUBT = 0.3
"""An end this many times its squared distance from the posterior's, in standard deviations, is less sure: it may be
another line's, which the fit does not know."""
BLUR_PX = 0.6
"""Standard deviation of the detector's blur, pixels."""
_RADIUS_PX, _NEAR_PX = 9, 5.4
"""Half a side of the square that the line is fitted in, and the standard deviation by which its pixels count the less
the farther they lie from the guess, pixels."""
_TURNS = np.deg2rad([0.0, -40.0, 40.0, -90.0, 90.0])
"""The line is fitted from each of these angles to the first guess, rad: tips are bent."""
_FITTED = 2
"""So many of these are fitted, those that the pixels fit best before."""
_SINGULAR, _CONVERGED = 1e-9, 1e-4
"""A fit ends where a step changes the line or lowers the errors by a smaller share."""
_MOST_BEND = 0.12
"""Largest curvature of the line, 1/pixel: 70° over 3 mm."""
_FARTHEST_PX = 6.0
"""The end is looked for within this distance of the first guess, pixels."""
_OWN_PX = 0.35
"""Standard deviation of what the model of a line leaves out, pixels."""
_CLEAR = 6.0
"""Least contrast of the line, in its own standard deviations, for it to count."""


def fit_end(
    signal: Image, guess: Float[np.ndarray, "2"], forwards: Float[np.ndarray, "2"], width_px: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]] | None:
    """Return where a dark line ends, and its covariance, pixels²; None if no line ends there, or the image does.
    `guess` is where the end should be, to the right of the image's middle and up from it, pixels, as is what is
    returned; `forwards` leads along the line to its end; `width_px` is the standard deviation of its profile."""
    middle = (len(signal) - 1) / 2
    column, row = np.rint([middle + guess[0], middle - guess[1]]).astype(int)
    if min(row, column) < _RADIUS_PX or max(row, column) >= len(signal) - _RADIUS_PX:
        return None
    square = signal[row - _RADIUS_PX : row + _RADIUS_PX + 1, column - _RADIUS_PX : column + _RADIUS_PX + 1]
    side = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    right, up = (
        each.ravel() for each in np.meshgrid(side + column - middle - guess[0], middle - row - side - guess[1])
    )
    near = np.exp(-0.5 * (right**2 + up**2) / _NEAR_PX**2)
    flat = np.linalg.qr(near[:, None] * np.stack([np.ones_like(right), right, up], axis=-1))[0]
    dark = -near * square.ravel()
    dark = dark - flat @ (flat.T @ dark)

    def errors(x: Float[np.ndarray, "4"]) -> Float[np.ndarray, "n"]:
        """Return the errors of a bent line that ends, as dark as fits best, of its end, angle and bend."""
        cos, sin, bend = np.cos(x[2]), np.sin(x[2]), _MOST_BEND * np.tanh(x[3])
        behind = cos * (x[0] - right) + sin * (x[1] - up)
        aside = cos * (up - x[1]) - sin * (right - x[0]) - 0.5 * bend * np.maximum(behind, 0.0) ** 2
        line = near * np.exp(-0.5 * (aside / width_px) ** 2) * ndtr(behind / width_px)
        line -= flat @ (flat.T @ line)
        return dark - line * (line @ dark / (line @ line + _SINGULAR))

    turns = np.arctan2(forwards[1], forwards[0]) + _TURNS
    starts = [np.array([0.0, 0.0, turn, 0.0]) for turn in turns]
    starts.sort(key=lambda start: float((errors(start) ** 2).sum()))
    fits: Any = (
        leastsq(errors, start, full_output=True, xtol=_CONVERGED, ftol=_CONVERGED) for start in starts[:_FITTED]
    )
    end, covariance, how, *_ = min(fits, key=lambda fit: fit[2]["fvec"] @ fit[2]["fvec"])
    error = how["fvec"]
    line, variance = dark - error, float(error @ error) / max(float(near @ near) - 8, 1.0)
    faint = line @ dark <= 0 or np.linalg.norm(line) < _CLEAR * np.sqrt(variance)
    if faint or covariance is None or np.abs(end[:2]).max() > _FARTHEST_PX:
        return None
    return guess + end[:2], variance * covariance[:2, :2] + _OWN_PX**2 * np.eye(2)


def refined(
    found: TipEstimate, views: Sequence[View], signals: Sequence[Image], evidence: Sequence[Image], radius_mm: float
) -> TipEstimate:
    """Return a tip after each image's fit of the wire's end: a Kalman update of its place and the vessel's shift."""
    mean, spread = found.mean, found.spread
    wire = found.wire[-_END_PLACES:] - found.position

    def seen(
        view: View, row: Float[np.ndarray, "k 2"], error: Float[np.ndarray, "k"], own: Float[np.ndarray, "k k"]
    ) -> None:
        """Take an error in pixels, along some directions of the image, if it is believable."""
        nonlocal mean, spread
        slope = row @ view.slope(mean[:3] + mean[3:])
        both = np.hstack([slope, slope])
        expected = both @ spread @ both.T + own
        off = error @ np.linalg.solve(expected, error)
        if off > _BELIEVABLE**2:
            return
        own = (1 + _DOUBT * off) * own
        expected = both @ spread @ both.T + own
        gain = spread @ both.T @ np.linalg.inv(expected)
        rest = np.eye(6) - gain @ both
        mean, spread = mean + gain @ error, rest @ spread @ rest.T + gain @ own @ gain.T  # stays positive

    for view, signal, image in zip(views, signals, evidence, strict=True):
        at = mean[:3] + mean[3:]
        per_mm = float(np.linalg.norm(view.slope(at), 2))
        forwards = view.project(at) - view.project(at + wire[0])
        seen_px, there_mm = float(np.linalg.norm(forwards)), float(np.linalg.norm(wire[0]))
        if seen_px < _SEEN_SHARE * per_mm * there_mm:
            continue
        axes = np.array([forwards, [-forwards[1], forwards[0]]]) / seen_px
        slope = axes @ np.hstack([view.slope(at)] * 2)
        seen(view, axes, *_ends(image, view.project(at), axes, slope @ spread @ slope.T))
        guess, width_px = view.project(mean[:3] + mean[3:]), float(np.hypot(0.5 * radius_mm * per_mm, BLUR_PX))
        end = fit_end(signal, guess, forwards, width_px)
        if end is not None:
            seen(view, np.eye(2), end[0] - guess, end[1] + _FIT_PX**2 * np.eye(2))
    return replace(found, mean=mean, spread=spread)


def _ends(
    image: Image, guess: Float[np.ndarray, "2"], axes: Float[np.ndarray, "2 2"], expected: Float[np.ndarray, "2 2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Return how far along and aside a wire ends from a guess, by the evidence of an image, and its covariance. Unit
    vectors, along the wire and across it, are the axes, also of the end's covariance about the guess that is expected,
    pixels²."""
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
