"""Centerlines as a vessel graph, and the lines of one tree in it: joined along lines, where they meet, over small gaps.
Lines may overlap, as VMTK writes them, or meet end to end, as Slicer does; the tree is traced as in a lumen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from endopilot.errors import InputError, place_text
from endopilot.lines import length_along, places_on
from endopilot.types import Insertion
from endopilot.vessels.ends import likely_inlets
from endopilot.vessels.graph import Line, VesselGraph, pieces, split
from endopilot.vessels.remarks import longest_first
from endopilot.vessels.sources import Polylines

STEP_MM = 0.5  # distance between the points of the tree, mm
LONGEST_BRIDGE = 4.0  # lines that end within this many radii of another are joined to it; the gap is noted
PARENT_VESSEL_RATIO = 2.5  # lines that start in spheres so much wider than their median start in a parent vessel
_OPPOSITE = -0.5  # cosine of two directions from which on a vessel passes a place rather than forks there
_OWN_MM = 2.0  # a line comes back to a place where coinciding points lie farther apart along it than this, mm

_SHORTEST_MM = 2.0

_RIVAL = 0.4  # lines that are not connected to a piece this share as long are another artery's


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
    """The lines of one tree in centerlines, the rule that chose its root, notes on what was done and left out, and the
    balance of `_left_out`."""

    lines: list[Line]
    rule: str
    notes: list[str]
    coverage: dict[str, float]


def found_lines(source: Polylines, given: Insertion | None, label: str, vessel: str = "generic") -> FoundLines:
    """Return the lines of one tree in centerlines with radii, LPS mm, cut where they leave a parent vessel that they
    start in (VMTK's: the aorta). Raises InputError where no line is near the given ostium, or a coronary artery is
    asked for and the lines are those of two."""
    source, notes = _without_repeats(source, label)
    whole = line_graph(source)
    keep, cut_at = _outside_parent_vessel(whole)
    graph = _meeting(whole.outside(keep))
    gaps = _bridges(graph)
    bridged = graph.lengths(gaps)
    notes += [
        f"a gap of {gap:.1f} mm between lines at {place_text(graph.points[end])} is bridged"
        for gap, end in zip(bridged, gaps[:, 0], strict=True)
    ]
    graph = graph.met(gaps)
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
        tree = graph.shortest(_widest_end(graph, vessel, label))
        ends = [line[[0, -1]] for line in source.points]
        root, rule = likely_inlets(tree, tree.traced(_SHORTEST_MM, together=True), lines=ends)[0].node, "widest end"
    lines = _lines(graph.points, graph.radius, graph.shortest(root).traced(_SHORTEST_MM, together=True))
    piece = np.full(len(keep), -1)
    piece[keep] = graph.pieces
    lost, balance = _left_out(whole, lines, piece, int(graph.pieces[root]))
    return FoundLines(lines, rule, notes + lost, {**balance, "bridged_mm": round(float(bridged.sum()), 1)})


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
    within = big.copy()
    for found in KDTree(points).query_ball_point(points[spheres], radius[spheres]):
        within[found] = True
    keep, first_kept = everywhere.copy(), list[int]()
    for own in split(np.arange(len(points)), owner):
        inside = np.flatnonzero(within[own])
        leave = int(inside[-1]) + 1 if len(inside) else 0
        keep[own[:leave]] = False
        first_kept += own[leave : leave + 1].tolist()
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


def _without_repeats(source: Polylines, label: str) -> tuple[Polylines, list[str]]:
    """Return lines that repeat no point in succession, and notes on those left out, or too coarse for their radii."""
    points, radii, notes = [], [], []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        name = source.name(number)
        distinct = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])
        line, size = line[distinct], size[distinct]
        if len(line) < 2:
            notes.append(f"{name}: all its points coincide at {place_text(line[0])}: left out")
            continue
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        apart = step > size[1:] + size[:-1]
        if apart.any():
            notes.append(
                f"{name}: the spheres of {apart.sum()} neighbouring points do not touch (the longest step, "
                f"{step.max():.1f} mm, is at {place_text(line[step.argmax()])}): joined by straight pieces"
            )
        points.append(line)
        radii.append(size)
    if not points:
        raise InputError(f"{label}: holds no line of at least two distinct points; export the centerline again")
    return Polylines(tuple(points), tuple(radii)), notes


def _left_out(
    whole: LineGraph, lines: list[Line], piece: Int[np.ndarray, "n"], own: int
) -> tuple[list[str], dict[str, float]]:
    """Return a note on each stretch of line outside the spheres of a tree's lines, and the balance: `length_mm` in all
    is `reached_mm` by the spheres, and `left_out_mm`. `piece` is -1 in the parent vessel, and `own` in the tree."""
    radius = np.concatenate([line.radius for line in lines])
    gap, nearest = map(np.asarray, KDTree(np.concatenate([line.points for line in lines])).query(whole.points))
    inside = gap <= np.maximum(radius[nearest], STEP_MM)
    total, reached = float(whole.share.sum()), float(whole.share[inside].sum())
    balance = {"length_mm": total, "reached_mm": reached, "left_out_mm": total - reached}
    lost = np.flatnonzero(~inside)
    near = KDTree(whole.points[lost]).query_pairs(2 * STEP_MM, output_type="ndarray")
    near = near[np.diff(piece[lost[near]] < 0, axis=1)[:, 0] == 0]
    found = []
    for part in split(lost, pieces(near, len(lost))) if len(lost) else []:
        length = float(np.bincount(whole.owner[part], whole.share[part]).max())  # of lines that run together one counts
        if piece[part[0]] < 0:
            why = "it lies in the parent vessel that the lines start in"
        elif piece[part].max() != own:
            why = f"no line leads there; the nearest is {gap[part].min():.1f} mm away"
        else:
            why = "it is no longer than the vessel it leaves is wide"
        place = place_text(whole.points[part[gap[part].argmax()]])
        found.append((length, f"{length:.1f} mm of line at {place} is left out: {why}"))
    notes = longest_first(found, "{} more stretches, {:.1f} mm of line together, are left out")
    return notes, {name: round(length, 1) for name, length in balance.items()}
