"""The wire in an image, followed through the vessel from the catheter to its tip.

A hidden Markov model: a state is a place in a cross-section of the vessel, an observation is how much more likely the
pixel there is on a wire than off it. The forward recursion sums over all courses that the wire may take. How likely it
ends at a place, against no wire at all, is the tip's posterior: mean, uncertainty and the probability that there is a
wire follow from it. With two views the evidence of both is added, so the depth is found; with one the vessel gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import map_coordinates

from endopilot.xray.carm import View
from endopilot.xray.corridor import STEP_MM, Corridor, Passage

_TURNS = np.array([0.5, 0.2, 0.05])
"""How likely a wire moves aside by 0, 1 or 2 cells of 0.2 mm, either way, from a cross-section to the next, 0.25 mm
on."""
_NEAR_SHARE, _NEAR_MM = 0.1, 2.0
"""The tip's abscissa differs from the inserted length by 2 mm and a tenth of it: vessels are cut short, wires snake."""
_MOST_OF_CATHETER = 20.0
"""The evidence of a wire in the catheter counts no more than this."""
_ASIDE = 0.2
"""Root mean square of the sine of the angle between a wire and the centerline."""
_MODE_MM = 4.0
"""Mean and covariance are those of the posterior within this distance of its mode, mm."""


@dataclass(frozen=True, eq=False)
class TipEstimate:
    """Where the tip is, and how sure that is.

    Attributes:
        log_odds: logarithm of how much likelier the images are with a wire than without.
        position: of the tip, LPS mm of the CT.
        covariance: of the position, mm².
        share: of the posterior that lies near this position; the rest is elsewhere.
        wire: places of the wire from the catheter to the tip, LPS mm.
        middle: the vessel's centerline at these, LPS mm.
        room: how far from it the wire's axis may lie there, mm.
    """

    log_odds: float
    position: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    share: float
    wire: Float[np.ndarray, "n 3"]
    middle: Float[np.ndarray, "n 3"]
    room: Float[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class _Followed:
    """A passage after the forward recursion.

    Attributes:
        passage: itself.
        alpha: share of every place, given what was seen up to its section.
        log_scale: logarithm of the evidence up to each section.
        places: LPS mm.
    """

    passage: Passage
    alpha: Float32[np.ndarray, "n g g"]
    log_scale: Float[np.ndarray, "n"]
    places: Float[np.ndarray, "n g g 3"]


def track(
    corridor: Corridor,
    views: Sequence[View],
    evidence: Sequence[Float32[np.ndarray, "rows columns"]],
    inserted_length: float,
) -> TipEstimate:
    """Find the tip of a wire.

    Args:
        corridor: of the vessel.
        views: in the CT's frame, as registration has them.
        evidence: for each view the logarithm of how much likelier each pixel is on a wire than off it.
        inserted_length: Δ by the robot's encoder, mm.
    """
    followed: list[_Followed] = []
    for passage in corridor.passages:
        before = None if passage.parent < 0 else followed[passage.parent]
        followed.append(_follow(corridor, passage, before, views, evidence))
    sd = _NEAR_MM + _NEAR_SHARE * max(inserted_length, 0.0)
    prior = [-0.5 * ((one.passage.abscissa - inserted_length) / sd) ** 2 for one in followed]
    prior_total = np.logaddexp.reduce(np.concatenate(prior))
    score = [one.log_scale + before for one, before in zip(followed, prior, strict=True)]
    total = float(np.logaddexp.reduce(np.concatenate(score)))
    weights = [np.exp(values - total)[:, None, None] * one.alpha for values, one in zip(score, followed, strict=True)]
    # What lies in the catheter alone is a poor sign of a wire: the catheter is a dark line too.
    catheter = max(float(followed[0].log_scale[-1]) - _MOST_OF_CATHETER, 0.0)
    return _summary(followed, weights, total - float(prior_total) - catheter)


def _summary(followed: list[_Followed], weights: list[np.ndarray], log_odds: float) -> TipEstimate:
    """Return mean and covariance around the mode of the posterior."""
    best = int(np.argmax([weight.sum(axis=(1, 2)).max() for weight in weights]))
    section = int(weights[best].sum(axis=(1, 2)).argmax())
    here = weights[best][section]
    mode = (here[..., None] * followed[best].places[section]).sum(axis=(0, 1)) / here.sum()
    places = np.concatenate([one.places.reshape(-1, 3) for one in followed])
    weight = np.concatenate([weight.ravel() for weight in weights])
    near = ((places - mode) ** 2).sum(axis=1) <= _MODE_MM**2
    share = float(weight[near].sum())
    mean = weight[near] @ places[near] / share
    off = places[near] - mean
    # A cell has a size: that of a section's step and of its grid.
    covariance = (weight[near, None] * off).T @ off / share + np.eye(3) * STEP_MM**2 / 12
    wire, middle, room = _course(followed, best, section)
    return TipEstimate(log_odds, mean, covariance, share, wire, middle, room)


def _course(followed: list[_Followed], best: int, section: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return wire, centerline and room from the catheter to a section."""
    wire, middle, room = [], [], []
    index, last = best, section + 1
    while index >= 0:
        one = followed[index]
        wire.append((one.alpha[:last, ..., None] * one.places[:last]).sum(axis=(1, 2)))
        middle.append(one.passage.middle[:last])
        room.append(one.passage.room[:last])
        index = one.passage.parent
        last = len(followed[index].passage.abscissa)
    return np.concatenate(wire[::-1]), np.concatenate(middle[::-1]), np.concatenate(room[::-1])


def _follow(
    corridor: Corridor,
    passage: Passage,
    before: _Followed | None,
    views: Sequence[View],
    evidence: Sequence[np.ndarray],
) -> _Followed:
    """Run the forward recursion through one passage."""
    places, allowed = corridor.places(passage), corridor.open(passage)
    gain = np.zeros(allowed.shape, dtype=np.float32)
    for view, image in zip(views, evidence, strict=True):
        right_up = view.project(places[allowed])
        middle = (len(image) - 1) / 2
        at = np.stack([middle - right_up[:, 1], middle + right_up[:, 0]])
        shown = map_coordinates(image, at, order=1, mode="constant", output=np.float32)
        weight = np.broadcast_to(_new_pixels(passage, view)[:, None, None], allowed.shape)
        gain[allowed] += weight[allowed] * shown
    peak = np.where(allowed, gain, -np.inf).max(axis=(1, 2))
    factor = np.where(allowed, np.exp(gain - peak[:, None, None]), 0.0).astype(np.float32)
    state, log_scale = _entry(corridor, passage, before, allowed[0])
    cells = np.arange(len(corridor.offsets))
    turn = np.interp(np.abs(cells[:, None] - cells), np.arange(len(_TURNS)), _TURNS, right=0.0).astype(np.float32)
    alpha, scales = np.empty_like(factor), np.empty(len(peak))
    for index in range(len(peak)):
        state = turn @ state @ turn
        inside = float(state[allowed[index]].sum())  # a wire does not leave the vessel
        state *= factor[index]
        total = float(state.sum())
        if total <= 0:  # no place can be reached: begin anew, at a great loss
            state, total = factor[index].copy(), float(factor[index].sum())
            inside = float(allowed[index].sum())
            log_scale -= 50.0
        state /= total
        log_scale += np.log(total / inside) + peak[index]
        alpha[index], scales[index] = state, log_scale
    return _Followed(passage, alpha, scales, places)


def _new_pixels(passage: Passage, view: View) -> Float32[np.ndarray, "n"]:
    """Return how long each section's step is in the image, as a share of one across the beam.

    A wire along the beam is one dark spot. Its pixels must not count anew in every section that they lie in.
    """
    tangent = np.cross(passage.first, passage.second)
    ahead = view.project(passage.middle + 0.5 * STEP_MM * tangent)
    depth = (passage.middle - view.source) @ view.axes[2]
    step = np.linalg.norm(ahead - view.project(passage.middle - 0.5 * STEP_MM * tangent), axis=1)
    return np.hypot(np.minimum(step * depth / (view.scale * STEP_MM), 1.0), _ASIDE).astype(np.float32)


def _entry(
    corridor: Corridor, passage: Passage, before: _Followed | None, allowed: np.ndarray
) -> tuple[Float32[np.ndarray, "g g"], float]:
    """Return the shares with which a passage begins, and the evidence so far.

    They are those at the end of the passage before, turned into this one's axes.
    """
    if before is None:
        return (allowed / allowed.sum()).astype(np.float32), 0.0
    end = before.passage
    places = corridor.places(passage)[0] - end.middle[-1]
    grid = np.stack([places @ end.first[-1], places @ end.second[-1]])
    index = (grid - corridor.offsets[0]) / (corridor.offsets[1] - corridor.offsets[0])
    state = np.clip(map_coordinates(before.alpha[-1], index, order=1, mode="constant"), 0, None)
    total = float(state.sum())
    if total <= 0:
        return (allowed / allowed.sum()).astype(np.float32), float(before.log_scale[-1]) - 50.0
    return (state / total).astype(np.float32), float(before.log_scale[-1])
