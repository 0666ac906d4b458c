"""The inside of a lumen as a graph, and the branches traced through it.

Every grid point inside the lumen is a node; an edge costs its length over the squared distance to the wall, so that
cheapest paths keep to the middle at every scale (the weighting of VMTK's minimal action paths and of TEASAR, Sato et
al. 2000). Shortest paths from the root form a tree: loops and touching vessels cannot close it. The farthest uncovered
point is traced back until it meets the tree, and covers its surroundings; a piece that is not longer than it is wide,
or than the local radius, is a bump of the wall and is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from endopilot.imaging.grid import dilated

COVERAGE = 1.6
"""A path covers what lies within this many inscribed radii (and two grid steps) of it."""

SLENDERNESS = 2.2
"""A side branch is kept if it reaches this many times its own radius out of its parent's inscribed sphere."""

_FINE_STEPS = 10.0
"""A part of the lumen is as wide as this many grid steps where every second one of them is enough: five steps a radius
is what a lumen's own grid has."""

_HALF_NEIGHBOURHOOD = np.array(
    [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)]
)


@dataclass(frozen=True, eq=False)
class LumenGraph:
    """The inside of a lumen as a graph, with the cheapest path from every node to the root.

    Attributes:
        points: grid points inside the connected lumen at the root, LPS mm.
        clearance: their distance to the wall, mm.
        predecessor: next node on the path to the root, -1 at the root itself.
        length: length of the path to the root, mm.
        spacing_mm: grid spacing, mm.
        costs: the edges and what they cost.
    """

    points: Float[np.ndarray, "n 3"]
    clearance: Float[np.ndarray, "n"]
    predecessor: Int[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]
    spacing_mm: float
    costs: csr_matrix

    def rooted_at(self, node: int) -> LumenGraph:
        """Return the same graph with the cheapest paths to another root; points that it does not reach are left out."""
        return _rooted(self.points, self.clearance, self.spacing_mm, self.costs, node)


def _rooted(
    points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], spacing_mm: float, costs: csr_matrix, node: int
) -> LumenGraph:
    cost, predecessor = dijkstra(costs, directed=False, indices=node, return_predecessors=True)
    reached = np.isfinite(cost)
    renumber = np.cumsum(reached) - 1
    parent = predecessor[reached].astype(np.int64)
    parent = np.where(parent >= 0, renumber[np.maximum(parent, 0)], -1)
    kept = points[reached]
    costs = costs if reached.all() else costs[reached][:, reached]
    return LumenGraph(kept, clearance[reached], parent, _length_to_root(kept, parent), spacing_mm, costs)


def pieces(pairs: Int[np.ndarray, "m 2"], count: int) -> Int[np.ndarray, "count"]:
    """Return for each of `count` nodes, of which pairs are joined, the number of its connected piece, from 0 on."""
    joined = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def groups(points: Float[np.ndarray, "n 3"], apart_mm: float) -> Int[np.ndarray, "n"]:
    """Return for each point the number of its group: points as near each other as this, mm, are of one."""
    return pieces(KDTree(points).query_pairs(apart_mm, output_type="ndarray"), len(points))


def lumen_graph(
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    spacing_mm: float | Float[np.ndarray, "3"],
    root: int,
) -> LumenGraph:
    """Return the graph of grid points inside one lumen, with the paths to `root`.

    Args:
        points: grid points along the axes of the coordinates, mm.
        clearance: their distance to the wall, mm.
        spacing_mm: spacing of the grid, one or along each axis, mm; the graph keeps the largest.
        root: index of the point that all paths lead to.
    """
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
    return _rooted(points[kept], clearance[kept], float(edges.max()), matrix, int(number[root]))


def _levels(
    index: Int[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], edges: Float[np.ndarray, "3"], root: int
) -> Int[np.ndarray, "n"]:
    """Return how coarse the grid may be at each point: every 2 to this power-th point is enough.

    A part of the lumen that spheres of `_FINE_STEPS` times so many steps fill is as well resolved by it, away from
    narrower parts and from the root.
    """
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


def trace_branches(
    graph: LumenGraph, *, minimum_length_mm: float, coverage: float = COVERAGE, slenderness: float = SLENDERNESS
) -> list[Int[np.ndarray, "_"]]:
    """Return the tree as paths of nodes: the first from the root, each other one from a node of an earlier path.

    Args:
        graph: the lumen with its paths to the root.
        minimum_length_mm: a branch reaches at least this far out of its parent, mm.
        coverage: a path covers what lies within this many inscribed radii (and two grid steps) of it.
        slenderness: a branch reaches at least this many times its own radius out of its parent.
    """
    surroundings = KDTree(graph.points)
    covered = np.zeros(len(graph.points), dtype=bool)
    on_tree = np.zeros(len(graph.points), dtype=bool)
    paths: list[np.ndarray] = []
    order = np.argsort(-graph.length, kind="stable")
    for tip in order:
        if covered[tip]:
            continue
        path = [int(tip)]
        while not on_tree[path[-1]] and graph.predecessor[path[-1]] >= 0:
            path.append(int(graph.predecessor[path[-1]]))
        nodes = np.array(path[::-1])
        if len(paths) == 0 or _is_branch(graph, nodes, minimum_length_mm, slenderness):
            on_tree[nodes] = True
            paths.append(nodes)
        else:
            nodes = nodes[-1:]
        reach = coverage * graph.clearance[nodes] + 2 * graph.spacing_mm
        for found in surroundings.query_ball_point(graph.points[nodes], reach):
            covered[found] = True
    return paths


def _length_to_root(points: Float[np.ndarray, "n 3"], predecessor: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Sum the steps of every path to the root at once, by pointer doubling."""
    jump = np.where(predecessor >= 0, predecessor, np.arange(len(points)))
    length = np.linalg.norm(points - points[jump], axis=1)
    while True:
        further = jump[jump]
        if np.array_equal(further, jump):
            return length
        length, jump = length + length[jump], further


def _is_branch(graph: LumenGraph, nodes: Int[np.ndarray, "_"], minimum_length_mm: float, slenderness: float) -> bool:
    """Tell a side branch from a bump: it must reach far enough out of the inscribed sphere that it leaves."""
    points = graph.points[nodes]
    parent_radius = graph.clearance[nodes[0]]
    beyond = np.flatnonzero(np.linalg.norm(points - points[0], axis=1) > parent_radius)
    if len(beyond) < 2:
        return False
    length = graph.length[nodes[-1]] - graph.length[nodes[beyond[0]]]
    own_radius = float(np.median(graph.clearance[nodes[beyond]]))
    return bool(length >= max(minimum_length_mm, slenderness * own_radius, 0.5 * parent_radius))
