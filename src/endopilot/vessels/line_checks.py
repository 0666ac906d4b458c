"""What a tree made from centerlines does not show: what it leaves out, where vessels meet again."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from endopilot.errors import place_text
from endopilot.lines import length_along
from endopilot.types import VesselTree
from endopilot.vessels.graph import RootedGraph, groups, pieces
from endopilot.vessels.line_graph import STEP_MM, FoundLines, LineGraph

_SHORTEST_MM = 2.0  # shorter stretches are left out together in one note, mm
_MOST_NOTES = 12  # as many stretches or loops are noted one by one
_OPEN_MM = 0.2  # a loop has a hole where the spheres on its two sides are this far apart, mm


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
