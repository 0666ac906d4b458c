"""The open ends of a coronary artery, and how the tree would look if the artery began at each of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from endopilot.anatomy.lumen_graph import lumen_graph, trace_branches

STUB_COVERAGE, STUB_SLENDERNESS, STUB_MM = 1.2, 1.0, 1.0
"""How little of a branch counts as an end: a left main may be as short as it is wide."""

_NEAR_MM = (1.5, 8.0)
"""The calibre of an end is that of the lumen between these distances from it."""

_HEADING_MM = (8.0, 16.0)
"""An artery's first heading is that from its end to where it is between these distances."""

_SMOOTH_MM = 1.5
_BEGUN_RADII = 2.0
"""Beyond this many of its radii from an end, a lumen's width is no longer that of its cap."""

_MAJOR_MM = 15.0
"""A branch with at least this much length behind it counts at the first fork."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The middle of one connected lumen as a graph without a root.

    Attributes:
        points: positions, LPS mm.
        radius: distance to the wall, mm, mean over the neighbourhood.
        edges: sparse matrix of the lengths between neighbours, mm; each pair stands in it once.
        tips: indices of the ends, stubs included.
        voxels: size of the lumen in grid points.
    """

    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    edges: Any
    tips: Int[np.ndarray, "t"]
    voxels: int

    @cached_property
    def length_mm(self) -> float:
        """Length of all branches together, mm."""
        return float(self.edges.sum())

    @cached_property
    def calibre_mm(self) -> float:
        """Radius that nine tenths of the skeleton stay below, mm."""
        return float(np.quantile(self.radius, 0.9))


@dataclass(frozen=True, eq=False)
class OpenEnd:
    """An end of a coronary artery, described as if the artery began there.

    Attributes:
        position: tip of the end, LPS mm.
        calibre: radius near the end over the artery's own.
        taper: rank correlation of the distance from the end and the radius, sign turned: 1 where the tree narrows
            throughout, −1 where it widens.
        widening: mean over the tree of ln(r / narrowest radius on the path from the end); 0 where no path widens.
        heading: unit vector from the end to where the vessel is 8 to 16 mm on.
        course: unit vector from the end to the tree's centre.
        opening_deg: angle between the two main branches at the first fork, degrees; 0 where nothing forks near.
        longest_mm: longest path from the end, mm.
    """

    position: Float[np.ndarray, "3"]
    calibre: float
    taper: float
    widening: float
    heading: Float[np.ndarray, "3"]
    course: Float[np.ndarray, "3"]
    opening_deg: float
    longest_mm: float


def skeleton_of(points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], spacing_mm: float) -> Skeleton:
    """Return the skeleton of one connected lumen, given as grid points with their distances to the wall, mm."""
    graph = lumen_graph(points, clearance, spacing_mm, int(clearance.argmax()))
    graph = lumen_graph(graph.points, graph.clearance, spacing_mm, int(graph.length.argmax()))
    paths = trace_branches(graph, minimum_length_mm=STUB_MM, coverage=STUB_COVERAGE, slenderness=STUB_SLENDERNESS)
    nodes = np.unique(np.concatenate(paths))
    number = np.full(len(graph.points), -1)
    number[nodes] = np.arange(len(nodes))
    start = number[np.concatenate([path[:-1] for path in paths])]
    end = number[np.concatenate([path[1:] for path in paths])]
    place = graph.points[nodes]
    edges = csr_matrix((np.linalg.norm(place[start] - place[end], axis=1), (start, end)), shape=(len(nodes),) * 2)
    around = KDTree(place).query_ball_point(place, _SMOOTH_MM)
    radius = np.array([graph.clearance[nodes[index]].mean() for index in around])
    tips = number[[paths[0][0], *(path[-1] for path in paths)]]
    return Skeleton(place, radius, edges, tips, len(graph.points))


def open_ends(skeleton: Skeleton) -> list[OpenEnd]:
    """Return every end of a skeleton, described as the root of its tree."""
    length, before = dijkstra(skeleton.edges, directed=False, indices=skeleton.tips, return_predecessors=True)
    trees = zip(skeleton.tips, length, before, strict=True)
    return [_described(skeleton, int(tip), own, back) for tip, own, back in trees]


def rank_correlation(one: Float[np.ndarray, "n"], other: Float[np.ndarray, "n"]) -> float:
    """Return Spearman's rank correlation of two series; equal values share their mean rank."""
    return float(np.corrcoef([_ranks(one), _ranks(other)])[0, 1])


def _ranks(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)  # scipy.stats is slow to import
    return (np.cumsum(count) - (count - 1) / 2)[place]


def _described(skeleton: Skeleton, tip: int, length: Float[np.ndarray, "n"], before: Int[np.ndarray, "n"]) -> OpenEnd:
    points, radius, position = skeleton.points, skeleton.radius, skeleton.points[tip]
    near = (length > _NEAR_MM[0]) & (length < _NEAR_MM[1])
    first = (length > _HEADING_MM[0]) & (length < _HEADING_MM[1])
    width = float(np.quantile(radius[near], 0.6)) if near.any() else 0.0
    begun = length >= _BEGUN_RADII * width
    narrowest = np.full(len(points), np.inf)
    for node in np.argsort(length):
        if begun[node]:
            narrowest[node] = min(radius[node], narrowest[before[node]] if before[node] >= 0 else np.inf)
    return OpenEnd(
        position=position,
        calibre=width / skeleton.calibre_mm,
        taper=-rank_correlation(length, radius) if np.ptp(radius) > 0 else 0.0,
        widening=float(np.mean(np.log(radius[begun] / narrowest[begun]))) if begun.any() else 0.0,
        heading=_unit((points[first] if first.any() else points).mean(axis=0) - position),
        course=_unit(points.mean(axis=0) - position),
        opening_deg=_opening(points, length, before),
        longest_mm=float(length.max()),
    )


def _opening(points: Float[np.ndarray, "n 3"], length: Float[np.ndarray, "n"], before: Int[np.ndarray, "n"]) -> float:
    """Return the angle between the two longest branches at the first fork within 16 mm of an end, degrees."""
    behind = length.copy()  # farthest length behind every node
    order = np.argsort(-length)
    for node in order:
        if before[node] >= 0:
            behind[before[node]] = max(behind[before[node]], behind[node])
    children: dict[int, list[int]] = {}
    for node in order:
        if before[node] >= 0 and behind[node] - length[node] >= _MAJOR_MM:
            children.setdefault(int(before[node]), []).append(int(node))
    forks = [node for node in children if len(children[node]) >= 2 and length[node] < _HEADING_MM[1]]
    if not forks:
        return 0.0
    fork = min(forks, key=lambda node: length[node])
    headings = []
    for child in sorted(children[fork], key=lambda node: -behind[node])[:2]:
        node = child
        while length[node] - length[fork] < _NEAR_MM[1]:
            node = max(children.get(node, [-1]), key=lambda other: behind[other])
            if node < 0:
                break
        headings.append(_unit(points[node] - points[fork]))
    return float(np.degrees(np.arccos(np.clip(headings[0] @ headings[1], -1.0, 1.0))))


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
