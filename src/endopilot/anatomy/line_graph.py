"""The points of centerlines as the nodes of a graph: joined along lines, where lines meet, and across small gaps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from endopilot.anatomy.lumen_graph import pieces
from endopilot.anatomy.sources import Polylines
from endopilot.lines import length_along, places_on

STEP_MM = 0.5
"""Distance between the points of the tree, mm."""

LONGEST_BRIDGE = 4.0
"""Lines that end within this many radii of another are joined to it; the gap is noted."""

_OPPOSITE = -0.5
"""Cosine of the angle between two directions from which on a vessel passes a place rather than forks there."""

_OWN_MM = 2.0
"""A line's points that coincide and lie farther than this apart along it are a place that it comes back to, mm."""


@dataclass(frozen=True, eq=False)
class LineNodes:
    """Points of all lines, twice as dense as the tree's.

    Attributes:
        points: positions, mm.
        radius: inscribed-sphere radii, mm.
        owner: index of the line of each.
        along: distance from the start of its line, mm.
        ends: which are the first or last of their line.
        share: length of line that each stands for, mm.
    """

    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    owner: Int[np.ndarray, "n"]
    along: Float[np.ndarray, "n"]
    ends: Bool[np.ndarray, "n"]
    share: Float[np.ndarray, "n"]

    def part(self, keep: Bool[np.ndarray, "n"]) -> LineNodes:
        """Return some of the nodes; where a line is cut it has an end."""
        parts = {name: values[keep] for name, values in vars(self).items()}
        owner, along = parts["owner"], parts["along"]
        cut = (np.diff(owner) != 0) | (np.diff(along) > STEP_MM)
        parts["ends"] = np.concatenate([[True], cut]) | np.concatenate([cut, [True]])
        return LineNodes(**parts)

    def free_ends(self) -> Int[np.ndarray, "e"]:
        """Return the ends that no vessel passes, or all ends if there is no such.

        Seen from a free end, what lies about one and a half radii away lies in one direction, or forks there.
        """
        tree, free = KDTree(self.points), []
        for end in np.flatnonzero(self.ends):
            reach = max(1.5 * float(self.radius[end]), 4 * STEP_MM)
            near = np.array(tree.query_ball_point(self.points[end], reach), dtype=np.int64)
            offset = self.points[near] - self.points[end]
            gap = np.linalg.norm(offset, axis=1)
            sight = np.unique((offset[gap > 0.6 * reach] / gap[gap > 0.6 * reach, None]).round(1), axis=0)
            if len(sight) == 0 or (sight @ sight.T).min() > _OPPOSITE:
                free.append(end)
        return np.array(free or np.flatnonzero(self.ends), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Edges:
    """Which nodes are joined.

    Attributes:
        nodes: two indices an edge.
        cost: what a route along each costs, mm: its length on a line, more where it changes lines.
        count: number of nodes.
    """

    nodes: Int[np.ndarray, "m 2"]
    cost: Float[np.ndarray, "m"]
    count: int

    @cached_property
    def matrix(self):
        """Return the sparse matrix of the costs between nodes; of edges that repeat, the cheapest counts."""
        key = np.minimum(*self.nodes.T) * self.count + np.maximum(*self.nodes.T)
        order = np.lexsort((self.cost, key))
        first = order[np.concatenate([[True], np.diff(key[order]) != 0])] if len(key) else order
        nodes, cost = self.nodes[first], np.maximum(self.cost[first], 1e-6)
        return csr_matrix((cost, (nodes[:, 0], nodes[:, 1])), shape=(self.count, self.count))

    @cached_property
    def pieces(self) -> Int[np.ndarray, "n"]:
        """Return for each node the number of the connected piece that it belongs to."""
        return pieces(self.nodes, self.count)


def dense_nodes(source: Polylines) -> LineNodes:
    """Return the nodes of all lines, about `STEP_MM` / 2 apart; lines have no points that coincide in succession."""
    parts = []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        length = length_along(line)
        wanted = np.linspace(0.0, length[-1], max(2, round(length[-1] / (0.5 * STEP_MM)) + 1))
        points = places_on(line, length, wanted)
        ends = np.zeros(len(wanted), dtype=bool)
        ends[[0, -1]] = True
        share = np.full(len(wanted), wanted[1] - wanted[0])
        share[[0, -1]] *= 0.5
        owner = np.full(len(wanted), number)
        parts.append((points, np.interp(wanted, length, size), owner, wanted, ends, share))
    return LineNodes(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def meeting_edges(nodes: LineNodes) -> Edges:
    """Join neighbours along a line, points that coincide, and line ends that lie inside another line's sphere."""
    along = np.flatnonzero((nodes.owner[:-1] == nodes.owner[1:]) & (np.diff(nodes.along) < STEP_MM))
    along = np.stack([along, along + 1], axis=1)
    tree = KDTree(nodes.points)
    near = tree.query_pairs(0.8 * STEP_MM, output_type="ndarray")
    near = near[_elsewhere(nodes, near[:, 0], near[:, 1], np.full(len(near), _OWN_MM))]
    inside = []
    for end in np.flatnonzero(nodes.ends):
        found = np.array(tree.query_ball_point(nodes.points[end], float(nodes.radius.max())), dtype=np.int64)
        gap = np.linalg.norm(nodes.points[found] - nodes.points[end], axis=1)
        reach = np.maximum(nodes.radius[found], nodes.radius[end])
        start = np.full(len(found), end)
        fits = (gap < reach) & _elsewhere(nodes, start, found, np.maximum(2 * np.pi * reach, _OWN_MM))
        if fits.any():
            inside.append((end, found[fits][gap[fits].argmin()]))
    meets = np.concatenate([near, np.array(inside, dtype=np.int64).reshape(-1, 2)])
    return Edges(
        np.concatenate([along, meets]),
        np.concatenate([_gap(nodes, along), 2 * _gap(nodes, meets) + 0.1]),
        len(nodes.points),
    )


def _elsewhere(
    nodes: LineNodes, one: Int[np.ndarray, "m"], two: Int[np.ndarray, "m"], apart: Float[np.ndarray, "m"]
) -> Bool[np.ndarray, "m"]:
    """Return which pairs are on different lines, or farther apart along their own than `apart`."""
    return (nodes.owner[one] != nodes.owner[two]) | (np.abs(nodes.along[one] - nodes.along[two]) > apart)


def bridges(nodes: LineNodes, edges: Edges) -> Int[np.ndarray, "m 2"]:
    """Return the shortest gaps, from line ends, that join pieces which lie within `LONGEST_BRIDGE` radii of each other.

    Each joins two pieces that nothing shorter joins.
    """
    piece = edges.pieces
    if piece.max() == 0:
        return np.empty((0, 2), dtype=np.int64)
    tree, found = KDTree(nodes.points), []
    for end in np.flatnonzero(nodes.ends):
        others = np.array(
            tree.query_ball_point(nodes.points[end], LONGEST_BRIDGE * float(nodes.radius.max())), dtype=np.int64
        )
        others = others[piece[others] != piece[end]]
        gap = np.linalg.norm(nodes.points[others] - nodes.points[end], axis=1)
        fits = gap <= LONGEST_BRIDGE * np.maximum(nodes.radius[others], nodes.radius[end])
        for other in np.unique(piece[others[fits]]):
            mine = others[fits & (piece[others] == other)]
            nearest = np.linalg.norm(nodes.points[mine] - nodes.points[end], axis=1)
            found.append((float(nearest.min()), int(end), int(mine[nearest.argmin()])))
    parent = np.arange(piece.max() + 1)

    def top(index: int) -> int:
        while parent[index] != index:
            index = int(parent[index])
        return index

    chosen = []
    for _, end, other in sorted(found):
        one, two = top(int(piece[end])), top(int(piece[other]))
        if one != two:
            parent[one] = two
            chosen.append((end, other))
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def with_bridges(nodes: LineNodes, edges: Edges, gaps: Int[np.ndarray, "m 2"]) -> Edges:
    """Return the edges with the gaps joined too."""
    if len(gaps) == 0:
        return edges
    cost = np.concatenate([edges.cost, 2 * _gap(nodes, gaps) + 0.1])
    return Edges(np.concatenate([edges.nodes, gaps]), cost, edges.count)


def _gap(nodes: LineNodes, pairs: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
    return np.linalg.norm(nodes.points[pairs[:, 0]] - nodes.points[pairs[:, 1]], axis=1)
