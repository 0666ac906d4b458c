"""The ends of a vessel's lines: where they are cut back from a cap, drawn out to a cut, or led to a known ostium."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.coronary_ends import rank_correlation
from endopilot.anatomy.distance import sample
from endopilot.anatomy.lumen_graph import LumenGraph
from endopilot.anatomy.surface import Surface
from endopilot.anatomy.tree import Line, cross_axes, resampled, smoothed
from endopilot.errors import place_text
from endopilot.lines import length_along
from endopilot.types import DistanceMap, Insertion

_RING = 12
"""Rays across a vessel."""

_FLAT = 0.75
"""A vessel whose smaller half-axis falls below this share of its radius is not drawn out any farther."""

_ROUND = 0.9
"""A half-axis counts as different from the radius where it is smaller than this share of it."""

_AHEAD = 0.87
"""Cosine of the largest angle at which a line may leave a known ostium off the catheter's axis."""

_SIGHT = np.linspace(0.0, 1.0, 50)
"""Shares of a line of sight at which the lumen is looked at."""

_LED_ELSEWHERE = 2.0
"""A line drawn out to its cut ends within this many radii of the tip that it was traced from."""

_BLIND = 0.6
"""An end whose cap is as round as a sphere counts this share of one that is cut flat."""

_ROUND_CAP, _FLAT_CAP = 0.3, 0.7
"""Flat part of a cap over the section: at 0.4 mm voxels domes of 2 to 6 mm have 0.2 to 0.5, cuts 0.6 to 0.9."""

_NECK, _DOME = 1.3, 4.0
"""An end this many times as wide as its neck, which lies no more of its radii behind than the second, is a dome."""

_LINE_ENDS, _NO_LINE = 0.5, 0.1
"""Lines run from the inlet, as VMTK writes them: one that ends at a place says this share of what one that begins there
says for it; a place where no line begins or ends is as little likely as the second."""

_RIVAL = 0.55
"""Ends that look this much like the inlet as the best one are named."""

_LONGEST_BRIDGE = 4.0
"""A known ostium is joined to a line that begins at most this many radii away."""


@dataclass(frozen=True, eq=False)
class InletEnd:
    """An end of a tree that a device may enter at.

    Attributes:
        node: index of its tip.
        position: middle of the end, mm.
        radius: of the vessel there, mm.
        score: how much it looks like the inlet, mm: its radius, less where something speaks against it.
    """

    node: int
    position: Float[np.ndarray, "3"]
    radius: float
    score: float

    def rivals(self, others: Sequence[InletEnd]) -> list[str]:
        """Say which other ends look so much like the inlet that the device may as well enter there."""
        near = [end for end in others if end is not self and end.score > _RIVAL * self.score]
        if not near:
            return []
        places = ", ".join(f"{place_text(end.position)} ({2 * end.radius:.1f} mm wide)" for end in near[:4])
        return [
            f"the end at {places} could be an inlet too; taken is {place_text(self.position)} "
            f"({2 * self.radius:.1f} mm wide): --ostium-mm chooses another"
        ]


def likely_inlets(
    tree: LumenGraph,
    paths: Sequence[Int[np.ndarray, "_"]],
    *,
    wall: Surface | None = None,
    lines: Sequence[Float[np.ndarray, "2 3"]] = (),
) -> list[InletEnd]:
    """Return the ends of a tree, the one that looks most like its inlet first.

    The inlet is wide, the tree narrows from it, it is cut flat, and lines begin there. An end that bulges behind a neck
    is an aneurysm's dome: it counts as its neck does, less by how much it bulges. A cut that bulges is none: the root
    of the aorta does.

    Args:
        tree: points with their distance to the wall; of lines, their radii.
        paths: of its nodes, the first from one end to another, each other one from an earlier one to an end.
        wall: the wall, which shows where a vessel is cut; None for lines.
        lines: first and last point of each line of a file of lines.
    """
    before = {int(node): int(last) for path in paths for last, node in itertools.pairwise(path)}
    middle = np.concatenate(paths)
    widths = tree.clearance[middle]
    triangles = None if wall is None else wall.triangles()
    found = []
    for path in (paths[0][::-1], *paths):
        inwards = [int(node) for node in path[::-1]]
        if path[0] != paths[0][0] and path[-1] != paths[0][0]:  # a branch is followed on into what carries it
            while inwards[-1] in before:
                inwards.append(before[inwards[-1]])
        points, clearance = tree.points[inwards], tree.clearance[inwards]
        place = min(len(path) - before_cap(tree, path), len(path) - 1)
        radius = float(np.median(clearance[place : place + 5]))
        widest, bulge, neck = _bulge(points, clearance, len(path))
        near = np.linalg.norm(np.reshape(lines, (-1, 2, 3)) - points[0], axis=2) <= max(radius, tree.spacing_mm)
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
        found.append(InletEnd(int(path[-1]), middle_of_end, radius, float(score)))
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
    """Return the area of the flattest part of the wall that closes an end, over that of the vessel's section.

    A vessel cut straight or aslant has 1 or more, a dome 0.12 (what lies within 20° of one direction on a sphere).

    Args:
        points: the way inwards from the tip.
        place: where on it the vessel has its whole width.
        width: its radius there, mm.
        triangles: centres, normals and areas of the wall's triangles.
    """
    centres, normals, areas = triangles
    back = int(np.searchsorted(length_along(points[place:]), 1.5 * width))
    axis = points[place] - points[min(place + max(back, 1), len(points) - 1)]
    near = np.flatnonzero(np.linalg.norm(centres - points[place], axis=1) < 2.0 * width)
    near = near[normals[near] @ axis > 0.5 * np.linalg.norm(axis)]
    normals, areas = normals[near], areas[near]
    some = normals[:: max(1, len(near) // 64)]
    return float(((some @ normals.T > np.cos(np.radians(20.0))) @ areas).max(initial=0.0)) / (np.pi * width**2)


def before_cap(graph: LumenGraph, nodes: Int[np.ndarray, "_"]) -> int:
    """Return how many nodes of a path stand before the first inscribed sphere that reaches the path's end."""
    gap = np.linalg.norm(graph.points[nodes] - graph.points[nodes[-1]], axis=1)
    clear = np.flatnonzero(gap > 2.0 * graph.clearance[nodes] + 2.0 * graph.spacing_mm)
    return max(int(clear[-1]) + 2 if len(clear) else 0, min(4, len(nodes)))


def to_cut(
    distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], step_mm: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Draw a line out as long as the lumen keeps its width, to the cut of a vessel that ends flat.

    Each step goes on along the last ones, bent as they are, and is centred by the walls beside it alone: the cut ahead
    does not draw it back. Where the lumen grows narrow or flat, it is no longer the same vessel that runs to a cut.
    """
    width = float(radius[-1])
    back = max(3, round(1.5 * width / step_mm))
    line = list(points[-2 * back - 1 :])
    kept = len(line)
    added: list[float] = []
    for _ in range(int(3 * width / step_mm) + 1):
        behind = min(back, len(line) - 1)
        axis = line[-1] - line[-1 - behind]
        if len(line) > 2 * behind:
            axis = 1.5 * axis - 0.5 * (line[-1 - behind] - line[-1 - 2 * behind])
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        candidate = line[-1] + step_mm * axis
        wall, rays = _section(distance_map, candidate, axis, 2 * width)
        small = 0.5 * float((wall[: _RING // 2] + wall[_RING // 2 :]).min())
        if np.median(wall) < 0.9 * width or small < _FLAT * width:
            break
        added.append(width if small > _ROUND * width else small)  # less than that is ripple
        shift = 2.0 / _RING * wall @ rays
        size = float(np.linalg.norm(shift))
        line.append(candidate + shift * min(0.5, 0.2 * step_mm / max(size, 1e-12)))
    return np.concatenate([points, np.reshape(line[kept:], (-1, 3))]), np.concatenate([radius, added])


def from_ostium(
    distance_map: DistanceMap,
    drawn: Float[np.ndarray, "n 3"],
    width: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "m 3"],
    radius: Float[np.ndarray, "m"],
    ostium: Insertion,
    step_mm: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]] | None:
    """Return the first line so that it begins at a known ostium, or None where no line of sight leads there.

    Args:
        distance_map: the wall.
        drawn: the line as it was drawn out to the cut.
        width: its radii, mm.
        points: the line before that, cut back from the cap.
        radius: its radii, mm.
        ostium: where the vessel begins.
        step_mm: distance between points.
    """
    along = length_along(drawn)
    shift = ostium.position - drawn[0]
    beside = shift - (shift @ ostium.direction) * ostium.direction
    if np.linalg.norm(shift) <= 2 * width[0] and np.linalg.norm(beside) <= 0.5 * width[0]:
        share = np.clip(1 - along / (3 * width[0]), 0.0, 1.0)
        return drawn + (share**2 * (3 - 2 * share))[:, None] * shift, width
    offset = points - ostium.position
    length = np.linalg.norm(offset, axis=1)
    ahead = np.flatnonzero(offset @ ostium.direction > _AHEAD * length)
    if len(ahead) == 0 or length[ahead[0]] > _LONGEST_BRIDGE * radius[ahead[0]]:
        return None
    first = int(ahead[0])
    count = max(2, round(float(length[first]) / step_mm))
    bridge = ostium.position + np.arange(count)[:, None] / count * offset[first]
    clearance = sample(distance_map, bridge)
    if clearance[1:].min() <= 0:
        return None
    # Near the ostium the nearest wall is the cut's own cap, and no width of the vessel.
    gone = np.linalg.norm(bridge - ostium.position, axis=1)
    free = int(np.argmax(np.append(gone > 1.25 * clearance + step_mm, True)))
    clearance[:free] = np.append(clearance, radius[first])[free]
    return smoothed(np.concatenate([bridge, points[first:]]), 3.0), np.concatenate([clearance, radius[first:]])


def from_tip(
    drawn: Float[np.ndarray, "n 3"],
    width: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "m 3"],
    radius: Float[np.ndarray, "m"],
    traced: Float[np.ndarray, "t 3"],
    step_mm: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Return the first line so that it begins at the tip that it was traced from, if drawing it out led elsewhere.

    Where a short left main meets its branches, a line that is cut back from the cap is cut back round the bend.

    Args:
        drawn: the line as it was drawn out to the cut.
        width: its radii, mm.
        points: the line before that, cut back from the cap.
        radius: its radii, mm.
        traced: the nodes of its path, the tip first.
        step_mm: distance between points, mm.
    """
    if np.linalg.norm(drawn[0] - traced[0]) < _LED_ELSEWHERE * width[0]:
        return drawn, width
    first = int(np.linalg.norm(traced - points[0], axis=1).argmin())
    # The tip lies in the rim of the cap, not on the axis: begin where a sphere of half the width touches it.
    gone = np.linalg.norm(traced[:first] - traced[0], axis=1)
    stub = traced[:first][gone > 0.5 * radius[0]]
    if len(stub) < 2:
        return drawn, width
    line = resampled(smoothed(np.concatenate([stub, points]), radius[0] / step_mm), step_mm)
    added = len(line) - len(points)
    return line, np.concatenate([np.full(max(added, 0), radius[0]), radius[max(-added, 0) :]])


def without_inlets(distance_map: DistanceMap, lines: list[Line], ostium: Insertion) -> list[Line]:
    """Leave out lines that lead back to the ostium's own cut: the other side of a wide inlet, and no branch.

    Such a line ends in the plane of the ostium, and there the lumen joins it to the first line in a straight line. In
    the merged lumens of a dissection, a wire beside the first line would seem to lie far ahead, on the returning part.

    Args:
        distance_map: the wall.
        lines: of the whole tree, parents before their children.
        ostium: where the vessel begins, with its direction.
    """
    first, kept = lines[0].points, [True] * len(lines)
    for index in range(len(lines) - 1, 0, -1):
        points, width = lines[index].points, float(lines[index].radius[-1])
        leads_on = any(kept[i] and other.parent == index for i, other in enumerate(lines))
        if leads_on or abs((points[-1] - ostium.position) @ ostium.direction) > width:
            continue
        inner = points[int(np.argmax(np.linalg.norm(points - points[-1], axis=1) <= width))]
        beside = first[int(np.linalg.norm(first - inner, axis=1).argmin())]
        kept[index] = bool(sample(distance_map, inner + _SIGHT[:, None] * (beside - inner)).min() <= 0)
    number = np.cumsum(kept) - 1
    whole = [line for line, stays in zip(lines, kept, strict=True) if stays]
    return [replace(line, parent=int(number[line.parent]) if line.parent >= 0 else -1) for line in whole]


def _section(
    distance_map: DistanceMap, point: Float[np.ndarray, "3"], tangent: Float[np.ndarray, "3"], limit_mm: float
) -> tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r 3"]]:
    """Return the distance to the wall along rays across a vessel, mm, and the rays: 0 outside, at most `limit_mm`."""
    one, two = cross_axes(tangent[None])
    angle = 2 * np.pi * np.arange(_RING) / _RING
    rays = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * two
    step = 0.5 * distance_map.spacing_mm
    along = np.arange(0.0, limit_mm + step, step)
    value = sample(distance_map, (point + along[:, None, None] * rays).reshape(-1, 3)).reshape(len(along), _RING)
    outside = value <= 0
    first = np.maximum(outside.argmax(axis=0), 1)
    before, after = value[first - 1, np.arange(_RING)], value[first, np.arange(_RING)]
    crossing = along[first - 1] + step * before / np.maximum(before - after, 1e-12)
    return np.where(outside[0], 0.0, np.where(outside.any(axis=0), crossing, limit_mm)), rays
