"""A wire followed through a corridor, section after section, forwards and, from where it may fold, back again.

A forward recursion of a hidden Markov model: a state is a place in a cross-section of the vessel, an observation is how
much more likely the pixel there is on a wire than off it. A pixel counts once: what the wire's own way has darkened
says nothing of its later places, which may lie before or behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import map_coordinates

from endopilot.xray.corridor import STEP_MM, Corridor, Passage
from endopilot.xray.corridor_view import CorridorView, Evidence

_TURNS = np.array([0.5, 0.2, 0.05])
"""How likely a wire moves aside by 0, 1 or 2 cells of 0.2 mm, either way, from a cross-section to the next, 0.25 mm
on."""
_REACH = len(_TURNS) - 1
_AROUND = np.concatenate([_TURNS[:0:-1], _TURNS]).astype(np.float32)
_BOTH = np.outer(_AROUND, _AROUND)
_CHUNK, _GAP = 12, 12
"""Sections that are followed at a time, and how many of the last ones do not darken what comes next: they are where it
comes from."""
_LOST = 40.0
"""A way that is this much less likely in each view, in logarithms, than where it was likeliest is given up."""
_BREAK = 50.0
"""Loss of a way that leaves the places that it can reach."""
_FOLD_MM = 45.0
"""Length of a wire behind its fold that is followed, mm."""


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of the wire's way, through one passage in one direction.

    Attributes:
        index: of the passage in the corridor.
        passage: that it lies in.
        section: of the passage, in the order in which the wire passes them.
        padded: share of every place, given what was seen up to its section, with zeros around each grid.
        log_scale: logarithm of the evidence up to each section.
        length: of the wire up to each section, mm.
        before: the leg before, and the last of its sections that the way takes; None for the first.
        likeliest: largest `log_scale` of the way so far.
        lost: whether the way was given up at the leg's end.
        free: evidence of each view that the way has not used.
    """

    index: int
    passage: Passage
    section: Int[np.ndarray, "n"]
    padded: Float32[np.ndarray, "n g_and_4 g_and_4"]
    log_scale: Float[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]
    before: tuple[Leg, int] | None
    likeliest: float
    lost: bool
    free: Sequence[Evidence]

    @property
    def alpha(self) -> Float32[np.ndarray, "n g g"]:
        """Share of every place, given what was seen up to its section."""
        return self.padded[:, _REACH:-_REACH, _REACH:-_REACH]


class Stop(NamedTuple):
    """One place of a wire's way.

    Attributes:
        leg: that it lies in.
        at: index of its section in the leg.
        row, column: of the section's grid.
    """

    leg: Leg
    at: int
    row: int
    column: int


def places_of(stops: Sequence[Stop]) -> Float[np.ndarray, "k 3"]:
    """Return where the stops of a way lie, LPS mm."""
    found, low = np.empty((len(stops), 3)), 0
    while low < len(stops):  # stops of one leg follow each other
        leg, high = stops[low].leg, low
        while high < len(stops) and stops[high].leg is leg:
            high += 1
        at, row, column = np.array([one[1:] for one in stops[low:high]]).T
        found[low:high] = leg.passage.place(leg.section[at], row, column)
        low = high
    return found


class Follower:
    """Follows wires through a corridor in the images of one exposure."""

    def __init__(self, corridor: Corridor, shown: Sequence[CorridorView], evidence: Sequence[Evidence]) -> None:
        """Take the images.

        Args:
            corridor: of the vessel.
            shown: it in each view.
            evidence: for each view the logarithm of how much likelier each pixel is on a wire than off it.
        """
        self._corridor, self._shown = corridor, shown
        self._evidence = [view.cut(image) for view, image in zip(shown, evidence, strict=True)]
        self._turns: dict[int, Float32[np.ndarray, "g g"]] = {}

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

    def backwards(self, leg: Leg, at: int, longest_mm: float = np.inf) -> list[Leg]:
        """Return the legs of a wire that folds at a section of a leg: back, and on into the branches that it passes.

        Args:
            leg: that it folds in.
            at: index of the section in the leg.
            longest_mm: a wire is not followed beyond this length.
        """
        free = [image.copy() for image in (self._evidence if leg.before is None else leg.before[0].free)]
        self._darken(free, self.way(leg, at, at + 1 + _GAP))
        most = round(min(_FOLD_MM, longest_mm - float(leg.length[at])) / STEP_MM)
        index, sections = leg.index, leg.section[at::-1]
        legs = [self._walk(index, sections[: max(most, 1)], (leg, at), free)]
        came, most = index, most - len(sections)
        # A wire that folds does not go back into the catheter, the first passage.
        while (parent := self._corridor.passages[came].parent) > 0 and most > 0 and not legs[-1].lost:
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
        """Return the likeliest way of a wire up to a section: each stop is the likeliest, given the one after.

        Args:
            leg: that it ends in.
            at: index of the section in the leg.
            most: number of the last stops that are wanted; all if not given.
        """
        row, column = _likeliest(leg.padded[at])
        row, column, side = row - _REACH, column - _REACH, 2 * _REACH + 1
        found = [Stop(leg, at, row, column)]
        while len(found) != most and (at > 0 or leg.before is not None):
            if at > 0:
                at -= 1
                near = leg.padded[at, row : row + side, column : column + side] * _BOTH
                best = int(near.argmax())
                down, right = divmod(best, side)
                if near[down, right] > 0:
                    row, column = row + down - _REACH, column + right - _REACH
                else:
                    row, column = _likeliest(leg.alpha[at])
            else:
                assert leg.before is not None
                place = places_of(found[-1:])[0]
                leg, at = leg.before
                away = leg.passage.places(leg.section[at : at + 1])[0] - place
                near = (np.exp(-2 * (away**2).sum(axis=-1)) + 1e-9).astype(np.float32)
                row, column = _likeliest(leg.alpha[at] * near)
            found.append(Stop(leg, at, row, column))
        return found[::-1]

    def _walk(
        self,
        index: int,
        section: Int[np.ndarray, "n"],
        before: tuple[Leg, int] | None,
        free: list[Evidence] | None = None,
    ) -> Leg:
        """Run the forward recursion through sections of one passage.

        Args:
            index: of the passage.
            section: neighbours, in the order in which they are passed.
            before: the leg before, and its last section.
            free: evidence that a wire which folds here has not used; that of the leg before if not given.
        """
        passage, count = self._corridor.passages[index], len(section)
        state, log_scale, length = self._entry(passage, int(section[0]), before, turned=free is not None)
        likeliest = log_scale if before is None else before[0].likeliest
        if free is None:
            free = [image.copy() for image in (self._evidence if before is None else before[0].free)]
        grid = len(passage.offsets)
        turn, allowed = self._turn(grid), passage.open[section].astype(np.float32).reshape(count, -1)
        padded, scales = np.zeros((count, grid + 2 * _REACH, grid + 2 * _REACH), dtype=np.float32), np.empty(count)
        lengths, lost = length + STEP_MM * np.arange(count), False
        leg = Leg(index, passage, section, padded, scales, lengths, before, likeliest, False, free)
        alpha = leg.alpha
        for low in range(0, count, _CHUNK):
            high = min(low + _CHUNK, count)
            factor, peak = self._gain(index, section[low:high], free)
            gained = np.empty(high - low)
            for number in range(high - low):
                at = low + number
                state = turn @ state @ turn
                inside = float(state.ravel() @ allowed[at])  # a wire does not leave the vessel
                state *= factor[number]
                total = float(state.sum())
                loss = 0.0
                if total <= 0:  # no place can be reached: begin anew, at a great loss
                    state = factor[number].copy()
                    total, inside, loss = float(state.sum()), float(allowed[at].sum()), _BREAK
                state /= np.float32(total)
                gained[number] = total / inside * np.exp(-loss)
                alpha[at] = state
            scales[low:high] = log_scale + np.cumsum(np.log(gained) + peak)
            log_scale = float(scales[high - 1])
            likeliest = max(likeliest, float(scales[low:high].max()))
            self._darken(free, self.way(leg, high - 1, _CHUNK + _GAP)[:-_GAP])
            if lost := bool(log_scale < likeliest - _LOST * len(self._shown)):
                section, padded, scales, lengths = section[:high], padded[:high], scales[:high], lengths[:high]
                break
        return Leg(index, passage, section, padded, scales, lengths, before, likeliest, lost, free)

    def _gain(
        self, index: int, section: Int[np.ndarray, "n"], free: Sequence[Evidence]
    ) -> tuple[Float32[np.ndarray, "n g g"], Float32[np.ndarray, "n"]]:
        """Return how much likelier all views make the places of some sections, over the likeliest's, and that one's."""
        passage, backwards = self._corridor.passages[index], section[0] > section[-1]
        low, high = int(section.min()), int(section.max()) + 1
        start, grid = passage.start[low : high + 1], len(passage.offsets)
        here, counts = slice(start[0], start[-1]), np.diff(start)
        gain = np.zeros(int(start[-1] - start[0]), dtype=np.float32)
        for shown, image in zip(self._shown, free, strict=True):
            gain += np.repeat(shown.new[index][low:high], counts) * shown.read(image, index, here)
        peak = np.maximum.reduceat(gain, start[:-1] - start[0])
        factor = np.zeros((high - low, grid, grid), dtype=np.float32)
        factor.ravel()[passage.cells[here] - low * grid * grid] = np.exp(gain - np.repeat(peak, counts))
        return (factor[::-1], peak[::-1]) if backwards else (factor, peak)

    def _entry(
        self, passage: Passage, section: int, before: tuple[Leg, int] | None, *, turned: bool
    ) -> tuple[Float32[np.ndarray, "g g"], float, float]:
        """Return the shares with which a leg begins, the evidence so far, and the wire's length.

        The shares are those at the end of the leg before, turned into this one's axes; a fold crosses the lumen.
        """
        allowed = passage.open[section]
        anywhere = (allowed / allowed.sum()).astype(np.float32)
        if before is None:
            return anywhere, 0.0, float(passage.abscissa[section])
        leg, at = before
        end, last = leg.passage, leg.section[at]
        step = abs(float(passage.abscissa[section] - end.abscissa[last]))
        log_scale, length = float(leg.log_scale[at]), float(leg.length[at]) + step
        if turned:
            return anywhere, log_scale, length
        away = passage.places(np.array([section]))[0] - end.middle[last]
        grid = np.stack([away @ end.first[last], away @ end.second[last]])
        index = (grid - end.offsets[0]) / (end.offsets[1] - end.offsets[0])
        state = np.clip(map_coordinates(leg.alpha[at], index, order=1, mode="constant"), 0, None)
        total = float(state.sum())
        if total <= 0:
            return anywhere, log_scale - _BREAK, length
        return (state / total).astype(np.float32), log_scale, length

    def _turn(self, grid: int) -> Float32[np.ndarray, "g g"]:
        """Return how likely a wire moves aside, from each row or column of a grid to each."""
        if grid not in self._turns:
            cells = np.arange(grid)
            aside = np.interp(np.abs(cells[:, None] - cells), np.arange(len(_TURNS)), _TURNS, right=0.0)
            self._turns[grid] = aside.astype(np.float32)
        return self._turns[grid]

    def _darken(self, images: Sequence[Evidence], way: Sequence[Stop]) -> None:
        """Take away the evidence of the pixels that a way has darkened."""
        if way:
            places = places_of(way)
            for shown, image in zip(self._shown, images, strict=True):
                shown.darken(image, places)


def _likeliest(share: Float32[np.ndarray, "a b"]) -> tuple[int, int]:
    row, column = divmod(int(share.argmax()), share.shape[1])
    return row, column
