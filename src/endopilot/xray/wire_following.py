"""A wire followed through a corridor, section after section, forwards and, from where it may fold, back again.

A forward recursion of a hidden Markov model: a state is a place in a cross-section of the vessel, an observation is how
much more likely the pixel there is on a wire than off it. A pixel counts once: what the wire's own way has darkened
says nothing of its later places, which may lie before or behind it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import map_coordinates

from endopilot.xray.carm import View
from endopilot.xray.corridor import STEP_MM, Corridor, Passage

_TURNS = np.array([0.5, 0.2, 0.05])
"""How likely a wire moves aside by 0, 1 or 2 cells of 0.2 mm, either way, from a cross-section to the next, 0.25 mm
on."""
_ASIDE = 0.2
"""Root mean square of the sine of the angle between a wire and the centerline."""
_CHUNK, _GAP = 12, 12
"""Sections that are followed at a time, and how many of the last ones do not darken what comes next: they are where it
comes from."""
_COVER_PX = 3
"""Pixels this near to the wire's way are darkened by it."""
_LOST = 40.0
"""A way that is this much less likely in each view, in logarithms, than where it was likeliest is given up."""
_BREAK = 50.0
"""Loss of a way that leaves the places that it can reach."""
_FOLD_MM = 45.0
"""Length of a wire behind its fold that is followed, mm."""
Evidence = Float32[np.ndarray, "rows columns"]


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of the wire's way, through one passage in one direction.

    Attributes:
        passage: index in the corridor.
        section: of the passage, in the order in which the wire passes them.
        alpha: share of every place, given what was seen up to its section.
        log_scale: logarithm of the evidence up to each section.
        length: of the wire up to each section, mm.
        places: LPS mm.
        before: the leg before, and the last of its sections that the way takes; None for the first.
        likeliest: largest `log_scale` of the way so far.
        lost: whether the way was given up at the leg's end.
        free: evidence of each view that the way has not used.
    """

    passage: int
    section: Int[np.ndarray, "n"]
    alpha: Float32[np.ndarray, "n g g"]
    log_scale: Float[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]
    places: Float[np.ndarray, "n g g 3"]
    before: tuple[Leg, int] | None
    likeliest: float
    lost: bool
    free: Sequence[Evidence]


@dataclass(frozen=True, eq=False)
class Stop:
    """One place of a wire's way.

    Attributes:
        leg: that it lies in.
        at: index of its section in the leg.
        cell: of the section's grid.
    """

    leg: Leg
    at: int
    cell: tuple[int, int]

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Where it lies, LPS mm."""
        return self.leg.places[self.at][self.cell]


class Follower:
    """Follows wires through a corridor in the images of one exposure."""

    def __init__(self, corridor: Corridor, views: Sequence[View], evidence: Sequence[Evidence]) -> None:
        """Take the images.

        Args:
            corridor: of the vessel.
            views: in the CT's frame, as registration has them.
            evidence: for each view the logarithm of how much likelier each pixel is on a wire than off it.
        """
        self._corridor, self._views, self._evidence = corridor, views, evidence
        cells = np.arange(len(corridor.offsets))
        turn = np.interp(np.abs(cells[:, None] - cells), np.arange(len(_TURNS)), _TURNS, right=0.0)
        self._turn = turn.astype(np.float32)
        self._new = [[_new_pixels(one, view) for view in views] for one in corridor.passages]

    def forwards(self) -> list[Leg]:
        """Return the legs of all ways from the catheter on, parents before their children."""
        legs: dict[int, Leg] = {}
        for index, passage in enumerate(self._corridor.passages):
            before = None
            if passage.parent >= 0:
                parent = legs.get(passage.parent)
                if parent is None or parent.lost:
                    continue
                before = parent, len(parent.section) - 1
            legs[index] = self._walk(index, np.arange(len(passage.abscissa)), before)
        return list(legs.values())

    def backwards(self, leg: Leg, at: int) -> list[Leg]:
        """Return the legs of a wire that folds at a section of a leg: back, and on into the branches that it passes."""
        free = self._uncovered(self._evidence, [stop.place for stop in self.way(leg, at)])
        index, sections, most = leg.passage, leg.section[at::-1], round(_FOLD_MM / STEP_MM)
        legs = [self._walk(index, sections[:most], (leg, at), free)]
        came, most = index, most - len(sections)
        while (parent := self._corridor.passages[came].parent) >= 0 and most > 0 and not legs[-1].lost:
            back = legs[-1]
            before, others = (back, len(back.section) - 1), []
            for other, passage in enumerate(self._corridor.passages):
                if passage.parent == parent and other != came:
                    others.append(self._walk(other, np.arange(min(most, len(passage.abscissa))), before))
            sections = np.arange(len(self._corridor.passages[parent].abscissa))[::-1]
            legs += [*others, self._walk(parent, sections[:most], before)]
            came, most = parent, most - len(sections)
        return legs

    def way(self, leg: Leg, at: int, most: int | None = None) -> list[Stop]:
        """Return the likeliest way of a wire up to a section.

        Args:
            leg: that it ends in.
            at: index of the section in the leg.
            most: number of the last stops that are wanted; all if not given.
        """
        found = []
        for stop in self._backtracked(leg, at):
            found.append(stop)
            if len(found) == most:
                break
        return found[::-1]

    def _backtracked(self, leg: Leg, at: int) -> Iterator[Stop]:
        """Yield the stops from the last one backwards: each is the likeliest, given the one after."""
        cell, reach = _likeliest(leg.alpha[at]), len(_TURNS) - 1
        yield Stop(leg, at, cell)
        while at > 0 or leg.before is not None:
            if at > 0:
                at -= 1
                low = [max(one - reach, 0) for one in cell]
                box = tuple(slice(first, one + reach + 1) for first, one in zip(low, cell, strict=True))
                near = leg.alpha[at][box] * self._turn[cell[0], box[0], None] * self._turn[None, cell[1], box[1]]
                inside = _likeliest(near)
                cell = (low[0] + inside[0], low[1] + inside[1]) if near[inside] > 0 else _likeliest(leg.alpha[at])
            else:
                place, (leg, at) = leg.places[0][cell], leg.before
                near = (np.exp(-2 * ((leg.places[at] - place) ** 2).sum(axis=-1)) + 1e-9).astype(np.float32)
                cell = _likeliest(leg.alpha[at] * near)
            yield Stop(leg, at, cell)

    def _walk(
        self,
        index: int,
        section: Int[np.ndarray, "n"],
        before: tuple[Leg, int] | None,
        free: Sequence[Evidence] | None = None,
    ) -> Leg:
        """Run the forward recursion through sections of one passage.

        Args:
            index: of the passage.
            section: in the order in which they are passed.
            before: the leg before, and its last section.
            free: evidence that a wire which folds here has not used; that of the leg before if not given.
        """
        passage = self._corridor.passages[index]
        places, allowed = self._corridor.places(passage, section), self._corridor.open(passage)[section]
        state, log_scale, length = self._entry(passage, int(section[0]), allowed[0], before, turned=free is not None)
        likeliest = log_scale if before is None else before[0].likeliest
        free = [image.copy() for image in (free or (self._evidence if before is None else before[0].free))]
        lengths = length + STEP_MM * np.arange(len(section))
        alpha, scales = np.empty(allowed.shape, dtype=np.float32), np.empty(len(section))
        lost, leg = False, Leg(index, section, alpha, scales, lengths, places, before, likeliest, False, free)
        for low in range(0, len(section), _CHUNK):
            here = slice(low, min(low + _CHUNK, len(section)))
            gain = self._gain(index, section[here], places[here], allowed[here], free)
            peak = np.where(allowed[here], gain, -np.inf).max(axis=(1, 2))
            factor = np.where(allowed[here], np.exp(gain - peak[:, None, None]), 0.0).astype(np.float32)
            for number, at in enumerate(range(here.start, here.stop)):
                state = self._turn @ state @ self._turn
                inside = float(state[allowed[at]].sum())  # a wire does not leave the vessel
                state *= factor[number]
                total = float(state.sum())
                if total <= 0:  # no place can be reached: begin anew, at a great loss
                    state, total = factor[number].copy(), float(factor[number].sum())
                    inside, log_scale = float(allowed[at].sum()), log_scale - _BREAK
                state /= total
                log_scale += np.log(total / inside) + peak[number]
                alpha[at], scales[at] = state, log_scale
            likeliest = max(likeliest, float(scales[here].max()))
            passed = [stop.place for stop in self.way(leg, here.stop - 1, _CHUNK + _GAP)[:-_GAP]]
            free = self._uncovered(free, passed, copy=False)
            if lost := bool(log_scale < likeliest - _LOST * len(self._views)):
                section, alpha, scales = section[: here.stop], alpha[: here.stop], scales[: here.stop]
                lengths, places = lengths[: here.stop], places[: here.stop]
                break
        return Leg(index, section, alpha, scales, lengths, places, before, likeliest, lost, free)

    def _gain(
        self,
        index: int,
        section: Int[np.ndarray, "n"],
        places: Float[np.ndarray, "n g g 3"],
        allowed: Bool[np.ndarray, "n g g"],
        free: Sequence[Evidence],
    ) -> Float32[np.ndarray, "n g g"]:
        """Return the evidence of all views at the places of some sections."""
        gain, points = np.zeros(allowed.shape, dtype=np.float32), places[allowed]
        for view, image, new in zip(self._views, free, self._new[index], strict=True):
            weight = np.broadcast_to(new[section, None, None], allowed.shape)[allowed]
            at = _pixels(view, image, points)
            gain[allowed] += weight * map_coordinates(image, at, order=1, mode="constant", output=np.float32)
        return gain

    def _entry(
        self,
        passage: Passage,
        section: int,
        allowed: Bool[np.ndarray, "g g"],
        before: tuple[Leg, int] | None,
        *,
        turned: bool,
    ) -> tuple[Float32[np.ndarray, "g g"], float, float]:
        """Return the shares with which a leg begins, the evidence so far, and the wire's length.

        The shares are those at the end of the leg before, turned into this one's axes; a fold crosses the lumen.
        """
        anywhere = (allowed / allowed.sum()).astype(np.float32)
        if before is None:
            return anywhere, 0.0, float(passage.abscissa[section])
        leg, at = before
        end, last, offsets = self._corridor.passages[leg.passage], leg.section[at], self._corridor.offsets
        step = abs(float(passage.abscissa[section] - end.abscissa[last]))
        log_scale, length = float(leg.log_scale[at]), float(leg.length[at]) + step
        if turned:
            return anywhere, log_scale, length
        away = self._corridor.places(passage, np.array([section]))[0] - end.middle[last]
        grid = np.stack([away @ end.first[last], away @ end.second[last]])
        index = (grid - offsets[0]) / (offsets[1] - offsets[0])
        state = np.clip(map_coordinates(leg.alpha[at], index, order=1, mode="constant"), 0, None)
        total = float(state.sum())
        if total <= 0:
            return anywhere, log_scale - _BREAK, length
        return (state / total).astype(np.float32), log_scale, length

    def _uncovered(
        self, images: Sequence[Evidence], way: Sequence[Float[np.ndarray, "3"]], *, copy: bool = True
    ) -> list[Evidence]:
        """Return evidence without that of the pixels that a way has darkened."""
        left = [image.copy() if copy else image for image in images]
        if len(way):
            for view, image in zip(self._views, left, strict=True):
                at = np.rint(_pixels(view, image, np.array(way)).T).astype(int)
                at = (at[:, None] + _DISC).reshape(-1, 2)
                at = at[((at >= 0) & (at < image.shape)).all(axis=1)]
                image[at[:, 0], at[:, 1]] = 0.0
        return left


_DISC = np.argwhere(np.hypot(*np.mgrid[-_COVER_PX : _COVER_PX + 1, -_COVER_PX : _COVER_PX + 1]) < _COVER_PX + 0.5)
_DISC = _DISC - _COVER_PX


def _likeliest(share: Float32[np.ndarray, "a b"]) -> tuple[int, int]:
    row, column = divmod(int(share.argmax()), share.shape[1])
    return row, column


def _pixels(view: View, image: Evidence, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 n"]:
    """Return rows and columns of points, LPS mm."""
    right_up, middle = view.project(points), (len(image) - 1) / 2
    return np.stack([middle - right_up[:, 1], middle + right_up[:, 0]])


def _new_pixels(passage: Passage, view: View) -> Float32[np.ndarray, "n"]:
    """Return how long each section's step is in the image, as a share of one across the beam.

    A wire along the beam is one dark spot. Its pixels must not count anew in every section that they lie in.
    """
    tangent = np.cross(passage.first, passage.second)
    ahead = view.project(passage.middle + 0.5 * STEP_MM * tangent)
    depth = (passage.middle - view.source) @ view.axes[2]
    step = np.linalg.norm(ahead - view.project(passage.middle - 0.5 * STEP_MM * tangent), axis=1)
    return np.hypot(np.minimum(step * depth / (view.scale * STEP_MM), 1.0), _ASIDE).astype(np.float32)
