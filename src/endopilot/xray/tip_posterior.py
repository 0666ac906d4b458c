"""One posterior for lines and images: where in the vessel the tip is, and how far the vessel lies off.

The places of a vessel tree in which a wire or its tip can be are one grid for lines, images and time.
What an exposure or a drawn line says (`Told`) is, for each place of the grid, how much likelier it is if a wire ends
there than if there is none, and where tip and vessel lie then, normally distributed. Between two times the tip travels
along the vessel or, rarely, is anywhere; what later and earlier times say of a place adds up. The answer is mean and
covariance around the likeliest place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num

from endopilot.anatomy.tree import smoothed
from endopilot.lines import places_on
from endopilot.settings import Finite, NonNegative, OpenShare, Positive, Within, settings
from endopilot.types import Anatomy, VesselTree

Status = Literal["found", "ambiguous", "not found"]
_LEAST = 1e-300
_MOST_PLACES = 2500
"""A longer tree has places farther apart: memory and time grow with their square."""


@settings
class LocateConfig:
    """What is known of patient and device before the first frame."""

    landmark_mm: tuple[Finite, Finite, Finite] | None = None
    """A point of the CT, LPS mm, that the first frame shows: the tip, if no pixel is given. Without one the wire itself
    registers the patient."""
    landmark_px: tuple[Finite, Finite] | None = None
    """Column and row of the landmark in the first camera's image, pixels."""
    registration_sd_mm: Positive = 30.0
    """How far the patient may lie from where the cameras have the CT, without a landmark: standard deviation, mm."""
    turn_sd_deg: NonNegative = 4.0
    """And how far they may be turned about each axis, degrees."""
    breathing_sd_mm: NonNegative = 4.0
    """How far heart and breath move the vessel about its mean place: standard deviation, mm."""
    travel_mm: Positive = 4.0
    """How far the tip goes along the vessel from frame to frame, in the mean, mm."""
    stiff_mm: Annotated[float, Within(0, 100)] = 6.0
    """Length of the vessel over which the device straightens it, mm."""
    anywhere_share: OpenShare = 0.02
    """Share of the frames in which the tip may be anywhere, whatever the frames before say."""


class Told(NamedTuple):
    """What a line or an exposure says of some places of the tip.

    Attributes:
        places: of the grid.
        log: how much likelier it is with a tip there than without a device, a logarithm.
        mean: how far the tip lies then from the place, and the vessel from where registration has it, LPS mm.
        spread: covariance of these six numbers, mm².
    """

    places: Int[np.ndarray, "m"]
    log: Float[np.ndarray, "m"]
    mean: Float[np.ndarray, "m 6"]
    spread: Float[np.ndarray, "m 6 6"]


@dataclass(frozen=True, eq=False)
class TipEstimate:
    """Where the tip is, and how sure that is.

    Attributes:
        mean: of the tip's place in the CT and of how far the vessel lies off, LPS mm.
        spread: covariance of these six numbers, mm².
        share: of the posterior that lies near this place; the rest is elsewhere.
        elsewhere: what the rest adds to the covariance of the place, mm².
        mode: the likeliest place of the grid.
        wire: places of the wire from the root to the tip, LPS mm of the CT.
        log_odds: logarithm of how much likelier what is seen is with a wire than without.
        status: "found"; "ambiguous" where the tip may well lie elsewhere; "not found" where there is no wire.
    """

    mean: Float[np.ndarray, "6"]
    spread: Float[np.ndarray, "6 6"]
    share: float
    elsewhere: Float[np.ndarray, "3 3"]
    mode: int
    wire: Float[np.ndarray, "n 3"]
    log_odds: float = 0.0
    status: Status = "found"

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Of the tip, LPS mm of the CT."""
        return self.mean[:3]

    @property
    def covariance(self) -> Float[np.ndarray, "3 3"]:
        """Of the position, mm²; that of a tip which is ambiguous holds the places elsewhere."""
        return self.spread[:3, :3] + (self.elsewhere if self.status == "ambiguous" else 0.0)

    @property
    def shift(self) -> Float[np.ndarray, "3"]:
        """How far the vessel lies from where registration has it, LPS mm."""
        return self.mean[3:]


@dataclass(frozen=True, eq=False)
class VesselGrid:
    """Places along all branches, parents before their children; those of the catheter, if any, are the first.

    Attributes:
        step_mm: distance of neighbours, mm.
        middle: on the centerline, LPS mm.
        radius: of the lumen, mm.
        abscissa: from the root, mm; negative in the catheter.
        branch: index in the tree; -1 in the catheter.
        parent: the place before; -1 for the first.
    """

    step_mm: float
    middle: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    abscissa: Float[np.ndarray, "n"]
    branch: Int[np.ndarray, "n"]
    parent: Int[np.ndarray, "n"]

    @classmethod
    def of(cls, tree: VesselTree, *, step_mm: float) -> VesselGrid:
        """Return the grid of a tree, its places `step_mm` apart, or farther where there would be too many."""
        lines = [branch.centerline for branch in tree.branches]
        step_mm = max(step_mm, sum(float(np.ptp(line.abscissa)) for line in lines) / _MOST_PLACES)
        parts, last, count = [], {-1: -1}, 0
        for index, line in enumerate(lines):
            length_mm, before = float(np.ptp(line.abscissa)), tree.branches[index].parent
            at = np.linspace(line.abscissa[0], line.abscissa[-1], max(1, round(length_mm / step_mm)) + 1)
            at = at if before < 0 else at[1:]
            radius, parent = np.interp(at, line.abscissa, line.radius), count + np.arange(-1, len(at) - 1)
            parent[0] = last[before]
            parts.append((places_on(line.points, line.abscissa, at), radius, at, np.full(len(at), index), parent))
            count += len(at)
            last[index] = count - 1
        return cls(step_mm, *map(np.concatenate, zip(*parts, strict=True)))

    def with_catheter(self, anatomy: Anatomy, length_mm: float) -> VesselGrid:
        """Return the grid with the straight end of the guiding catheter before its root."""
        start, count = anatomy.insertion, round(length_mm / self.step_mm)
        at = self.step_mm * np.arange(-count, 0)
        middle, radius = start.position + at[:, None] * start.direction, np.full(count, anatomy.catheter_radius_mm)
        before = middle, radius, at, np.full(count, -1), np.arange(-1, count - 1)
        after = self.middle, self.radius, self.abscissa, self.branch, self.parent + count
        return VesselGrid(self.step_mm, *map(np.concatenate, zip(before, after, strict=True)))

    @cached_property
    def depth(self) -> Int[np.ndarray, "n"]:
        """Number of places before each."""
        return self.summed(np.ones(len(self.parent), dtype=np.int64))

    @cached_property
    def behind(self) -> Int[np.ndarray, "n deepest"]:
        """The place so many steps behind each place; the first beyond its depth."""
        behind = np.zeros((len(self.parent), int(self.depth.max()) + 1), dtype=np.int64)
        for place in range(1, len(behind)):
            behind[place, 0], behind[place, 1:] = place, behind[self.parent[place], :-1]
        return behind

    @cached_property
    def distance(self) -> Float[np.ndarray, "n n"]:
        """Distance between any two places along the tree, mm."""
        distance = np.zeros((len(self.parent), len(self.parent)))
        for place in range(1, len(distance)):
            before = self.parent[place]
            distance[place, :place] = distance[before, :place] + self.abscissa[place] - self.abscissa[before]
            distance[:place, place] = distance[place, :place]
        return distance

    def summed(self, steps: Num[np.ndarray, "n"]) -> Num[np.ndarray, "n"]:
        """Return what all places after the root up to each add together."""
        total = np.zeros_like(steps)
        for place in range(1, len(steps)):
            total[place] = total[self.parent[place]] + steps[place]
        return total

    def runs(self) -> list[Int[np.ndarray, "k"]]:
        """Return the places of each branch, and of the catheter, parents before their children."""
        return np.split(np.arange(len(self.branch)), np.flatnonzero(np.diff(self.branch)) + 1)

    def straightened(self, stiff_mm: float) -> Float[np.ndarray, "n 3"]:
        """Return where a device passes that is too stiff to follow each bend, LPS mm: the centerline, blurred along the
        longest path through each place, its ends kept, by a Gaussian of this standard deviation, mm."""
        leaf = np.arange(len(self.middle))
        for place in range(len(leaf) - 1, 0, -1):
            before = self.parent[place]
            if leaf[before] == before or self.abscissa[leaf[place]] > self.abscissa[leaf[before]]:
                leaf[before] = leaf[place]
        way = self.middle.copy()
        for end in np.unique(leaf):
            path = self.behind[end, : self.depth[end] + 1]
            own = leaf[path] == end
            way[path[own]] = smoothed(self.middle[path], stiff_mm / self.step_mm)[own]
        return way

    def goes(self, config: LocateConfig, frames: float) -> Float[np.ndarray, "n n"]:
        """Return how likely the tip goes from each place to each in so many frames' time."""
        stay = np.exp(-self.distance / (config.travel_mm * frames))
        rare = min(config.anywhere_share * frames, 0.5)
        return (1 - rare) * stay / stay.sum(axis=1, keepdims=True) + rare / len(stay)

    def told_by_later(
        self, config: LocateConfig, told: Sequence[Told], frames: Float[np.ndarray, "steps"]
    ) -> list[Float[np.ndarray, "_"]]:
        """Return what all later times say of each one's places, a logarithm, as each is told by itself, and so many
        frames lie between each and the next. In reverse order it is what all earlier ones say."""
        said = [np.zeros(len(told[-1].places))] if len(told) else []
        for k in range(len(told) - 1, 0, -1):
            log = told[k].log + said[-1]
            going = self.goes(config, float(frames[k - 1]))[np.ix_(told[k - 1].places, told[k].places)]
            said.append(np.log(going @ np.exp(log - log.max()) + _LEAST))
        return said[::-1]

    def estimate(self, told: Told, prior: Float[np.ndarray, "m"], near_mm: float) -> TipEstimate:
        """Return mean and covariance of a posterior within a distance of its mode, mm, given what is known before."""
        log = told.log + prior
        weight = np.exp(log - np.logaddexp.reduce(log))
        mode = int(told.places[weight.argmax()])
        places = np.concatenate([self.middle[told.places], np.zeros((len(weight), 3))], axis=1) + told.mean
        near = np.linalg.norm(self.middle[told.places] - self.middle[mode], axis=1) <= near_mm
        share = float(weight[near].sum())
        of, far = weight[near] / share, weight[~near]
        mean = of @ places[near]
        off, away = places[near] - mean, places[~near, :3] - mean[:3]
        spread = (of[:, None] * off).T @ off + np.einsum("m,mij->ij", of, told.spread[near])
        spread[:3, :3] += self.step_mm**2 / 12 * np.eye(3)
        path = self.behind[mode, 1 : self.depth[mode] + 1][::-1]
        return TipEstimate(
            mean=mean,
            spread=spread,
            share=share,
            elsewhere=(far[:, None] * away).T @ away,
            mode=mode,
            wire=np.concatenate([self.middle[path], mean[None, :3]]),
        )
