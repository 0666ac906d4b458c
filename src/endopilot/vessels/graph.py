"""The one graph of a vessel: points with radii, and what the ways between neighbours cost.

Whatever a file holds becomes one: the grid points inside a wall (`lumen_graph`), the middle of a mask (`medial_lines`),
centerlines (`line_graph`). Cheapest ways to a root make it a tree, which loops and touching vessels cannot close, and
branches are traced in that tree the same way for all. In a grid an edge costs its length over the squared distance to
the wall, so that cheapest ways keep to the middle at every scale (the weighting of VMTK's minimal action paths and of
TEASAR, Sato et al. 2000).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, Shaped
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from endopilot.imaging.voxels import dilated

COVERAGE = 1.6  # a path covers what lies within this many inscribed radii (and two grid steps) of it
SLENDERNESS = 2.2  # a kept side branch reaches this many of its radii out of its parent's inscribed sphere
TOGETHER = 0.5  # lines nearer each other than this share of the local radius run together and become one

_FINE_STEPS = 10.0
"""A part of the lumen is as wide as this many grid steps where every second one of them is enough: five steps a radius
is what a lumen's own grid has."""

_HALF_NEIGHBOURHOOD = np.array(
    [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)]
)


Graph = TypeVar("Graph", bound="VesselGraph")


@dataclass(frozen=True, eq=False)
class Line:
    """A line of a tree before it is cut at its branching points: points (LPS mm; the first is the parent's point
    `place`) and inscribed-sphere radii, mm. `parent` is the line that it leaves, -1 for the first."""

    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    parent: int
    place: int


@dataclass(frozen=True, eq=False)
class VesselGraph:
    """Points of a vessel, joined to their neighbours.

    Attributes:
        columns: names of the attributes that hold one row a point.
        radius: distance to the wall at each, mm.
        costs: sparse matrix of what the way between neighbours costs; each pair stands in it once.
        step_mm: distance of neighbours along an axis of the grid, or along a line, mm.
    """

    columns: ClassVar[tuple[str, ...]] = ("points", "radius")
    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    costs: csr_matrix
    step_mm: float

    @cached_property
    def edges(self) -> Int[np.ndarray, "m 2"]:
        """Pairs of neighbours."""
        return np.column_stack(self.costs.nonzero()).astype(np.int64)

    @cached_property
    def pieces(self) -> Int[np.ndarray, "n"]:
        """For each point the number of the connected piece that it belongs to, from 0 on."""
        return connected_components(self.costs, directed=False)[1]

    @cached_property
    def share_mm(self) -> Float[np.ndarray, "n"]:
        """Length that each point stands for, mm: half the length of the edges at it."""
        half = 0.5 * self.lengths(self.edges)
        return np.bincount(self.edges.ravel(), weights=np.repeat(half, 2), minlength=len(self.points))

    def lengths(self, pairs: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
        """Return how far the points of pairs lie apart, mm."""
        return np.linalg.norm(self.points[pairs[:, 0]] - self.points[pairs[:, 1]], axis=1)

    def away(self, nodes: Int[np.ndarray, "k"] | list[int], limit: float = np.inf) -> Float[np.ndarray, "k n"]:
        """Return what the cheapest way from each of some points to every point costs; infinity beyond a limit."""
        return np.asarray(dijkstra(self.costs, directed=False, indices=nodes, limit=limit))

    def parts(self, chosen: Bool[np.ndarray, "n"]) -> list[Int[np.ndarray, "_"]]:
        """Return the connected parts of chosen points."""
        members = np.flatnonzero(chosen)
        part = pieces(self.edges[chosen[self.edges].all(axis=1)], len(chosen))[members]
        return split(members, np.unique(part, return_inverse=True)[1]) if len(members) else []

    def part(self: Graph, kept: Bool[np.ndarray, "n"]) -> Graph:
        """Return some of the points with what joins them."""
        columns = {name: getattr(self, name)[kept] for name in self.columns}
        return replace(self, **columns, costs=self.costs[kept][:, kept])

    def joined(self: Graph, pairs: Int[np.ndarray, "m 2"], cost: Float[np.ndarray, "m"]) -> Graph:
        """Return the graph with further pairs joined; of edges that repeat, the cheapest counts."""
        pairs, cost = np.concatenate([self.edges, pairs]), np.concatenate([self.costs.data, np.maximum(cost, 1e-6)])
        key = pairs.min(axis=1) * len(self.points) + pairs.max(axis=1)
        order = np.lexsort((cost, key))
        first = order[np.diff(key[order], prepend=-1) != 0]
        return replace(self, costs=csr_matrix((cost[first], pairs[first].T), shape=self.costs.shape))

    def shortest(self, roots: Int[np.ndarray, "k"] | int) -> RootedGraph:
        """Return the graph, whose costs are lengths, with the ways to the nearest root: of infinite length if none."""
        length, before, _ = dijkstra(self.costs, directed=False, indices=roots, return_predecessors=True, min_only=True)  # pyright: ignore[reportAssignmentType]
        return RootedGraph(self.points, self.radius, self.costs, self.step_mm, before, length)

    def rooted(self, node: int) -> RootedGraph:
        """Return the part of the graph that a root reaches, with the cheapest ways to it."""
        cost, before = dijkstra(self.costs, directed=False, indices=node, return_predecessors=True)
        reached = np.isfinite(cost)
        number = np.append(np.cumsum(reached) - 1, -1)  # the last one stands for none
        before = number[np.maximum(before[reached], -1)]
        points = self.points[reached]
        costs = self.costs if reached.all() else self.costs[reached][:, reached]
        return RootedGraph(points, self.radius[reached], costs, self.step_mm, before, _length_to_root(points, before))


@dataclass(frozen=True, eq=False)
class RootedGraph(VesselGraph):
    """A graph with the shortest way of `length`, mm, from each point to a root by the next one, `before` (-1 there)."""

    before: Int[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]

    def back(self, node: int, stop: Bool[np.ndarray, "n"] | bool = False) -> Int[np.ndarray, "w"]:
        """Return the way from a point towards the root, up to the first point of `stop`, both included."""
        way, stop = [node], np.broadcast_to(stop, len(self.points))
        while not stop[way[-1]] and self.before[way[-1]] >= 0:
            way.append(int(self.before[way[-1]]))
        return np.array(way)

    def way(self, one: int, two: int) -> list[int]:
        """Return the points of the way through the tree between two points of a piece."""
        there, back = [one], [two]
        while there[-1] != back[-1]:  # the deeper one goes up, until both are where the two ways from the root part
            deeper = there if self.length[there[-1]] > self.length[back[-1]] else back
            deeper.append(int(self.before[deeper[-1]]))
        return there + back[-2::-1]

    def before_cap(self, nodes: Int[np.ndarray, "w"]) -> int:
        """Return how many points of a path stand before the first inscribed sphere that reaches the path's end."""
        gap = np.linalg.norm(self.points[nodes] - self.points[nodes[-1]], axis=1)
        clear = np.flatnonzero(gap > 2.0 * self.radius[nodes] + 2.0 * self.step_mm)
        return max(int(clear[-1]) + 2 if len(clear) else 0, min(4, len(nodes)))

    def traced(
        self, minimum_mm: float, *, coverage: float = COVERAGE, slenderness: float = SLENDERNESS, together: bool = False
    ) -> list[Int[np.ndarray, "_"]]:
        """Return the tree as paths of points: the first from the root, each other one from a point of an earlier path.

        The farthest uncovered point is traced back to the tree; its path covers what is within `coverage` radii and two
        steps. What reaches less than `minimum_mm`, `slenderness` times its radius or the local radius out of its parent
        is a bump. Points `together` are of lines that may repeat each other: a path ends within `TOGETHER` radii, or
        two steps, of an earlier one.
        """
        reach = coverage * self.radius + 2 * self.step_mm
        if together:
            reach = np.maximum(TOGETHER * self.radius, 2 * self.step_mm)
        around, covered = KDTree(self.points), ~np.isfinite(self.length)
        on_tree = covered if together else np.zeros(len(self.points), dtype=bool)
        paths: list[np.ndarray] = []
        for tip in np.argsort(-np.where(covered, -1.0, self.length), kind="stable"):
            if covered[tip]:
                continue
            nodes = self.back(int(tip), on_tree)[::-1]
            if together:
                new = self.length[nodes[-1]] - self.length[nodes[0]] > max(minimum_mm, self.radius[nodes[0]])
            else:
                new = self._is_branch(nodes, minimum_mm, slenderness)
            if new or not paths:
                on_tree[nodes] = True
                paths.append(nodes)
            elif not together:
                nodes = nodes[-1:]
            for found in around.query_ball_point(self.points[nodes], reach[nodes]):
                covered[found] = True
        return paths

    def _is_branch(self, nodes: Int[np.ndarray, "_"], minimum_mm: float, slenderness: float) -> bool:
        """Tell a side branch from a bump: it must reach far enough out of the inscribed sphere that it leaves."""
        points, wide = self.points[nodes], self.radius[nodes[0]]
        beyond = np.flatnonzero(np.linalg.norm(points - points[0], axis=1) > wide)
        if len(beyond) < 2:
            return False
        length = self.length[nodes[-1]] - self.length[nodes[beyond[0]]]
        own = float(np.median(self.radius[nodes[beyond]]))
        return bool(length >= max(minimum_mm, slenderness * own, 0.5 * wide))


def pieces(pairs: Int[np.ndarray, "m 2"], count: int) -> Int[np.ndarray, "count"]:
    """Return for each of `count` points, of which pairs are joined, the number of its connected piece, from 0 on."""
    joined = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def groups(points: Float[np.ndarray, "n 3"], apart_mm: float) -> Int[np.ndarray, "n"]:
    """Return for each point the number of its group: points as near each other as this, mm, are of one."""
    return pieces(KDTree(points).query_pairs(apart_mm, output_type="ndarray"), len(points))


def split(values: Shaped[np.ndarray, "n ..."], numbers: Integer[np.ndarray, "n"]) -> list[Shaped[np.ndarray, "_ ..."]]:
    """Return the values of each number from 0 on, in their order."""
    return np.split(values[np.argsort(numbers, kind="stable")], np.cumsum(np.bincount(numbers))[:-1])


def lumen_graph(
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    spacing_mm: float | Float[np.ndarray, "3"],
    root: int | None = None,
) -> RootedGraph:
    """Return the grid points in one lumen (of several spacings the largest), their clearance, mm, and the ways to a
    root, by default the point farthest from the widest place."""
    if root is None:
        graph = lumen_graph(points, clearance, spacing_mm, int(clearance.argmax()))
        return graph.rooted(int(graph.length.argmax()))
    edges = np.broadcast_to(np.asarray(spacing_mm, dtype=float), 3)
    index = np.rint((points - points.min(axis=0)) / edges).astype(np.int64) + 1
    shape = index.max(axis=0) + 2
    key = np.asarray(np.ravel_multi_index(tuple(index.T), tuple(shape)))
    order = np.asarray(np.argsort(key))
    ordered = key[order]

    def at(wanted: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
        """Return the points with these keys, -1 where there are none."""
        place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        return np.where(ordered[place] == wanted, order[place], -1)

    level = _levels(index, clearance, edges, root)
    kept = (index % (1 << level)[:, None] == 0).all(axis=1)
    weight = 1.0 / np.maximum(clearance, 0.1 * edges.max()) ** 2
    rows, columns, costs = [], [], []
    for stride in 1 << np.arange(level.max() + 1):
        own = np.flatnonzero(kept & (index % stride == 0).all(axis=1)) if stride > 1 else np.flatnonzero(kept)
        for step in _HALF_NEIGHBOURHOOD:
            jump = int(np.dot(step, [shape[1] * shape[2], shape[2], 1]))
            end = at(key[own] + stride * jump)
            found = (end >= 0) & kept[end]
            if stride > 1:  # between points of a wide part, or one of it and one beside it, through the lumen
                found &= np.maximum(level[own], level[end]) >= np.log2(stride)
                for between in range(1, stride):
                    found &= at(key[own] + between * jump) >= 0
            rows.append(own[found])
            columns.append(end[found])
            cost = 0.5 * (weight[rows[-1]] + weight[columns[-1]])
            costs.append(float(stride * np.linalg.norm(step * edges)) * cost)
    number = np.cumsum(kept) - 1
    pairs = number[np.concatenate(rows)], number[np.concatenate(columns)]
    matrix = csr_matrix((np.concatenate(costs), pairs), shape=(int(kept.sum()),) * 2)
    return VesselGraph(points[kept], clearance[kept], matrix, float(edges.max())).rooted(int(number[root]))


def _levels(
    index: Int[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], edges: Float[np.ndarray, "3"], root: int
) -> Int[np.ndarray, "n"]:
    """Return how coarse the grid may be at each point: every 2 to this power-th is enough where spheres of
    `_FINE_STEPS` such steps fill the lumen, away from narrower parts and from the root."""
    level = np.zeros(len(index), dtype=int)
    while (core := clearance > (wide := _FINE_STEPS * edges.max() * (1 << level.max()))).any():
        stride = 2 << level.max()
        lumen, middle = (np.zeros(index.max(axis=0) + 2, dtype=bool) for _ in range(2))
        lumen[tuple(index.T)] = True
        middle[tuple(index[core].T)] = True
        filled = np.asarray(distance_transform_edt(~middle, sampling=edges)) <= wide
        narrow = lumen & ~filled
        narrow[tuple(index[root])] = True
        coarse = (filled & ~dilated(narrow, 2 * int(stride)))[tuple(index.T)]
        if not coarse.any():
            break
        level[coarse] = int(np.log2(stride))
    return level


def _length_to_root(points: Float[np.ndarray, "n 3"], before: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    jump = np.where(before >= 0, before, np.arange(len(points)))
    length = np.linalg.norm(points - points[jump], axis=1)
    while True:
        further = jump[jump]
        if np.array_equal(further, jump):
            return length
        length, jump = length + length[jump], further
