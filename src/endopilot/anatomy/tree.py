"""Building a `VesselTree` from single lines, what it does not show of them, and the differential geometry of a line."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from endopilot.errors import place_text
from endopilot.lines import length_along, places_on
from endopilot.types import Branch, Centerline, Insertion, VesselTree
from endopilot.vessels.graph import Line, RootedGraph, groups, pieces
from endopilot.vessels.line_graph import STEP_MM, FoundLines, LineGraph, found_lines
from endopilot.vessels.sources import Polylines

SAMPLE_STEP_MM = 0.1  # distance of the points by which two trees are compared
_SHORTEST_MM = 2.0  # shorter stretches are left out together in one note, mm
_MOST_NOTES = 12  # as many stretches or loops are noted one by one
_OPEN_MM = 0.2  # a loop has a hole where the spheres on its two sides are this far apart, mm


@dataclass(frozen=True, eq=False)
class LineTree:
    """One tree from lines, the rule that chose its root, what was done and left out, and `left_out`."""

    tree: VesselTree
    rule: str
    notes: list[str]
    coverage: dict[str, float]


def tree_from_polylines(
    source: Polylines | VesselTree, given: Insertion | None, label: str, vessel: str = "generic"
) -> LineTree:
    """Return one tree from centerlines; arguments and errors are those of `line_graph.found_lines`."""
    if isinstance(source, VesselTree):
        lines = [branch.centerline for branch in source.branches]
        source = Polylines(tuple(line.points for line in lines), tuple(line.radius for line in lines))
    found = found_lines(source, given, label, vessel)
    tree = tree_from_lines(found.lines)
    lost, balance = left_out(found, tree)
    return LineTree(tree, found.rule, [*found.notes, *lost, *closures(tree), *found.rivals], balance)


def tree_from_lines(lines: list[Line]) -> VesselTree:
    """Return the tree of lines that leave each other, cut into branches, all in section 0, "vessel"."""
    branches: list[Branch] = []
    ends: dict[tuple[int, int], int] = {}
    for index, line in enumerate(lines):
        cuts = sorted({other.place for other in lines if other.parent == index} - {0, len(line.points) - 1})
        bounds = [0, *cuts, len(line.points) - 1]
        parent = ends[line.parent, line.place] if line.parent >= 0 else -1
        for start, end in itertools.pairwise(bounds):
            points, radius = line.points[start : end + 1].copy(), line.radius[start : end + 1].copy()
            before = branches[parent].centerline if parent >= 0 else None
            if before is not None:
                points[0], radius[0] = before.points[-1], before.radius[-1]
            first = 0.0 if before is None else float(before.abscissa[-1])
            centerline = make_centerline(points, radius, first, None if before is None else before.normals[-1])
            branches.append(Branch(centerline, parent, np.zeros(len(points), dtype=np.int64)))
            parent = len(branches) - 1
            ends[index, end] = parent
    return VesselTree(tuple(branches), ("vessel",))


def left_out(found: FoundLines, tree: VesselTree) -> tuple[list[str], dict[str, float]]:
    """Return a note on each stretch of line outside the tree's spheres, and the balance, mm: `length_mm` of the lines
    is `reached_mm` by the spheres and `left_out_mm`; `bridged_mm` of gaps lie between them."""
    nodes, piece = found.whole, found.piece
    whole = tree.line
    gap, nearest = KDTree(whole.points).query(nodes.points)
    inside = gap <= np.maximum(whole.radius[nearest], STEP_MM)
    total, covered, lost = float(nodes.share.sum()), float(nodes.share[inside].sum()), np.flatnonzero(~inside)
    sizes = {"length": total, "reached": covered, "left_out": total - covered, "bridged": found.bridged_mm}
    balance = {f"{name}_mm": round(size, 1) for name, size in sizes.items()}
    if len(lost) == 0:
        return [], balance
    near = KDTree(nodes.points[lost]).query_pairs(2 * STEP_MM, output_type="ndarray")
    stretch = pieces(near[np.diff(piece[lost[near]] < 0, axis=1)[:, 0] == 0], len(lost))
    notes, short = [], []
    for number in range(stretch.max() + 1):
        part = lost[stretch == number]
        length = _length_once(nodes, part)
        place = place_text(nodes.points[part[gap[part].argmax()]])
        if piece[part[0]] < 0:
            why = "it lies in the parent vessel that the lines start in"
        elif piece[part].max() != found.own:
            why = f"no line leads there; the nearest is {gap[part].min():.1f} mm away"
        else:
            why = "it is no longer than the vessel it leaves is wide"
        (notes if length >= _SHORTEST_MM else short).append((length, f"at {place} is left out: {why}"))
    notes.sort(key=lambda note: -note[0])
    short += notes[_MOST_NOTES:]
    texts = [f"{length:.1f} mm of line {rest}" for length, rest in notes[:_MOST_NOTES]]
    if short:
        total, longest = sum(length for length, _ in short), max(short)
        texts.append(
            f"{total:.1f} mm of line in {len(short)} short stretches left out; the longest, {longest[0]:.1f} mm, "
            f"{longest[1].split(' is')[0]}"
        )
    return texts, balance


def _length_once(nodes: LineGraph, part: Int[np.ndarray, "p"]) -> float:
    """Return the length of a stretch, lines that run together counted once, mm."""
    total, seen = 0.0, np.empty((0, 3))
    for owner in np.unique(nodes.owner[part]):
        mine = part[nodes.owner[part] == owner]
        fresh = mine
        if len(seen):
            gap = np.asarray(KDTree(seen).query(nodes.points[mine])[0])
            fresh = mine[gap > np.maximum(0.5 * nodes.radius[mine], STEP_MM)]
        total += float(nodes.share[fresh].sum())
        seen = np.concatenate([seen, nodes.points[mine]])
    return total


def closures(tree: VesselTree) -> list[str]:
    """Return a note on each loop that a tree cannot hold: spheres meet while some on the way between do not."""
    whole = tree.line
    points, radius, abscissa = whole.points, whole.radius, whole.abscissa
    branch = np.repeat(np.arange(len(tree.branches)), [len(own.section) for own in tree.branches])
    pairs = KDTree(points).query_pairs(2 * float(radius.max()), output_type="ndarray")
    one, two = pairs.T
    overlap = radius[one] + radius[two] - np.linalg.norm(points[one] - points[two], axis=1)
    fork = np.stack([tree.departures(number) for number in range(len(tree.branches))])[branch[one], branch[two]]
    route = abscissa[one] + abscissa[two] - 2 * np.minimum(fork, np.minimum(abscissa[one], abscissa[two]))
    found = np.flatnonzero((overlap > 0) & (route > 2 * np.pi * np.maximum(radius[one], radius[two])))
    if len(found) == 0:
        return []
    one, two, overlap, route = one[found], two[found], overlap[found], route[found]
    places = 0.5 * (points[one] + points[two])
    cells, member = np.unique(np.floor(places / STEP_MM), axis=0, return_inverse=True)
    cluster = groups(STEP_MM * cells, float(np.median(radius[one])) + 2 * STEP_MM)[member.reshape(-1)]
    last = [np.flatnonzero(branch == number)[-1] for number in tree.leaves()]
    graph, notes = _graph_of(tree, branch), []
    for number in range(cluster.max() + 1):
        mine = np.flatnonzero(cluster == number)
        best = mine[overlap[mine].argmax()]
        ends = [int(one[best]), int(two[best])]
        nodes = np.array(graph.way(*ends))
        if not _has_hole(points[nodes], radius[nodes]):
            continue
        tip = any(
            branch[end] == branch[leaf] and abscissa[leaf] - abscissa[end] < 2 * radius[end] + STEP_MM
            for end in ends
            for leaf in last
        )
        what = "two lines meet" if tip else "two vessels touch"
        notes.append(
            (
                float(route[best]),
                f"{what} at {place_text(places[best])} and close a loop of {route[best]:.0f} mm: the tree is "
                "cut there, the lumen is open",
            )
        )
    notes.sort(key=lambda note: -note[0])
    texts = [text for _, text in notes[:_MOST_NOTES]]
    return texts + ([f"{len(notes) - _MOST_NOTES} shorter loops are cut too"] if len(notes) > _MOST_NOTES else [])


def _graph_of(tree: VesselTree, branch: Int[np.ndarray, "n"]) -> RootedGraph:
    line, before = tree.line, np.arange(len(branch)) - 1
    for start, own in zip(np.flatnonzero(np.diff(branch, prepend=-1)), tree.branches, strict=True):
        if own.parent >= 0:
            host = np.flatnonzero(branch == own.parent)
            before[start] = host[np.linalg.norm(line.points[host] - line.points[start], axis=1).argmin()]
    return RootedGraph(line.points, line.radius, csr_matrix((len(branch),) * 2), STEP_MM, before, line.abscissa)


def _has_hole(points: Float[np.ndarray, "w 3"], radius: Float[np.ndarray, "w"]) -> bool:
    """Return whether the two halves of a way that comes back to its start lie apart somewhere in between."""
    length = length_along(points)
    half = length <= 0.5 * length[-1]
    first, second = np.flatnonzero(half), np.flatnonzero(~half)
    gap = (
        np.linalg.norm(points[first, None] - points[None, second], axis=2) - radius[first, None] - radius[None, second]
    )
    return bool(gap.min(axis=1).max(initial=-np.inf) > _OPEN_MM or gap.min(axis=0).max(initial=-np.inf) > _OPEN_MM)


def make_centerline(
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    first_abscissa: float = 0.0,
    first_normal: Float[np.ndarray, "3"] | None = None,
) -> Centerline:
    """Return a centerline (LPS mm, radii) with abscissa and parallel-transported `first_normal` (or any)."""
    abscissa = first_abscissa + length_along(points)
    return Centerline(points=points, radius=radius, abscissa=abscissa, normals=parallel_transport(points, first_normal))


def parallel_transport(
    points: Float[np.ndarray, "n 3"], first_normal: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return unit normals carried along a line without twist, by double reflection (Wang et al., ACM TOG 27, 2008)."""
    direction = tangents(points)
    normal = np.eye(3)[np.abs(direction[0]).argmin()] if first_normal is None else first_normal
    normal = normal - np.dot(normal, direction[0]) * direction[0]
    if np.linalg.norm(normal) < 1e-6:
        normal = np.eye(3)[np.abs(direction[0]).argmin()]
        normal = normal - np.dot(normal, direction[0]) * direction[0]
    normals = np.empty_like(points, dtype=float)
    normals[0] = normal / np.linalg.norm(normal)
    for i in range(len(points) - 1):
        chord = points[i + 1] - points[i]
        square = max(float(chord @ chord), 1e-24)
        reflected = normals[i] - 2.0 / square * (chord @ normals[i]) * chord
        turned = direction[i] - 2.0 / square * (chord @ direction[i]) * chord
        second = direction[i + 1] - turned
        square = float(second @ second)
        normal = reflected if square < 1e-24 else reflected - 2.0 / square * (second @ reflected) * second
        normal = normal - np.dot(normal, direction[i + 1]) * direction[i + 1]
        normals[i + 1] = normal / np.linalg.norm(normal)
    return normals


def tangents(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit tangents of a line: central differences, at both ends the chords' directions carried on."""
    direction = np.gradient(points, axis=0)
    if len(points) > 2:
        for end, inwards, third in ((0, 1, 2), (-1, -2, -3)):
            last, before = points[inwards] - points[end], points[third] - points[inwards]
            size = max(float(np.linalg.norm(last)), 1e-12), max(float(np.linalg.norm(before)), 1e-12)
            share = size[0] / (size[0] + size[1])
            outwards = (1.0 + share) * last / size[0] - share * before / size[1]
            direction[end] = outwards if end == 0 else -outwards
    return direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)


def sampled(tree: VesselTree) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return points and radii every 0.1 mm along all branches."""
    points, radius = [], []
    for branch in tree.branches:
        line = branch.centerline
        at = np.arange(line.abscissa[0], line.abscissa[-1], SAMPLE_STEP_MM)
        points.append(places_on(line.points, line.abscissa, at))
        radius.append(np.interp(at, line.abscissa, line.radius))
    return np.concatenate(points), np.concatenate(radius)


def resampled(points: Float[np.ndarray, "n 3"], step_mm: float) -> Float[np.ndarray, "m 3"]:
    """Return the line through `points` in equal steps of about `step_mm`, by a monotone cubic in its length."""
    from scipy.interpolate import PchipInterpolator

    distinct = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9])
    points = points[distinct]
    if len(points) < 2:
        return points
    length = length_along(points)
    count = max(2, round(length[-1] / step_mm) + 1)
    return np.asarray(PchipInterpolator(length, points, axis=0)(np.linspace(0.0, length[-1], count)))


def smoothed(points: Float[np.ndarray, "n d"], width: float) -> Float[np.ndarray, "n d"]:
    """Blur a line with a Gaussian of `width` samples that leaves its ends in place."""
    from scipy.ndimage import gaussian_filter1d

    extra = min(int(4 * width), len(points) - 1)
    head = 2 * points[0] - points[extra:0:-1]
    tail = 2 * points[-1] - points[-2 : -extra - 2 : -1]
    return gaussian_filter1d(np.concatenate([head, points, tail]), width, axis=0)[len(head) : len(head) + len(points)]


def cross_axes(direction: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return two unit vectors perpendicular to each direction and to each other."""
    helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(direction, one)
