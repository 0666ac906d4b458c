"""One tree from centerlines that overlap, as VMTK writes them, or that meet end to end, as Slicer writes them.

Lines are resampled and their points made the nodes of a graph (`line_graph`). The tree is then traced as in a lumen:
farthest end first, each further line from where it leaves what is there. What the tree does not reach is noted with
its length and place, and so are gaps that were bridged, loops that were cut and further inlets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, dijkstra, minimum_spanning_tree
from scipy.spatial import KDTree

from endopilot.anatomy.line_checks import closures, left_out
from endopilot.anatomy.line_ends import InletEnd, likely_inlets
from endopilot.anatomy.line_graph import (
    STEP_MM,
    Edges,
    LineNodes,
    bridges,
    dense_nodes,
    meeting_edges,
    with_bridges,
)
from endopilot.anatomy.lumen_graph import LumenGraph
from endopilot.anatomy.sources import Polylines
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.errors import InputError, place_text
from endopilot.lines import length_along, places_on
from endopilot.types import Insertion, VesselTree

PARENT_VESSEL_RATIO = 2.5
"""Where lines start in spheres this many times wider than their own median, they start in a parent vessel."""

TOGETHER = 0.5
"""Lines nearer each other than this share of the local radius run together and become one."""

_SHORTEST_MM = 2.0

_RIVAL = 0.4
"""A coronary artery's lines that are not connected to a piece this share as long are those of another artery."""

_NEIGHBOURS = 6
"""Points of a line are compared with this many nearest ones."""

_DISORDER = 2.0
"""A line this many times as long as the shortest tree through its points is in no order."""

_JUMP_STEPS, _JUMP_RADII = 8.0, 5.0
"""A step of more than this many usual ones, and of both radii this many times, leads to another vessel."""


@dataclass(frozen=True, eq=False)
class LineTree:
    """One tree from centerlines, and what became of the lines.

    Attributes:
        tree: the tree.
        rule: by which its root was chosen.
        notes: what was done and left out, a sentence each.
        coverage: `length_mm` of the lines, of them `reached_mm` by the tree's spheres and `left_out_mm` (these two add
            up to the first), and `bridged_mm` of gaps between them.
    """

    tree: VesselTree
    rule: str
    notes: list[str]
    coverage: dict[str, float]


def tree_from_polylines(
    source: Polylines | VesselTree, given: Insertion | None, label: str, vessel: str = "generic"
) -> LineTree:
    """Return one tree from centerlines.

    Where the lines start in a parent vessel (VMTK's coronary centerlines start in the aorta), they are cut at the
    ostium: where they leave the parent's spheres.

    Args:
        source: centerlines with radii, LPS mm.
        given: the ostium, if it is known.
        label: name of the source, for messages.
        vessel: "rca", "lca" or "generic".

    Raises:
        InputError: the points of a line are in no order, no line is near the given ostium, or a coronary artery is
            asked for and the lines are those of two.
    """
    if isinstance(source, VesselTree):
        lines = [branch.centerline for branch in source.branches]
        source = Polylines(tuple(line.points for line in lines), tuple(line.radius for line in lines))
    source, notes = in_order(source, label)
    whole = dense_nodes(source)
    keep, cut_at = _outside_parent_vessel(whole)
    nodes = whole.part(keep)
    edges = meeting_edges(nodes)
    gaps = bridges(nodes, edges)
    bridged = np.linalg.norm(nodes.points[gaps[:, 0]] - nodes.points[gaps[:, 1]], axis=1)
    notes += [
        f"a gap of {gap:.1f} mm between lines at {place_text(nodes.points[end])} is bridged"
        for gap, end in zip(bridged, gaps[:, 0], strict=True)
    ]
    edges = with_bridges(nodes, edges, gaps)
    piece, rivals = edges.pieces, list[str]()
    if given is not None:
        gap = np.linalg.norm(nodes.points - given.position, axis=1)
        root, rule = int(gap.argmin()), "given"
        if gap[root] > max(5.0, 2 * nodes.radius[root]):
            raise InputError(
                f"{label}: the ostium at {np.round(given.position, 1).tolist()} mm is {gap[root]:.1f} mm from the "
                "nearest centerline; check the coordinates (LPS mm)"
            )
    elif cut_at is not None:
        gap = np.linalg.norm(nodes.points - cut_at, axis=1)
        root, rule = int(gap.argmin()), "where the lines leave the parent vessel"
    else:
        first, *others = _inlets(source, nodes, edges, _widest_end(nodes, piece, vessel, label))
        root, rule, rivals = first.node, "widest end", first.rivals(others)
    paths = _trace(nodes, edges, root)
    tree = tree_from_lines(_lines(nodes.points, nodes.radius, paths))
    lost, covered = left_out(whole, keep, tree, piece, int(piece[root]))
    total = float(whole.share.sum())
    balance = {"length": total, "reached": covered, "left_out": total - covered, "bridged": float(bridged.sum())}
    notes += [*lost, *closures(tree), *rivals]
    return LineTree(tree, rule, notes, {f"{name}_mm": round(value, 1) for name, value in balance.items()})


def _outside_parent_vessel(nodes: LineNodes) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "3"] | None]:
    """Return which points lie outside the parent vessel that the lines start in, and where they leave it.

    The parent's spheres are those at the lines' common start that are several times wider than the lines' median.
    """
    points, radius, owner = nodes.points, nodes.radius, nodes.owner
    everywhere = np.ones(len(points), dtype=bool)
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    usual = float(np.median(radius))
    common = np.linalg.norm(points[starts] - points[starts[0]], axis=1).max() < radius[starts[0]]
    if radius[starts[0]] < PARENT_VESSEL_RATIO * usual or not common:
        return everywhere, None
    big = radius > PARENT_VESSEL_RATIO * usual
    spheres = np.flatnonzero(big)
    # Lines that overlap repeat the parent's spheres: one in each cell of the step is enough.
    spheres = spheres[np.unique(np.floor(points[spheres] / STEP_MM), axis=0, return_index=True)[1]]
    within = np.zeros(len(points), dtype=bool)
    for found in KDTree(points).query_ball_point(points[spheres], radius[spheres]):
        within[found] = True
    keep = everywhere.copy()
    first_kept = []
    for start, end in zip(starts, [*starts[1:], len(points)], strict=True):
        inside = np.flatnonzero(within[start:end] | big[start:end])
        leave = int(inside[-1]) + 1 if len(inside) else 0
        keep[start : start + leave] = False
        if start + leave < end:
            first_kept.append(start + leave)
    if not first_kept:
        return everywhere, None
    return keep, points[first_kept].mean(axis=0) if _close(points[first_kept]) else points[first_kept[0]]


def _close(points: Float[np.ndarray, "n 3"]) -> bool:
    return bool(np.ptp(points, axis=0).max() < 2.0)


def _widest_end(nodes: LineNodes, piece: Int[np.ndarray, "n"], vessel: str, label: str) -> int:
    """Return the widest line end of the longest connected piece."""
    # Lines that overlap count once: lengths are those of the cells of 1 mm that they pass through.
    cells = np.unique(np.column_stack([np.floor(nodes.points), piece]), axis=0)
    length = np.bincount(cells[:, 3].astype(np.int64), minlength=int(piece.max()) + 1)
    index = nodes.free_ends()
    widest = {number: index[piece[index] == number] for number in np.argsort(-length, kind="stable")[:2]}
    roots = [int(ends[nodes.radius[ends].argmax()]) for ends in widest.values()]
    rival = len(roots) > 1 and length[piece[roots[1]]] > _RIVAL * length[piece[roots[0]]]
    if rival and vessel != "generic":
        one, two = (place_text(nodes.points[root]) for root in roots)
        raise InputError(
            f"{label}: holds two trees that are not connected, with their widest ends at {one} and {two} (LPS); "
            "name the ostium of one with --ostium-mm"
        )
    return roots[0]


def _inlets(source: Polylines, nodes: LineNodes, edges: Edges, end: int) -> list[InletEnd]:
    """Return the ends of the piece that a node is an end of, the one that looks most like the inlet first."""
    length, before = dijkstra(edges.matrix, directed=False, indices=end, return_predecessors=True)
    tree = LumenGraph(nodes.points, nodes.radius, before, length, 0.5 * STEP_MM, edges.matrix)
    return likely_inlets(tree, _trace(nodes, edges, end), lines=[line[[0, -1]] for line in source.points])


def _trace(nodes: LineNodes, edges: Edges, root: int) -> list[Int[np.ndarray, "_"]]:
    """Return the tree as paths of nodes, the first from the root, each other from a node of an earlier one."""
    points, radius = nodes.points, nodes.radius
    places = KDTree(points)
    distance, before = dijkstra(edges.matrix, directed=False, indices=root, return_predecessors=True)
    covered = ~np.isfinite(distance)
    paths: list[np.ndarray] = []
    for tip in np.argsort(-np.where(covered, -1.0, distance), kind="stable"):
        if covered[tip]:
            continue
        path = [int(tip)]
        while before[path[-1]] >= 0 and not covered[path[-1]]:
            path.append(int(before[path[-1]]))
        found = np.array(path[::-1])
        new = float(distance[found[-1]] - distance[found[0]])
        if not paths or new > max(_SHORTEST_MM, float(radius[found[0]])):
            paths.append(found)
        for reached in places.query_ball_point(points[found], np.maximum(TOGETHER * radius[found], STEP_MM)):
            covered[reached] = True
    return paths


def _lines(
    points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], paths: list[Int[np.ndarray, "_"]]
) -> list[Line]:
    """Return the paths as lines, each joined to the earlier line that its start runs together with."""
    lines: list[Line] = []
    for nodes in paths:
        line, size = points[nodes], radius[nodes]
        parent, place = -1, 0
        if lines:
            parent = int(np.argmin([np.linalg.norm(other.points - line[0], axis=1).min() for other in lines]))
            host = lines[parent]
            gap = np.linalg.norm(host.points - line[0], axis=1)
            nearest = int(gap.argmin())
            upstream = round(2.0 * float(gap[nearest]) / STEP_MM)  # meet at about 30°, not at a right angle
            place = int(np.clip(nearest - upstream, 1, len(gap) - 2))
            line = np.concatenate([host.points[place : place + 1], line])
            size = np.concatenate([host.radius[place : place + 1], size])
        line, size = _resampled(line, size)
        lines.append(Line(line, size, parent, place))
    return lines


def _resampled(
    points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    length = length_along(points)
    distinct = np.concatenate([[True], np.diff(length) > 1e-9])
    wanted = np.linspace(0.0, length[-1], max(3, round(length[-1] / STEP_MM) + 1))
    line = places_on(points[distinct], length[distinct], wanted)
    return line, np.interp(wanted, length[distinct], radius[distinct])


def in_order(source: Polylines, label: str) -> tuple[Polylines, list[str]]:
    """Return lines that follow their vessels, and what was done, a sentence each.

    Points that repeat are dropped. Points in another order than along the vessel are sorted where only one order is the
    shortest. Where neighbouring spheres do not touch, a line is joined by a straight piece, or cut if it jumps to
    another vessel.

    Args:
        source: lines as read, mm.
        label: name of the source, for messages.

    Raises:
        InputError: the points of a line are in no order.
    """
    points, radii, notes = [], [], []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        name = source.name(number)
        distinct = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])
        line, size = line[distinct], size[distinct]
        if len(line) < 2:
            notes.append(f"{name}: all its points coincide at {place_text(line[0])}: left out")
            continue
        order = _order(line, f"{label}: {name}")
        if order is not None:
            before, after = _length(line), _length(line[order])
            line, size = line[order], size[order]
            notes.append(
                f"{name}: its points were in another order than along the vessel, and are sorted "
                f"({before:.0f} mm became {after:.0f} mm)"
            )
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        reach = size[1:] + size[:-1]
        apart = step > reach
        jump = apart & (step > _JUMP_RADII * reach) & (step > _JUMP_STEPS * np.median(step))
        notes += [f"{name} jumps by {step[i]:.1f} mm at {place_text(line[i])}: cut there" for i in np.flatnonzero(jump)]
        coarse = np.flatnonzero(apart & ~jump)
        if len(coarse):
            longest = int(coarse[step[coarse].argmax()])
            notes.append(
                f"{name}: the spheres of {len(coarse)} neighbouring points do not touch (the longest step, "
                f"{step[longest]:.1f} mm, is at {place_text(line[longest])}): joined by straight pieces of "
                f"{step[coarse].sum():.1f} mm in all"
            )
        for part in np.split(np.arange(len(line)), np.flatnonzero(jump) + 1):
            if len(part) > 1:
                points.append(line[part])
                radii.append(size[part])
            else:
                notes.append(f"{name}: the single point at {place_text(line[part[0]])} is left out")
    if not points:
        raise InputError(f"{label}: holds no line of at least two distinct points; export the centerline again")
    return Polylines(tuple(points), tuple(radii)), notes


def _order(line: Float[np.ndarray, "n 3"], label: str) -> Int[np.ndarray, "n"] | None:
    """Return the order of points along the vessel where it is another than they are in, or None where it is not.

    The shortest tree through the points, where it has no fork, is the order along a vessel.
    """
    count = len(line)
    if count < 4:
        return None
    near = np.asarray(KDTree(line).query(line, k=min(_NEIGHBOURS, count - 1) + 1)[1])
    rows = np.concatenate([np.repeat(np.arange(count), near.shape[1]), np.arange(count - 1)])
    columns = np.concatenate([near.ravel(), np.arange(1, count)])
    pairs = np.unique(np.sort(np.stack([rows, columns], axis=1)[rows != columns], axis=1), axis=0)
    gap = np.linalg.norm(line[pairs[:, 0]] - line[pairs[:, 1]], axis=1) + 1e-9
    shortest = minimum_spanning_tree(csr_matrix((gap, (pairs[:, 0], pairs[:, 1])), shape=(count, count))).tocoo()
    given, least = _length(line), float(shortest.data.sum())
    if given < least + 1.5 * float(np.median(shortest.data)):
        return None
    degree = np.bincount(np.concatenate([shortest.row, shortest.col]), minlength=count)
    turns = _turns(line)
    if degree.max() <= 2:
        order = breadth_first_order(shortest.tocsr(), int(np.flatnonzero(degree == 1)[0]), directed=False)[0]
        order = order if order[0] < order[-1] else order[::-1]
        if turns > _turns(line[order]):
            return order
    elif given > _DISORDER * least and turns > max(3, count // 4):
        raise InputError(
            f"{label}: its points are not in order along a vessel (they turn back {turns} times; {given:.0f} mm as "
            f"they stand, {least:.0f} mm from each to its nearest); sort them along the vessel"
        )
    return None


def _turns(line: Float[np.ndarray, "n 3"]) -> int:
    """Return at how many points a line turns by more than 90°."""
    step = np.diff(line, axis=0)
    return int((np.einsum("ij,ij->i", step[1:], step[:-1]) < 0).sum())


def _length(line: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
