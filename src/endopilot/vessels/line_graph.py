"""Centerlines as a vessel graph, and the lines of one tree in it: joined along lines, where they meet, over small gaps.
Lines may overlap, as VMTK writes them, or meet end to end, as Slicer does; the tree is traced as in a lumen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, dijkstra, minimum_spanning_tree
from scipy.spatial import KDTree

from endopilot.errors import InputError, place_text
from endopilot.lines import length_along, places_on
from endopilot.types import Insertion
from endopilot.vessels.ends import likely_inlets
from endopilot.vessels.graph import Line, RootedGraph, VesselGraph
from endopilot.vessels.sources import Polylines

STEP_MM = 0.5  # distance between the points of the tree, mm
LONGEST_BRIDGE = 4.0  # lines that end within this many radii of another are joined to it; the gap is noted
PARENT_VESSEL_RATIO = 2.5  # lines that start in spheres so much wider than their median start in a parent vessel
_OPPOSITE = -0.5  # cosine of two directions from which on a vessel passes a place rather than forks there
_OWN_MM = 2.0  # a line comes back to a place where coinciding points lie farther apart along it than this, mm

_SHORTEST_MM = 2.0

_RIVAL = 0.4  # lines that are not connected to a piece this share as long are another artery's
_NEIGHBOURS = 6  # points of a line are compared with this many nearest ones
_DISORDER = 2.0  # a line this many times as long as the shortest tree through its points is in no order
_JUMP_STEPS, _JUMP_RADII = 8.0, 5.0  # a step of more usual ones, and radii, leads to another vessel


@dataclass(frozen=True, eq=False)
class LineGraph(VesselGraph):
    """Points of all lines, twice as dense as the tree's; a way costs its length, more where it changes lines. Points
    have an `owner` line, `along` mm from its start, and stand for a `share` of it, mm."""

    columns = ("points", "radius", "owner", "along", "ends", "share")
    owner: Int[np.ndarray, "n"]
    along: Float[np.ndarray, "n"]
    ends: Bool[np.ndarray, "n"]
    share: Float[np.ndarray, "n"]

    def outside(self, keep: Bool[np.ndarray, "n"]) -> LineGraph:
        """Return some of the points; where a line is cut it has an end."""
        part = self.part(keep)
        cut = (np.diff(part.owner) != 0) | (np.diff(part.along) > STEP_MM)
        return replace(part, ends=np.concatenate([[True], cut]) | np.concatenate([cut, [True]]))

    def free_ends(self) -> Int[np.ndarray, "e"]:
        """Return the ends that no vessel passes (all near lies on one side), or all if there is no such."""
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

    def around_ends(self, radii: float) -> Iterator[tuple[int, Int[np.ndarray, "m"], Float[np.ndarray, "m"]]]:
        """Yield each end with the points at most so many of the wider radius away, and how far they are, mm."""
        tree = KDTree(self.points)
        for end in np.flatnonzero(self.ends):
            near = np.array(tree.query_ball_point(self.points[end], radii * float(self.radius.max())), dtype=np.int64)
            gap = np.linalg.norm(self.points[near] - self.points[end], axis=1)
            fits = gap <= radii * np.maximum(self.radius[near], self.radius[end])
            yield int(end), near[fits], gap[fits]

    def elsewhere(
        self, one: Int[np.ndarray, "m"], two: Int[np.ndarray, "m"], apart: Float[np.ndarray, "m"] | float
    ) -> Bool[np.ndarray, "m"]:
        """Return which pairs are on different lines, or farther apart along their own than `apart`."""
        return (self.owner[one] != self.owner[two]) | (np.abs(self.along[one] - self.along[two]) > apart)

    def met(self, pairs: Int[np.ndarray, "m 2"]) -> LineGraph:
        """Return the graph with points of different lines joined."""
        return self.joined(pairs, 2 * self.lengths(pairs) + 0.1)


@dataclass(frozen=True, eq=False)
class FoundLines:
    """The lines of one tree in centerlines, and what became of the others.

    Attributes:
        rule: by which the root was chosen.
        rivals: a note on other ends that may be the inlet.
        whole: all lines as given.
        piece: connected piece of each point of `whole`, -1 in the parent vessel that the lines start in.
        own: the piece that the tree was made from.
        bridged_mm: length of gaps that were bridged, mm.
    """

    lines: list[Line]
    rule: str
    notes: list[str]
    rivals: list[str]
    whole: LineGraph
    piece: Int[np.ndarray, "n"]
    own: int
    bridged_mm: float


def found_lines(source: Polylines, given: Insertion | None, label: str, vessel: str = "generic") -> FoundLines:
    """Return the lines of one tree in centerlines with radii, LPS mm, cut where they leave a parent vessel that they
    start in (VMTK's: the aorta). Raises InputError where a line's points are in no order, no line is near the given
    ostium, or a coronary artery is asked for and the lines are those of two."""
    source, notes = in_order(source, label)
    whole = line_graph(source)
    keep, cut_at = _outside_parent_vessel(whole)
    graph = _meeting(whole.outside(keep))
    gaps = _bridges(graph)
    bridged = graph.lengths(gaps)
    notes += [
        f"a gap of {gap:.1f} mm between lines at {place_text(graph.points[end])} is bridged"
        for gap, end in zip(bridged, gaps[:, 0], strict=True)
    ]
    graph, rivals = graph.met(gaps), list[str]()
    goal = cut_at if given is None else given.position
    if goal is not None:
        gap = np.linalg.norm(graph.points - goal, axis=1)
        root, rule = int(gap.argmin()), "given" if given else "where the lines leave the parent vessel"
        if given is not None and gap[root] > max(5.0, 2 * graph.radius[root]):
            raise InputError(
                f"{label}: the ostium at {np.round(goal, 1).tolist()} mm is {gap[root]:.1f} mm from the nearest "
                "centerline; check the coordinates (LPS mm)"
            )
    else:
        tree = _rooted(graph, _widest_end(graph, vessel, label))
        ends = [line[[0, -1]] for line in source.points]
        first, *others = likely_inlets(tree, tree.traced(_SHORTEST_MM, together=True), lines=ends)
        root, rule, rivals = first.node, "widest end", first.rivals(others)
    paths = _rooted(graph, root).traced(_SHORTEST_MM, together=True)
    piece = np.full(len(keep), -1)
    piece[keep] = graph.pieces
    lines = _lines(graph.points, graph.radius, paths)
    return FoundLines(lines, rule, notes, rivals, whole, piece, int(graph.pieces[root]), float(bridged.sum()))


def _rooted(graph: LineGraph, root: int) -> RootedGraph:
    length, before = dijkstra(graph.costs, directed=False, indices=root, return_predecessors=True)
    return RootedGraph(graph.points, graph.radius, graph.costs, graph.step_mm, before, length)


def line_graph(source: Polylines) -> LineGraph:
    """Return the points of lines, about `STEP_MM` / 2 apart, joined along them; lines repeat no point in succession."""
    parts = []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        length = length_along(line)
        wanted = np.linspace(0.0, length[-1], max(2, round(length[-1] / (0.5 * STEP_MM)) + 1))
        ends = np.zeros(len(wanted), dtype=bool)
        ends[[0, -1]] = True
        share = np.where(ends, 0.5, 1.0) * (wanted[1] - wanted[0])
        owner = np.full(len(wanted), number)
        parts.append((places_on(line, length, wanted), np.interp(wanted, length, size), owner, wanted, ends, share))
    points, radius, *rest = (np.concatenate(values) for values in zip(*parts, strict=True))
    along = np.flatnonzero(np.diff(rest[0]) == 0)
    graph = LineGraph(points, radius, csr_matrix((len(points),) * 2), 0.5 * STEP_MM, *rest)
    pairs = np.column_stack([along, along + 1])
    return graph.joined(pairs, graph.lengths(pairs))


def _meeting(graph: LineGraph) -> LineGraph:
    """Join points that coincide, and line ends that lie inside another line's sphere."""
    near = KDTree(graph.points).query_pairs(0.8 * STEP_MM, output_type="ndarray")
    meets = [near[graph.elsewhere(near[:, 0], near[:, 1], _OWN_MM)]]
    for end, found, gap in graph.around_ends(1.0):
        reach = np.maximum(graph.radius[found], graph.radius[end])
        fits = graph.elsewhere(np.full(len(found), end), found, np.maximum(2 * np.pi * reach, _OWN_MM))
        if fits.any():
            meets.append(np.array([[end, found[fits][gap[fits].argmin()]]]))
    return graph.met(np.concatenate(meets))


def _bridges(graph: LineGraph) -> Int[np.ndarray, "m 2"]:
    """Return the shortest gaps between ends of pieces within `LONGEST_BRIDGE` radii that are not joined yet."""
    piece, found = graph.pieces, list[tuple[float, int, int]]()
    for end, near, gap in graph.around_ends(LONGEST_BRIDGE) if piece.max() > 0 else ():
        for other in np.setdiff1d(piece[near], piece[end]):
            mine = np.flatnonzero(piece[near] == other)
            nearest = mine[gap[mine].argmin()]
            found.append((float(gap[nearest]), end, int(near[nearest])))
    joined = DisjointSet(range(int(piece.max()) + 1))
    chosen = [(end, other) for _, end, other in sorted(found) if joined.merge(int(piece[end]), int(piece[other]))]
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def _outside_parent_vessel(graph: LineGraph) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "3"] | None]:
    """Return which points lie outside the parent that the lines start in, by its far wider spheres there, and where."""
    points, radius, owner = graph.points, graph.radius, graph.owner
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
    close = np.ptp(points[first_kept], axis=0).max() < 2.0
    return keep, points[first_kept].mean(axis=0) if close else points[first_kept[0]]


def _widest_end(graph: LineGraph, vessel: str, label: str) -> int:
    """Return the widest line end of the longest connected piece."""
    piece = graph.pieces
    # Lines that overlap count once: lengths are those of the cells of 1 mm that they pass through.
    cells = np.unique(np.column_stack([np.floor(graph.points), piece]), axis=0)
    length = np.bincount(cells[:, 3].astype(np.int64), minlength=int(piece.max()) + 1)
    index = graph.free_ends()
    widest = {number: index[piece[index] == number] for number in np.argsort(-length, kind="stable")[:2]}
    roots = [int(ends[graph.radius[ends].argmax()]) for ends in widest.values()]
    rival = len(roots) > 1 and length[piece[roots[1]]] > _RIVAL * length[piece[roots[0]]]
    if rival and vessel != "generic":
        one, two = (place_text(graph.points[root]) for root in roots)
        raise InputError(
            f"{label}: holds two trees that are not connected, with their widest ends at {one} and {two} (LPS); "
            "name the ostium of one with --ostium-mm"
        )
    return roots[0]


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
    """Return lines that follow their vessels, and what was done: repeated points dropped, points sorted where only one
    order is the shortest, gaps closed by straight pieces, jumps to another vessel cut. Raises InputError for points in
    no order."""
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
            before, after = length_along(line)[-1], length_along(line[order])[-1]
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
    """Return points' order along the vessel if it is another: the shortest tree through them, if it has no fork."""
    count = len(line)
    if count < 4:
        return None
    near = np.asarray(KDTree(line).query(line, k=min(_NEIGHBOURS, count - 1) + 1)[1])
    rows = np.concatenate([np.repeat(np.arange(count), near.shape[1]), np.arange(count - 1)])
    columns = np.concatenate([near.ravel(), np.arange(1, count)])
    pairs = np.unique(np.sort(np.stack([rows, columns], axis=1)[rows != columns], axis=1), axis=0)
    gap = np.linalg.norm(line[pairs[:, 0]] - line[pairs[:, 1]], axis=1) + 1e-9
    shortest = minimum_spanning_tree(csr_matrix((gap, (pairs[:, 0], pairs[:, 1])), shape=(count, count))).tocoo()
    given, least = length_along(line)[-1], float(shortest.data.sum())
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
    step = np.diff(line, axis=0)
    return int((np.einsum("ij,ij->i", step[1:], step[:-1]) < 0).sum())
