"""Centerlines on the medial axis: `refined_lines` moves the paths traced through a lumen below the grid.

A point moves by the first harmonic of the exact wall distance on a ring around it, which is zero on the medial axis.
Side branches are joined to their parents where the two axes meet.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.distance import sample
from endopilot.anatomy.line_ends import before_cap, from_ostium, from_tip, to_cut, without_inlets
from endopilot.anatomy.lumen_graph import LumenGraph
from endopilot.anatomy.surface import Surface
from endopilot.anatomy.tree import Line, cross_axes, resampled, smoothed, tangents
from endopilot.types import DistanceMap, Insertion

ROUNDNESS = 0.05
"""A cross-section whose half-axes differ by less than twice this share of its radius counts as round."""

_RING = 12
_FEWEST_DIRECTIONS = 5
"""With fewer directions than this on the ring, a vessel has too little wall of its own to be centred by."""

_STRAIGHT = 10
"""This many steps of a branch from where it leaves its parent show where it comes from."""

_NEAR_WALL = 0.8
"""The ring on which the radius is measured, in distances to the wall."""

_CROSSED = 0.25
"""A straight way narrower than this share of a branch's radius crosses a wall: at flaps of one voxel 0.0 to 0.1."""

_WAY = 12
"""Places at which such a way is looked at."""

_REFINEMENTS = 8
_STEP_LIMIT = 0.3
"""A refinement moves a point by at most this share of its distance to the wall."""


def refined_lines(
    surface: Surface,
    distance_map: DistanceMap,
    graph: LumenGraph,
    paths: list[Int[np.ndarray, "_"]],
    step_mm: float,
    ostium: Insertion | None = None,
) -> list[Line]:
    """Return the traced paths on the medial axis, each joined to its parent where its axis meets the parent's.

    Within one radius of an end the inscribed sphere feels the end's own cap. Lines are cut back from there and, where
    the lumen keeps its width (a vessel cut flat), drawn out to the cut; the first one to the ostium, if that is known.
    """
    home = np.full(len(graph.points), -1)
    lines: list[Line] = []
    for index, nodes in enumerate(paths):
        parent = int(home[nodes[0]]) if index else -1
        kept = nodes[: before_cap(graph, nodes)]
        if index == 0:
            kept = kept[::-1][: before_cap(graph, kept[::-1])][::-1]
        elif parent >= 0:
            kept = kept[_outside(graph.points[kept], lines[parent]) :]
        home[nodes if index == 0 else nodes[1:]] = parent if index else 0
        raw = smoothed(graph.points[kept], 3.0) if len(kept) > 3 else graph.points[kept]
        if index and np.linalg.norm(np.diff(raw, axis=0), axis=1).sum() < 3 * step_mm:
            continue
        mouth = None if index == 0 else lines[parent]
        points, radius = _to_axis(surface, distance_map, resampled(raw, step_mm), mouth)
        points, radius = to_cut(distance_map, points, radius, step_mm)
        place = 0
        if index == 0:
            drawn, width = (side[::-1] for side in to_cut(distance_map, points[::-1], radius[::-1], step_mm))
            begun = None if ostium is None else from_ostium(distance_map, drawn, width, points, radius, ostium, step_mm)
            points, radius = begun or from_tip(drawn, width, points, radius, graph.points[nodes], step_mm)
        else:
            home[nodes[1:]] = len(lines)
            place = _meeting_point(distance_map, points, float(radius[0]), lines[parent])
            points, radius = _joined(surface, lines[parent], place, points, radius, step_mm)
        lines.append(Line(points, radius, parent, place))
    return lines if ostium is None else without_inlets(distance_map, lines, ostium)


def _to_axis(
    surface: Surface, distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], parent: Line | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Move a line onto its vessel's axis; return it with its radii.

    Where a branch runs together with its parent, the directions in which it opens into the parent do not count.
    """
    for iteration in range(_REFINEMENTS):
        clearance = surface.distance(points)
        around, ring = _ring_distance(surface, points, 0.5 * clearance)
        _, shift = _harmonics(around, ring, _walled(points, clearance, ring, parent))
        size = np.linalg.norm(shift, axis=1)
        shift *= np.minimum(1.0, _STEP_LIMIT * clearance / np.maximum(size, 1e-12))[:, None]
        moved = points + shift
        moved = np.where((sample(distance_map, moved) > 0)[:, None], moved, points)
        points = _twice_smooth(moved, 3.0 if iteration < _REFINEMENTS - 2 else 2.0)
    return points, _inscribed_radius(surface, points, parent)


def _walled(
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    ring: Float[np.ndarray, "r n 3"],
    parent: Line | None,
) -> Bool[np.ndarray, "r n"]:
    """Return in which directions a vessel has a wall of its own: not where it opens into its parent."""
    if parent is None:
        return np.ones(ring.shape[:2], dtype=bool)
    gap, nearest = KDTree(parent.points).query((points + clearance[:, None] * ring).reshape(-1, 3))
    own = (np.asarray(gap) > parent.radius[np.asarray(nearest)]).reshape(ring.shape[:2])
    return own | (own.sum(axis=0) < _FEWEST_DIRECTIONS)


def _harmonics(
    around: Float[np.ndarray, "r n"], ring: Float[np.ndarray, "r n 3"], walled: Bool[np.ndarray, "r n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Fit a mean and a first harmonic to the wall distances around each point; return the offset of the centre too."""
    angle = 2 * np.pi * np.arange(_RING) / _RING
    basis = np.stack([np.ones(_RING), np.cos(angle), np.sin(angle)], axis=1)
    matrix = np.einsum("rn,ri,rj->nij", walled.astype(float), basis, basis)
    matrix[:, [1, 2], [1, 2]] += 0.1 * (~walled).sum(axis=0)[:, None]  # half a ring alone gives the direction poorly
    fit = np.linalg.solve(matrix, np.einsum("rn,ri,rn->ni", walled.astype(float), basis, around)[..., None])[..., 0]
    return fit[:, 0], fit[:, 1, None] * ring[0] + fit[:, 2, None] * ring[_RING // 4]


def _inscribed_radius(
    surface: Surface, points: Float[np.ndarray, "n 3"], parent: Line | None
) -> Float[np.ndarray, "n"]:
    """Return inscribed-sphere radii that the wall's voxel noise does not shrink.

    The distance at the axis is the least over the whole circumference, and so reads the deepest ripple of the wall.
    Instead, each direction is measured by itself on a ring near the wall. Their mean is the radius of a round lumen;
    the second harmonic's amplitude, where it is more than ripple, leads from it to the small half-axis of a flat one.
    """
    clearance = surface.distance(points)
    around, ring = _ring_distance(surface, points, _NEAR_WALL * clearance)
    walled = _walled(points, clearance, ring, parent)
    mean = _harmonics(around, ring, walled)[0] + _NEAR_WALL * clearance
    flatness = np.abs(2.0 / _RING * np.exp(4j * np.pi * np.arange(_RING) / _RING) @ around) * walled.all(axis=0)
    radius = mean - np.maximum(flatness - ROUNDNESS * mean, 0.0)
    return smoothed(radius[:, None], 1.5)[:, 0] if len(points) > 3 else radius


def _ring_distance(
    surface: Surface, points: Float[np.ndarray, "n 3"], reach: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "r n"], Float[np.ndarray, "r n 3"]]:
    """Return the wall distance on a ring around each point, across the line, and the ring's directions."""
    angle = 2 * np.pi * np.arange(_RING) / _RING
    one, two = cross_axes(tangents(points))
    ring = np.cos(angle)[:, None, None] * one + np.sin(angle)[:, None, None] * two
    return surface.distance((points + reach[:, None] * ring).reshape(-1, 3)).reshape(_RING, -1), ring


def _twice_smooth(points: Float[np.ndarray, "n 3"], width: float) -> Float[np.ndarray, "n 3"]:
    """Blur a line and restore the curvature that the blur removed (Tukey's twicing)."""
    once = smoothed(points, width)
    return once + smoothed(points - once, width)


def _joined(
    surface: Surface,
    parent: Line,
    place: int,
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    step_mm: float,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Join a side branch's axis to its parent's by a straight piece, rounded where it meets the axis."""
    start = parent.points[place]
    count = max(1, round(float(np.linalg.norm(points[0] - start)) / step_mm))
    share = np.arange(count)[:, None] / count
    bridge = start + share * (points[0] - start)
    line = np.concatenate([bridge, points])
    weight = np.exp(-(((np.arange(len(line)) - count) / 3.0) ** 2))[:, None]
    line = (1 - weight) * line + weight * smoothed(line, 2.0)
    line[0] = start
    size = np.concatenate([surface.distance(line[:count]), radius])
    return line, size


def _outside(points: Float[np.ndarray, "n 3"], parent: Line) -> int:
    """Return the index of the first point from which a side branch stays outside its parent's inscribed spheres."""
    distance, nearest = KDTree(parent.points).query(points)
    inside = np.flatnonzero(distance < parent.radius[nearest])
    return int(inside[-1]) + 1 if len(inside) else 1


def _meeting_point(distance_map: DistanceMap, body: Float[np.ndarray, "n 3"], radius_mm: float, parent: Line) -> int:
    """Return the index of the parent's point that the side branch's axis, drawn back, comes nearest to.

    The straight way to it does not cross a wall, such as a flap beside the tear that the branch comes through.
    """
    start = body[: min(len(body), _STRAIGHT + 1)]
    back = np.linalg.svd(start - start.mean(axis=0))[2][0]
    back *= np.sign(back @ (start[0] - start[-1]))
    relative = parent.points - start.mean(axis=0)
    along = np.clip(relative @ back, 0.0, None)
    miss = np.linalg.norm(relative - along[:, None] * back, axis=1)
    gap = np.linalg.norm(parent.points - body[0], axis=1)
    near = gap <= 2.0 * parent.radius + gap.min()
    score = np.where(near, miss + 0.1 * gap, np.inf)

    def is_open(place: int) -> bool:
        way = np.linspace(body[0], parent.points[place], _WAY)
        return bool(sample(distance_map, way).min() > _CROSSED * radius_mm)

    order = np.argsort(score, kind="stable")
    place = int(next((i for i in order if is_open(int(i))), order[0]))
    return int(np.clip(place, 1, len(parent.points) - 2))
