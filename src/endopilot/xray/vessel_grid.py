"""A vessel tree as a grid of places in which a tip can be, and the way that a device takes to each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.tree import smoothed
from endopilot.lines import places_on
from endopilot.types import VesselTree

_MOST_PLACES = 2500
"""A longer tree has places farther apart: memory and time grow with their square."""


@dataclass(frozen=True, eq=False)
class VesselGrid:
    """Places along all branches, parents before their children; place 0 is the root.

    Attributes:
        step_mm: distance of neighbours, mm.
        middle: on the centerline, LPS mm.
        way: where a device passes that is too stiff to follow each bend of the centerline, LPS mm.
        radius: of the lumen, mm.
        abscissa: from the root, mm.
        branch: index in the tree.
        parent: the place before; -1 for the root.
        depth: number of places before.
        behind: the place so many steps behind each place; the root beyond its depth.
        distance: between any two places along the tree, mm.
    """

    step_mm: float
    middle: Float[np.ndarray, "n 3"]
    way: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    abscissa: Float[np.ndarray, "n"]
    branch: Int[np.ndarray, "n"]
    parent: Int[np.ndarray, "n"]
    depth: Int[np.ndarray, "n"]
    behind: Int[np.ndarray, "n deepest"]
    distance: Float[np.ndarray, "n n"]

    def along(self, image: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
        """Return the length from the root to each place in an image of the places, in its unit."""
        length = np.zeros(len(image))
        steps = np.linalg.norm(image - image[self.parent], axis=1)
        for place in range(1, len(image)):
            length[place] = length[self.parent[place]] + steps[place]
        return length


def make_grid(tree: VesselTree, *, step_mm: float, stiff_mm: float) -> VesselGrid:
    """Return the grid of a tree; coarse centerlines are resampled.

    Args:
        tree: centerlines with radii.
        step_mm: distance of the places, mm; more in trees too long for it.
        stiff_mm: length over which a device straightens the vessel's bends, mm: standard deviation of a Gaussian.
    """
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
    count, parents = len(parent), np.array(parent)
    middle, along = np.concatenate(points), np.concatenate(abscissa)
    depth = np.zeros(count, dtype=np.int64)
    for place in range(1, count):
        depth[place] = depth[parents[place]] + 1
    behind = np.zeros((count, int(depth.max()) + 1), dtype=np.int64)
    distance = np.zeros((count, count))
    for place in range(1, count):
        before = parents[place]
        behind[place, 0], behind[place, 1:] = place, behind[before, :-1]
        distance[place, :place] = distance[before, :place] + along[place] - along[before]
        distance[:place, place] = distance[place, :place]
    return VesselGrid(
        step_mm=step_mm,
        middle=middle,
        way=_straightened(middle, along, parents, depth, behind, stiff_mm / step_mm),
        radius=np.concatenate(radius),
        abscissa=along,
        branch=np.array(branch),
        parent=parents,
        depth=depth,
        behind=behind,
        distance=distance,
    )


def _straightened(
    middle: Float[np.ndarray, "n 3"],
    along: Float[np.ndarray, "n"],
    parent: Int[np.ndarray, "n"],
    depth: Int[np.ndarray, "n"],
    behind: Int[np.ndarray, "n deepest"],
    width: float,
) -> Float[np.ndarray, "n 3"]:
    """Return the places blurred along the longest path through each one, the ends kept; `width` is in steps."""
    leaf = np.arange(len(middle))
    for place in range(len(middle) - 1, 0, -1):
        before = parent[place]
        if leaf[before] == before or along[leaf[place]] > along[leaf[before]]:
            leaf[before] = leaf[place]
    way = middle.copy()
    for end in np.unique(leaf):
        path = behind[end, : depth[end] + 1]
        own = leaf[path] == end
        way[path[own]] = smoothed(middle[path], width)[own]
    return way
