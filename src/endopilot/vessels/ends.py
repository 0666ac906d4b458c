"""The ends of a vessel: how a coronary tree would look if it began there, and which end looks most like an inlet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from endopilot.lines import length_along
from endopilot.vessels.graph import RootedGraph, VesselGraph, lumen_graph
from endopilot.vessels.surface import Surface

STUB_COVERAGE, STUB_SLENDERNESS, STUB_MM = 1.2, 1.0, 1.0  # a left main may be as short as it is wide
_NEAR_MM = (1.5, 8.0)  # the calibre of an end is that of the lumen between these distances from it
_HEADING_MM = (8.0, 16.0)  # an artery's first heading is that from its end to where it is between these distances

_SMOOTH_MM = 1.5
_BEGUN_RADII = 2.0  # beyond this many of its radii from an end, a lumen's width is no longer that of its cap
_MAJOR_MM = 15.0  # a branch with at least this much length behind it counts at the first fork
_BLIND = 0.6  # an end whose cap is as round as a sphere counts this share of one that is cut flat
_ROUND_CAP, _FLAT_CAP = 0.3, 0.7  # flat share of a section's cap: domes have 0.2 to 0.5, cuts 0.6 to 0.9
_NECK, _DOME = 1.3, 4.0  # an end this much wider than its neck, at most the second of its radii behind, is a dome

_LINE_ENDS, _NO_LINE = 0.5, 0.1
"""Lines run from the inlet, as VMTK writes them: one that ends at a place says this share of what one that begins there
says for it; a place where no line begins or ends is as little likely as the second."""


@dataclass(frozen=True, eq=False)
class Skeleton(VesselGraph):
    """The middle of one connected lumen with its `tips`; radii are means of the neighbourhood, costs lengths, mm."""

    tips: Int[np.ndarray, "t"]


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
        opening_deg: angle between the main branches at the first fork, degrees; 0 where nothing forks near.
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
    graph = lumen_graph(points, clearance, spacing_mm)
    paths = graph.traced(STUB_MM, coverage=STUB_COVERAGE, slenderness=STUB_SLENDERNESS)
    nodes = np.unique(np.concatenate(paths))
    start, end = np.searchsorted(nodes, np.concatenate([[path[:-1], path[1:]] for path in paths], axis=1))
    place = graph.points[nodes]
    costs = csr_matrix((np.linalg.norm(place[start] - place[end], axis=1), (start, end)), shape=(len(nodes),) * 2)
    around = KDTree(place).query_ball_point(place, _SMOOTH_MM)
    radius = np.array([graph.radius[nodes[index]].mean() for index in around])
    tips = np.searchsorted(nodes, [paths[0][0], *(path[-1] for path in paths)])
    return Skeleton(place, radius, costs, spacing_mm, tips)


def open_ends(skeleton: Skeleton) -> list[OpenEnd]:
    """Return every end of a skeleton, described as the root of its tree."""
    return [_described(skeleton.shortest(int(tip)), int(tip)) for tip in skeleton.tips]


def rank_correlation(one: Float[np.ndarray, "n"], other: Float[np.ndarray, "n"]) -> float:
    """Return Spearman's rank correlation of two series; equal values share their mean rank."""
    return float(np.corrcoef([_ranks(one), _ranks(other)])[0, 1])


def _ranks(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)  # scipy.stats is slow to import
    return (np.cumsum(count) - (count - 1) / 2)[place]


def _described(tree: RootedGraph, tip: int) -> OpenEnd:
    points, radius, length, before, position = tree.points, tree.radius, tree.length, tree.before, tree.points[tip]
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
        calibre=width / float(np.quantile(radius, 0.9)),
        taper=-rank_correlation(length, radius) if np.ptp(radius) > 0 else 0.0,
        widening=float(np.mean(np.log(radius[begun] / narrowest[begun]))) if begun.any() else 0.0,
        heading=_unit((points[first] if first.any() else points).mean(axis=0) - position),
        course=_unit(points.mean(axis=0) - position),
        opening_deg=_opening(tree),
        longest_mm=float(length.max()),
    )


def _opening(tree: RootedGraph) -> float:
    """Return the angle between the two longest branches at the first fork within 16 mm of the root, degrees."""
    points, length, before = tree.points, tree.length, tree.before
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


@dataclass(frozen=True, eq=False)
class InletEnd:
    """An end that a device may enter at: tip, its middle, and score, the radius, mm, less what speaks against it."""

    node: int
    position: Float[np.ndarray, "3"]
    score: float


def likely_inlets(
    tree: RootedGraph,
    paths: Sequence[Int[np.ndarray, "_"]],
    *,
    wall: Surface | None = None,
    lines: Sequence[Float[np.ndarray, "2 3"]] = (),
) -> list[InletEnd]:
    """Return the ends of a tree, likeliest inlet first: wide, the tree narrows from it, cut flat, lines begin there.

    An aneurysm's dome, an end that bulges behind a neck, counts as its neck does, less by how much it bulges; a cut
    that bulges is none. `paths` are those of `RootedGraph.traced`, `lines` first and last points of a file's lines.
    """
    middle = np.concatenate(paths)
    widths = tree.radius[middle]
    triangles = None if wall is None else wall.triangles()
    found = []
    for path in (paths[0][::-1], *paths):
        # A branch is followed on into what carries it.
        inwards = path[::-1] if path[-1] == paths[0][0] else tree.back(int(path[-1]))
        points, clearance = tree.points[inwards], tree.radius[inwards]
        place = min(len(path) - tree.before_cap(path), len(path) - 1)
        radius = float(np.median(clearance[place : place + 5]))
        widest, bulge, neck = _bulge(points, clearance, len(path))
        near = np.linalg.norm(np.reshape(lines, (-1, 2, 3)) - points[0], axis=2) <= max(radius, tree.step_mm)
        shared = len(lines) > 0 and near.any(axis=1).mean() >= 0.5  # half of the lines: a trunk, narrow as it forks
        dome, open_, middle_of_end = float(bulge > _NECK and not shared), 1.0, points[0]
        if triangles is not None:
            behind = points[min(place + 5, len(points) - 1)]
            axis = (points[place] - behind) / max(np.linalg.norm(points[place] - behind), 1e-9)
            middle_of_end = behind + max(float((points[0] - behind) @ axis), 0.0) * axis  # the tip lies in the rim
            whole = min(int(np.searchsorted(length_along(points), radius)), place)
            at, width = (widest, clearance[widest]) if dome else (whole, radius)
            flat = _flatness(points, int(at), float(width), triangles)
            cut = float(np.clip((flat - _ROUND_CAP) / (_FLAT_CAP - _ROUND_CAP), 0.0, 1.0))
            dome, open_ = dome * (1.0 - cut), _BLIND + (1.0 - _BLIND) * cut
        score = open_ * ((1.0 - dome) * radius + dome * min(radius, neck / bulge))
        away = np.linalg.norm(tree.points[middle] - points[0], axis=1)
        score *= 0.6 - 0.4 * (rank_correlation(away, widths) if np.ptp(widths) > 0 else 0.0)
        if lines:
            score *= max(float(np.where(near[:, 0], 1.0, _LINE_ENDS * near[:, 1]).mean()), _NO_LINE)
        found.append(InletEnd(int(path[-1]), middle_of_end, float(score)))
    return sorted(found, key=lambda end: -end.score)


def _bulge(points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], own: int) -> tuple[int, float, float]:
    """Return where a vessel, followed inwards, is widest against the neck behind: index, ratio, neck."""
    length = length_along(points)
    best = (0, 1.0, float(clearance[0]))
    for i in np.flatnonzero((length[:own] <= _DOME * clearance[:own]) & (clearance[:own] > 0)):
        behind = slice(int(i), int(np.searchsorted(length, length[i] + _DOME * clearance[i])) + 1)
        neck = float(clearance[behind].min())
        if clearance[i] > best[1] * neck:
            best = (int(i), float(clearance[i]) / neck, neck)
    return best


def _flatness(
    points: Float[np.ndarray, "n 3"], place: int, width: float, triangles: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> float:
    """Return the area of the flattest part of the wall that closes an end, over that of the vessel's section: 1 or more
    for a vessel cut straight or aslant, 0.12 for a dome. The points, mm, lead inwards from the tip, to the whole width
    at `place`, radius mm; the triangles are the wall's centres, normals and areas."""
    centres, normals, areas = triangles
    back = int(np.searchsorted(length_along(points[place:]), 1.5 * width))
    axis = points[place] - points[min(place + max(back, 1), len(points) - 1)]
    near = np.flatnonzero(np.linalg.norm(centres - points[place], axis=1) < 2.0 * width)
    near = near[normals[near] @ axis > 0.5 * np.linalg.norm(axis)]
    normals, areas = normals[near], areas[near]
    some = normals[:: max(1, len(near) // 64)]
    return float(((some @ normals.T > np.cos(np.radians(20.0))) @ areas).max(initial=0.0)) / (np.pi * width**2)
