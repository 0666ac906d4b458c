"""The places of a vessel tree in which a wire or its tip can be: one grid for lines, images and time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.tree import smoothed
from endopilot.lines import places_on
from endopilot.types import Anatomy, VesselTree

_MOST_PLACES = 2500
"""A longer tree has places farther apart: memory and time grow with their square."""


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

    @cached_property
    def depth(self) -> Int[np.ndarray, "n"]:
        """Number of places before each."""
        depth = np.zeros(len(self.parent), dtype=np.int64)
        for place in range(1, len(depth)):
            depth[place] = depth[self.parent[place]] + 1
        return depth

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

    def along(self, image: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
        """Return the length from the root to each place in an image of the places, in its unit."""
        length = np.zeros(len(image))
        steps = np.linalg.norm(image - image[self.parent], axis=1)
        for place in range(1, len(image)):
            length[place] = length[self.parent[place]] + steps[place]
        return length

    def runs(self) -> list[Int[np.ndarray, "k"]]:
        """Return the places of each branch, and of the catheter, parents before their children."""
        return np.split(np.arange(len(self.branch)), np.flatnonzero(np.diff(self.branch)) + 1)

    def straightened(self, stiff_mm: float) -> Float[np.ndarray, "n 3"]:
        """Return where a device passes that is too stiff to follow each bend, LPS mm: the centerline, blurred.

        Along the longest path through each place, its ends kept, by a Gaussian of this standard deviation, mm.
        """
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


def make_grid(tree: VesselTree, *, step_mm: float) -> VesselGrid:
    """Return the grid of a tree, its places `step_mm` apart, or farther where there would be too many."""
    lines = [branch.centerline for branch in tree.branches]
    step_mm = max(step_mm, sum(float(np.ptp(line.abscissa)) for line in lines) / _MOST_PLACES)
    points, radius, abscissa, parent, branch = [], [], [], [], []
    last: dict[int, int] = {-1: -1}
    for index, line in enumerate(lines):
        at = np.linspace(line.abscissa[0], line.abscissa[-1], max(1, round(float(np.ptp(line.abscissa)) / step_mm)) + 1)
        before = tree.branches[index].parent
        at = at if before < 0 else at[1:]
        first = len(parent)
        points.append(places_on(line.points, line.abscissa, at))
        radius.append(np.interp(at, line.abscissa, line.radius))
        abscissa.append(at)
        parent += [last[before], *range(first, first + len(at) - 1)]
        branch += [index] * len(at)
        last[index] = len(parent) - 1
    return VesselGrid(
        step_mm=step_mm,
        middle=np.concatenate(points),
        radius=np.concatenate(radius),
        abscissa=np.concatenate(abscissa),
        branch=np.array(branch),
        parent=np.array(parent),
    )


def with_catheter(grid: VesselGrid, anatomy: Anatomy, length_mm: float) -> VesselGrid:
    """Return the grid with the straight end of the guiding catheter before its root."""
    start, count = anatomy.insertion, round(length_mm / grid.step_mm)
    at = grid.step_mm * np.arange(-count, 0)
    return VesselGrid(
        step_mm=grid.step_mm,
        middle=np.concatenate([start.position + at[:, None] * start.direction, grid.middle]),
        radius=np.concatenate([np.full(count, anatomy.catheter_radius_mm), grid.radius]),
        abscissa=np.concatenate([at, grid.abscissa]),
        branch=np.concatenate([np.full(count, -1), grid.branch]),
        parent=np.concatenate([np.arange(-1, count - 1), grid.parent + count]),
    )
