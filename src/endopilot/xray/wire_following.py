"""A wire followed along a vessel in images, place after place, forwards and, from where it may fold, back again.

In an image a wire runs beside the projected centerline. A forward recursion of a hidden Markov model follows it in each
view by itself: a state is how far aside it lies, an observation is how much more likely the pixel there is on a wire
than off it. Two views see two coordinates of a cross-section, so their evidence adds up. A pixel counts once: what the
wire's own way has darkened says nothing of its later places, which may lie before or behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import map_coordinates

from endopilot.xray.carm import View
from endopilot.xray.vessel_grid import VesselGrid

Evidence = Float32[np.ndarray, "rows columns"]
STEP_MM = 0.25
"""Distance of the places at which a wire is followed, mm: some 1.2 pixels."""
_TURNS = np.array([0.05, 0.2, 0.5, 0.2, 0.05], dtype=np.float32)
"""How likely a wire moves aside by up to 2 pixels, either way, from a place to the next."""
_REACH = len(_TURNS) // 2
_AROUND_MM = 1.0
"""Tangents in an image are those over so far on either side, mm."""
_ASIDE = 0.2
"""Root mean square of the sine of the angle between a wire and the centerline."""
_CHUNK, _GAP = 24, 12
"""Places that are followed at a time, and how many of the last ones do not darken what comes next: they are where it
comes from."""
_COVER_PX = 3
"""Pixels this near to the wire's way are darkened by it."""
_LOST = 40.0
"""A way that is this much less likely in each view, in logarithms, than where it was likeliest is given up."""
_BREAK = 50.0
"""Loss of a way that leaves the places that it can reach."""
_FOLD_MM = 45.0
"""Length of a wire behind its fold that is followed, mm."""


class Shown:
    """A vessel's grid as one view shows it, and an image's evidence beside it.

    Attributes:
        slope: derivative of the places' pixels, pixels/mm.
        across: unit vectors across the projected centerline, to the right and up in the image.
        room_px: how far aside a wire may lie, pixels.
        new: length of each step in the image, as a share of one across the beam: a wire along the beam is one dark
            spot, whose pixels must not count anew at every place that lies in it.
    """

    def __init__(self, grid: VesselGrid, room_mm: Float[np.ndarray, "n"], view: View, image: Evidence) -> None:
        """Project the grid; `room_mm` is how far from the centerline the wire's axis may lie."""
        self._pixel, self.slope = view.project(grid.middle), view.slopes(grid.middle)
        reach = round(_AROUND_MM / grid.step_mm)
        ahead = np.zeros_like(self._pixel)
        for run in grid.runs():
            line = self._pixel[np.append(max(int(grid.parent[run[0]]), 0), run)]
            index = np.arange(1, len(line))
            ahead[run] = line[np.minimum(index + reach, len(line) - 1)] - line[np.maximum(index - reach, 0)]
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        self.across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        for place in range(1, len(self.across)):  # where the vessel turns back in the image, sides stay
            if self.across[place] @ self.across[grid.parent[place]] < 0:
                self.across[place] *= -1
        per_mm = np.sqrt((self.slope**2).sum(axis=(1, 2)) / 2)
        self.room_px = np.maximum(room_mm * per_mm, 1.0)
        step = np.linalg.norm(self._pixel - self._pixel[np.maximum(grid.parent, 0)], axis=1)
        self.new = np.hypot(np.minimum(step / (per_mm * grid.step_mm), 1.0), _ASIDE).astype(np.float32)
        self._middle = (len(image) - 1) / 2

    def pixels(self, places: Int[np.ndarray, "k"], aside: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m 2"]:
        """Return row and column of what lies so many pixels aside of places; one for each, or a row of them."""
        shape = (len(places), *[1] * (aside.ndim - 1), 2) if aside.ndim > 1 else (len(places), 2)
        right_up = self._pixel[places].reshape(shape) + aside[..., None] * self.across[places].reshape(shape)
        return self._middle + right_up[..., ::-1] * [-1.0, 1.0]

    def from_before(self, place: int, before: int, aside: Float[np.ndarray, "j"]) -> Float[np.ndarray, "j"]:
        """Return how far aside of one place lies what lies so far aside of another, pixels."""
        away = self._pixel[place] - self._pixel[before] + aside[:, None] * self.across[place]
        return away @ self.across[before]


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of the wire's way.

    Attributes:
        places: of the grid, in the order in which the wire passes them.
        alpha: in each view, share of every distance aside, given what was seen up to that place.
        log_scale: logarithm of the evidence up to each place.
        length: of the wire up to each place, mm.
        before: the leg before, and the last of its places that the way takes; None for the first.
        likeliest: largest `log_scale` of the way so far.
        lost: whether the way was given up at the leg's end.
        free: evidence of each view that the way has not used.
    """

    places: Int[np.ndarray, "n"]
    alpha: Float32[np.ndarray, "n views j"]
    log_scale: Float[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]
    before: tuple[Leg, int] | None
    likeliest: float
    lost: bool
    free: Sequence[Evidence]


class Follower:
    """Follows wires through a vessel in the images of one exposure."""

    def __init__(
        self,
        grid: VesselGrid,
        room_mm: Float[np.ndarray, "n"],
        views: Sequence[View],
        evidence: Sequence[Evidence],
        deepest_mm: float = np.inf,
    ) -> None:
        """Take the images.

        Args:
            grid: of the vessel, its catheter before it.
            room_mm: how far from the centerline the wire's axis may lie, mm.
            views: of the images.
            evidence: for each view the logarithm of how much likelier each pixel is on a wire than off it.
            deepest_mm: abscissa up to which wires are followed, mm.
        """
        self.grid, self._evidence, self._deepest = grid, evidence, deepest_mm
        self._room_mm = np.maximum(room_mm, grid.step_mm)
        self._tangent = grid.middle - grid.middle[np.maximum(grid.parent, 0)]
        self._tangent[0] = self._tangent[1]
        self._tangent /= np.maximum(np.linalg.norm(self._tangent, axis=1, keepdims=True), 1e-9)
        self.shown = [Shown(grid, room_mm, *one) for one in zip(views, evidence, strict=True)]
        half = int(np.ceil(max(float(one.room_px.max()) for one in self.shown)))
        self.aside = np.arange(-half, half + 1.0)
        self._open = np.stack([np.abs(self.aside) <= one.room_px[:, None] for one in self.shown], axis=1)
        apart = np.abs(self.aside[:, None] - self.aside).astype(int)
        self._turn = np.append(_TURNS[_REACH:], np.zeros(2 * half + 1, dtype=np.float32))[apart]

    def forwards(self) -> list[Leg]:
        """Return the legs of all ways from the catheter on, parents before their children."""
        ends: dict[int, Leg] = {}
        for run in self.grid.runs():
            parent, run = int(self.grid.parent[run[0]]), run[self.grid.abscissa[run] <= self._deepest]
            before = ends.get(parent)
            if len(run) and (parent < 0 or (before is not None and not before.lost)):
                ends[int(run[-1])] = self._walk(run, None if before is None else (before, len(before.places) - 1))
        return list(ends.values())

    def backwards(self, leg: Leg, at: int, longest_mm: float = np.inf) -> Leg:
        """Return the leg of a wire that folds at a place of a leg, back to the root at most.

        Args:
            leg: that it folds in.
            at: index of the place in the leg.
            longest_mm: a wire is not followed beyond this length.
        """
        free = [image.copy() for image in (self._evidence if leg.before is None else leg.before[0].free)]
        self._darken(free, *self.way(leg, at, at + 1 + _GAP))
        fold = leg.places[at]
        most = max(round(min(_FOLD_MM, longest_mm - float(leg.length[at])) / self.grid.step_mm), 1)
        back = self.grid.behind[fold, : self.grid.depth[fold] + 1][:most]
        return self._walk(back[(self.grid.branch[back] >= 0) | (back == fold)], (leg, at), free)

    def way(
        self, leg: Leg, at: int, most: int | None = None
    ) -> tuple[Int[np.ndarray, "k"], Float[np.ndarray, "k views"]]:
        """Return the likeliest way of a wire up to a place: its places, and how far aside it lies in each view, pixels.

        Each is the likeliest, given the one after; `most` is the number of the last places that are wanted.
        """
        index, places, found = leg.alpha[at].argmax(axis=1).tolist(), [], []
        while True:
            low = 0 if most is None else max(at + 1 + sum(map(len, places)) - most, 0)
            part = np.empty((at + 1 - low, len(index)), dtype=np.int64)
            for k, j in enumerate(index):
                part[-1, k] = j
                for back, share in enumerate(leg.alpha[low:at, k][::-1], start=2):
                    left, right = max(j - _REACH, 0), j + _REACH + 1
                    j = left + int((share[left:right] * self._turn[j, left:right]).argmax())
                    part[-back, k] = j
            places.append(leg.places[low : at + 1][::-1])
            found.append(part[::-1])
            if low > 0 or leg.before is None or sum(map(len, places)) == most:
                break
            last, (leg, at) = int(leg.places[0]), leg.before
            for k, one in enumerate(self.shown):
                expected = one.from_before(last, int(leg.places[at]), self.aside[part[0, k] : part[0, k] + 1])
                away = np.exp(-0.5 * (self.aside - expected) ** 2) + 1e-9
                index[k] = int((leg.alpha[at, k] * away).argmax())
        return np.concatenate(places)[::-1], self.aside[np.concatenate(found)[::-1]]

    def in_space(
        self,
        places: Int[np.ndarray, "k"],
        aside: Float[np.ndarray, "k views"],
        variance: Float[np.ndarray, "k views"],
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
        """Return where a wire lies that views show so far aside of places, pixels, LPS mm, and the covariances, mm².

        Before it is seen, the wire lies anywhere in the lumen of a cross-section.
        """
        tangent = self._tangent[places]
        prior = np.eye(3) - tangent[:, :, None] * tangent[:, None]
        prior *= (self._room_mm[places] ** 2 / 4)[:, None, None]
        rows = np.stack([np.einsum("ki,kij->kj", one.across[places], one.slope[places]) for one in self.shown], axis=1)
        gain = np.linalg.solve(
            rows @ prior @ rows.swapaxes(1, 2) + variance[:, :, None] * np.eye(len(self.shown)), rows @ prior
        ).swapaxes(1, 2)
        return self.grid.middle[places] + np.einsum("kiv,kv->ki", gain, aside), prior - gain @ rows @ prior

    def _walk(
        self, places: Int[np.ndarray, "n"], before: tuple[Leg, int] | None, free: list[Evidence] | None = None
    ) -> Leg:
        """Run the forward recursion through places.

        Args:
            places: neighbours, in the order in which they are passed.
            before: the leg before, and its last place.
            free: evidence that a wire which folds here has not used; that of the leg before if not given.
        """
        open_, count = self._open[places], len(places)
        state = open_[0] / open_[0].sum(axis=1, keepdims=True, dtype=np.float32)
        log_scale, length, likeliest = 0.0, float(self.grid.abscissa[places[0]]), 0.0
        if before is not None:
            leg, at = before
            last = int(leg.places[at])
            log_scale, likeliest = float(leg.log_scale[at]), leg.likeliest
            length = float(leg.length[at]) + abs(float(self.grid.abscissa[places[0]] - self.grid.abscissa[last]))
            if free is None:  # a fold crosses the lumen
                for k, one in enumerate(self.shown):
                    at_last = one.from_before(int(places[0]), last, self.aside)
                    turned = np.interp(at_last, self.aside, leg.alpha[at, k], left=0.0, right=0.0) * open_[0, k]
                    state[k] = turned if turned.sum() > 0 else state[k]
                free = [image.copy() for image in leg.free]
        free = free or [image.copy() for image in self._evidence]
        alpha, scales = np.empty(open_.shape, dtype=np.float32), np.empty(count)
        lengths, lost = length + self.grid.step_mm * np.arange(count), False
        leg = Leg(places, alpha, scales, lengths, before, likeliest, False, free)
        for low in range(0, count, _CHUNK):
            high = min(low + _CHUNK, count)
            factor, peak = self._gain(places[low:high], open_[low:high], free)
            gained = np.empty((high - low, len(state)))
            for number in range(high - low):
                reached = state @ self._turn
                inside = (reached * open_[low + number]).sum(axis=1)  # a wire does not leave the vessel
                state = reached * factor[number]
                total = state.sum(axis=1)
                loss = 1.0
                if total.min() <= 0:  # no place can be reached: begin anew, at a great loss
                    state = factor[number].copy()
                    total, inside, loss = state.sum(axis=1), open_[low + number].sum(axis=1), np.exp(-_BREAK)
                state /= total[:, None]
                gained[number] = total / inside * loss
                alpha[low + number] = state
            scales[low:high] = log_scale + np.cumsum((np.log(gained) + peak).sum(axis=1))
            log_scale, likeliest = float(scales[high - 1]), max(likeliest, float(scales[low:high].max()))
            done = self.way(leg, high - 1, _CHUNK + _GAP)
            self._darken(free, done[0][:-_GAP], done[1][:-_GAP])
            if lost := bool(log_scale < likeliest - _LOST * len(self.shown)):
                count = high
                break
        return Leg(places[:count], alpha[:count], scales[:count], lengths[:count], before, likeliest, lost, free)

    def _gain(
        self, places: Int[np.ndarray, "k"], open_: np.ndarray, free: Sequence[Evidence]
    ) -> tuple[Float32[np.ndarray, "k views j"], Float32[np.ndarray, "k views"]]:
        """Return how much likelier each view makes a wire aside of places, over the likeliest's, and that one's."""
        aside, gains = np.broadcast_to(self.aside, (len(places), len(self.aside))), []
        for one, image in zip(self.shown, free, strict=True):
            pixels = one.pixels(places, aside).transpose(2, 0, 1)
            gains.append(map_coordinates(image, pixels, order=1, mode="constant") * one.new[places, None])
        gain = np.where(open_, np.stack(gains, axis=1), -np.inf)
        peak = gain.max(axis=2)
        return np.exp(gain - peak[..., None]), peak

    def _darken(
        self, images: Sequence[Evidence], places: Int[np.ndarray, "k"], aside: Float[np.ndarray, "k views"]
    ) -> None:
        """Take away the evidence of the pixels that a way has darkened."""
        side = np.arange(-_COVER_PX, _COVER_PX + 1)
        disc = np.argwhere(np.hypot(side[:, None], side) < _COVER_PX + 0.5) - _COVER_PX
        for k, (one, image) in enumerate(zip(self.shown, images, strict=True)):
            at = np.rint(one.pixels(places, aside[:, k])[:, None] + disc).astype(int).reshape(-1, 2)
            at = at[((at >= 0) & (at < image.shape)).all(axis=1)]
            image[tuple(at.T)] = 0.0
