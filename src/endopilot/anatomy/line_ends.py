"""The ends of a vessel's lines: where they are cut back from a cap, drawn out to a cut, or led to a known ostium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.distance import sample
from endopilot.anatomy.lumen_graph import LumenGraph
from endopilot.anatomy.tree import Line, cross_axes, resampled, smoothed
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

_LONGEST_BRIDGE = 4.0
"""A known ostium is joined to a line that begins at most this many radii away."""


def end_score(distance_map: DistanceMap, graph: LumenGraph, path: Int[np.ndarray, "_"]) -> float:
    """Return how much the end of a path looks like the vessel's inlet: its radius in mm, less if it is not cut open.

    A blind end counts 0.6 times its radius, and one that bulges behind a neck, as an aneurysm does, 0.2 times, but no
    more than half the neck's.
    """
    kept = path[: before_cap(graph, path)]
    radius = float(np.median(graph.clearance[kept[-5:]]))
    raw = graph.points[kept]
    points = smoothed(raw, 3.0) if len(raw) > 3 else raw
    drawn, _ = to_cut(distance_map, points, np.full(len(points), radius), graph.spacing_mm)
    axis = drawn[-1] - points[max(0, len(points) - 4)]
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    along = np.arange(0.0, 3 * radius, 0.5 * graph.spacing_mm)
    blind = sample(distance_map, drawn[-1] + along[:, None] * axis) > 0
    remaining = along[np.argmin(blind)] if not blind.all() else along[-1]
    if remaining < 0.35 * radius + 0.5 * graph.spacing_mm:
        return radius
    gap = np.abs(
        graph.length[kept] - graph.length[kept[-1]]
    )  # along the vessel: the other limb of a hairpin is near too
    neck = graph.clearance[kept[gap < 4 * radius]].min()
    return min(0.2 * radius, 0.5 * float(neck)) if radius > 1.3 * neck else 0.6 * radius


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
