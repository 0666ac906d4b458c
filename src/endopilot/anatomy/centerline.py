"""The centerline tree of a lumen: minimal paths through its distance map, refined to the medial axis.

1. Every grid point inside the lumen is a node of a graph; an edge costs its length over the squared distance to the
   wall, so that cheapest paths keep to the middle at every scale (the weighting of VMTK's minimal action paths and of
   TEASAR, Sato et al. 2000). Shortest paths from the root form a tree: loops and touching vessels cannot close it.
2. The farthest uncovered point is traced back until it meets the tree, and covers its surroundings; a piece that is
   not longer than it is wide, or than the local radius, is a bump of the wall and is dropped.
3. Each line is refined below the grid: a point moves by the first harmonic of the exact wall distance on a ring around
   it, which is zero on the medial axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.distance import sample
from endopilot.anatomy.surface import Surface
from endopilot.anatomy.tree import Line, resampled, tangents
from endopilot.types import DistanceMap

COVERAGE = 1.6
"""A path covers what lies within this many inscribed radii (and two grid steps) of it."""

SLENDERNESS = 2.2
"""A side branch is kept if it reaches this many times its own radius out of its parent's inscribed sphere."""

ROUNDNESS = 0.05
"""A cross-section whose half-axes differ by less than twice this share of its radius counts as round."""

_RING = 12
_FEWEST_DIRECTIONS = 5
"""In fewer directions of the ring a vessel has too little wall of its own to be centred by it."""

_STRAIGHT = 10
"""This many steps of a branch from where it leaves its parent tell where it comes from."""

_NEAR_WALL = 0.8
"""The ring on which the radius is measured, in distances to the wall."""

_REFINEMENTS = 8
_STEP_LIMIT = 0.3
"""A refinement moves a point by at most this share of its distance to the wall."""


@dataclass(frozen=True, eq=False)
class LumenGraph:
    """The inside of a lumen as a graph, with the cheapest way from every node to the root.

    Attributes:
        points: grid points inside the connected lumen at the root, LPS mm.
        clearance: their distance to the wall, mm.
        predecessor: next node on the way to the root, -1 at the root itself.
        length: length of the way to the root, mm.
        spacing_mm: grid spacing, mm.
    """

    points: Float[np.ndarray, "n 3"]
    clearance: Float[np.ndarray, "n"]
    predecessor: Int[np.ndarray, "n"]
    length: Float[np.ndarray, "n"]
    spacing_mm: float


def lumen_graph(
    points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], spacing_mm: float, root: int
) -> LumenGraph:
    """Return the graph of grid points inside one lumen, with the ways to `root`."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    index = np.rint((points - points.min(axis=0)) / spacing_mm).astype(np.int64) + 1
    shape = index.max(axis=0) + 2
    key = np.asarray(np.ravel_multi_index(tuple(index.T), tuple(shape)))
    order = np.asarray(np.argsort(key))
    ordered = key[order]
    weight = 1.0 / np.maximum(clearance, 0.1 * spacing_mm) ** 2
    rows, columns, costs = [], [], []
    for step in _HALF_NEIGHBOURHOOD:
        wanted = key + int(np.dot(step, [shape[1] * shape[2], shape[2], 1]))
        place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        start = np.flatnonzero(ordered[place] == wanted)
        end = order[place[start]]
        rows.append(start)
        columns.append(end)
        costs.append(np.linalg.norm(step) * spacing_mm * 0.5 * (weight[start] + weight[end]))
    matrix = csr_matrix(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(len(points), len(points))
    )
    cost, predecessor = dijkstra(matrix, directed=False, indices=root, return_predecessors=True)
    reached = np.isfinite(cost)
    renumber = np.cumsum(reached) - 1
    parent = predecessor[reached].astype(np.int64)
    parent = np.where(parent >= 0, renumber[np.maximum(parent, 0)], -1)
    kept = points[reached]
    return LumenGraph(kept, clearance[reached], parent, _length_to_root(kept, parent), spacing_mm)


def trace_branches(graph: LumenGraph, *, minimum_length_mm: float) -> list[Int[np.ndarray, "_"]]:
    """Return the tree as paths of nodes: the first from the root, each other one from a node of an earlier path."""
    surroundings = KDTree(graph.points)
    covered = np.zeros(len(graph.points), dtype=bool)
    on_tree = np.zeros(len(graph.points), dtype=bool)
    paths: list[np.ndarray] = []
    order = np.argsort(-graph.length, kind="stable")
    for tip in order:
        if covered[tip]:
            continue
        path = [int(tip)]
        while not on_tree[path[-1]] and graph.predecessor[path[-1]] >= 0:
            path.append(int(graph.predecessor[path[-1]]))
        nodes = np.array(path[::-1])
        if len(paths) == 0 or _is_branch(graph, nodes, minimum_length_mm):
            on_tree[nodes] = True
            paths.append(nodes)
        else:
            nodes = nodes[-1:]
        reach = COVERAGE * graph.clearance[nodes] + 2 * graph.spacing_mm
        for found in surroundings.query_ball_point(graph.points[nodes], reach):
            covered[found] = True
    return paths


def refined_lines(
    surface: Surface, distance_map: DistanceMap, graph: LumenGraph, paths: list[Int[np.ndarray, "_"]], step_mm: float
) -> list[Line]:
    """Return the traced paths on the medial axis, each joined to its parent where its axis meets the parent's.

    Within one radius of an end the inscribed sphere feels the end's own cap. Lines are cut back from there and, where
    the lumen keeps its width (a vessel cut flat), drawn out straight to the cut.
    """
    home = np.full(len(graph.points), -1)
    lines: list[Line] = []
    for index, nodes in enumerate(paths):
        parent = int(home[nodes[0]]) if index else -1
        kept = nodes[: _before_cap(graph, nodes)]
        if index == 0:
            kept = kept[::-1][: _before_cap(graph, kept[::-1])][::-1]
        elif parent >= 0:
            kept = kept[_outside(graph.points[kept], lines[parent]) :]
        home[nodes if index == 0 else nodes[1:]] = parent if index else 0
        raw = _smooth(graph.points[kept], 3.0) if len(kept) > 3 else graph.points[kept]
        if index and np.linalg.norm(np.diff(raw, axis=0), axis=1).sum() < 3 * step_mm:
            continue
        mouth = None if index == 0 else lines[parent]
        points, radius = _to_axis(surface, distance_map, resampled(raw, step_mm), mouth)
        points, radius = _to_cut(distance_map, points, radius, step_mm)
        place = 0
        if index == 0:
            points, radius = (side[::-1] for side in _to_cut(distance_map, points[::-1], radius[::-1], step_mm))
        else:
            home[nodes[1:]] = len(lines)
            place = _meeting_point(points, lines[parent])
            points, radius = _joined(surface, lines[parent], place, points, radius, step_mm)
        lines.append(Line(points, radius, parent, place))
    return lines


def end_score(distance_map: DistanceMap, graph: LumenGraph, path: Int[np.ndarray, "_"]) -> float:
    """Return how much the end of a path looks like the vessel's inlet: its radius in mm, less if it is not cut open.

    A blind end counts 0.6 times its radius, and one that bulges behind a neck, as an aneurysm does, 0.2 times, but no
    more than half the neck's.
    """
    kept = path[: _before_cap(graph, path)]
    radius = float(np.median(graph.clearance[kept[-5:]]))
    raw = graph.points[kept]
    points = _smooth(raw, 3.0) if len(raw) > 3 else raw
    drawn, _ = _to_cut(distance_map, points, np.full(len(points), radius), graph.spacing_mm)
    axis = drawn[-1] - points[max(0, len(points) - 4)]
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    along = np.arange(0.0, 3 * radius, 0.5 * graph.spacing_mm)
    blind = sample(distance_map, drawn[-1] + along[:, None] * axis) > 0
    remaining = along[np.argmin(blind)] if not blind.all() else along[-1]
    if remaining < 0.35 * radius + 0.5 * graph.spacing_mm:
        return radius
    gap = np.linalg.norm(graph.points[kept] - graph.points[kept[-1]], axis=1)
    neck = graph.clearance[kept[gap < 4 * radius]].min()
    return min(0.2 * radius, 0.5 * float(neck)) if radius > 1.3 * neck else 0.6 * radius


_HALF_NEIGHBOURHOOD = np.array(
    [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)]
)


def _length_to_root(points: Float[np.ndarray, "n 3"], predecessor: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Sum the steps of every way to the root at once, by pointer doubling."""
    jump = np.where(predecessor >= 0, predecessor, np.arange(len(points)))
    length = np.linalg.norm(points - points[jump], axis=1)
    while True:
        further = jump[jump]
        if np.array_equal(further, jump):
            return length
        length, jump = length + length[jump], further


def _is_branch(graph: LumenGraph, nodes: Int[np.ndarray, "_"], minimum_length_mm: float) -> bool:
    """Tell a side branch from a bump: it must reach far enough out of the inscribed sphere that it leaves."""
    points = graph.points[nodes]
    parent_radius = graph.clearance[nodes[0]]
    beyond = np.flatnonzero(np.linalg.norm(points - points[0], axis=1) > parent_radius)
    if len(beyond) < 2:
        return False
    length = graph.length[nodes[-1]] - graph.length[nodes[beyond[0]]]
    own_radius = float(np.median(graph.clearance[nodes[beyond]]))
    return bool(length >= max(minimum_length_mm, SLENDERNESS * own_radius, 0.5 * parent_radius))


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
    """Fit a mean and a first harmonic to the wall distances around each point; return it and the way to the centre."""
    angle = 2 * np.pi * np.arange(_RING) / _RING
    basis = np.stack([np.ones(_RING), np.cos(angle), np.sin(angle)], axis=1)
    matrix = np.einsum("rn,ri,rj->nij", walled.astype(float), basis, basis)
    matrix[:, [1, 2], [1, 2]] += 0.1 * (~walled).sum(axis=0)[:, None]  # a half ring alone tells the way poorly
    fit = np.linalg.solve(matrix, np.einsum("rn,ri,rn->ni", walled.astype(float), basis, around)[..., None])[..., 0]
    return fit[:, 0], fit[:, 1, None] * ring[0] + fit[:, 2, None] * ring[_RING // 4]


def _inscribed_radius(
    surface: Surface, points: Float[np.ndarray, "n 3"], parent: Line | None
) -> Float[np.ndarray, "n"]:
    """Return inscribed-sphere radii that the wall's voxel noise does not shrink.

    The distance at the axis is the least over the whole circumference, and so reads the deepest ripple of the wall.
    Instead, each direction is asked on its own on a ring near the wall. Their mean is the radius of a round lumen; the
    second harmonic's amplitude, where it is more than ripple, leads from it to the small half-axis of a flat one.
    """
    clearance = surface.distance(points)
    around, ring = _ring_distance(surface, points, _NEAR_WALL * clearance)
    walled = _walled(points, clearance, ring, parent)
    mean = _harmonics(around, ring, walled)[0] + _NEAR_WALL * clearance
    flatness = np.abs(2.0 / _RING * np.exp(4j * np.pi * np.arange(_RING) / _RING) @ around) * walled.all(axis=0)
    radius = mean - np.maximum(flatness - ROUNDNESS * mean, 0.0)
    return _smooth(radius[:, None], 1.5)[:, 0] if len(points) > 3 else radius


def _ring_distance(
    surface: Surface, points: Float[np.ndarray, "n 3"], reach: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "r n"], Float[np.ndarray, "r n 3"]]:
    """Return the wall distance on a ring around each point, across the line, and the ring's directions."""
    angle = 2 * np.pi * np.arange(_RING) / _RING
    one, two = _frame(tangents(points))
    ring = np.cos(angle)[:, None, None] * one + np.sin(angle)[:, None, None] * two
    return surface.distance((points + reach[:, None] * ring).reshape(-1, 3)).reshape(_RING, -1), ring


def _frame(direction: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return two unit vectors perpendicular to each direction and to each other."""
    helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(direction, one)


def _smooth(points: Float[np.ndarray, "n d"], width: float) -> Float[np.ndarray, "n d"]:
    """Blur a line with a Gaussian of `width` samples that leaves its ends in place."""
    from scipy.ndimage import gaussian_filter1d

    extra = min(int(4 * width), len(points) - 1)
    head = 2 * points[0] - points[extra:0:-1]
    tail = 2 * points[-1] - points[-2 : -extra - 2 : -1]
    return gaussian_filter1d(np.concatenate([head, points, tail]), width, axis=0)[len(head) : len(head) + len(points)]


def _twice_smooth(points: Float[np.ndarray, "n 3"], width: float) -> Float[np.ndarray, "n 3"]:
    """Blur a line and give back what the blur took of its curvature (Tukey's twicing)."""
    once = _smooth(points, width)
    return once + _smooth(points - once, width)


def _before_cap(graph: LumenGraph, nodes: Int[np.ndarray, "_"]) -> int:
    """Return how many nodes of a path stand before the first inscribed sphere that reaches the path's end."""
    gap = np.linalg.norm(graph.points[nodes] - graph.points[nodes[-1]], axis=1)
    clear = np.flatnonzero(gap > 2.0 * graph.clearance[nodes] + 2.0 * graph.spacing_mm)
    return max(int(clear[-1]) + 2 if len(clear) else 0, min(4, len(nodes)))


def _to_cut(
    distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], step_mm: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Draw a line out as long as the lumen keeps its width, to the cut of a vessel that ends flat.

    Each step goes on along the last ones, bent as they are, and is centred by the walls beside it alone: the cut ahead
    does not draw it back.
    """
    width = float(radius[-1])
    back = max(3, round(1.5 * width / step_mm))
    line = list(points[-2 * back - 1 :])
    kept = len(line)
    for _ in range(int(3 * width / step_mm) + 1):
        behind = min(back, len(line) - 1)
        axis = line[-1] - line[-1 - behind]
        if len(line) > 2 * behind:
            axis = 1.5 * axis - 0.5 * (line[-1 - behind] - line[-1 - 2 * behind])
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        candidate = line[-1] + step_mm * axis
        wall, rays = _section(distance_map, candidate, axis, 2 * width)
        if np.median(wall) < 0.9 * width:
            break
        shift = 2.0 / _RING * wall @ rays
        size = float(np.linalg.norm(shift))
        line.append(candidate + shift * min(0.5, 0.2 * step_mm / max(size, 1e-12)))
    added = line[kept:]
    if not added:
        return points, radius
    return np.concatenate([points, added]), np.concatenate([radius, np.full(len(added), width)])


def _section(
    distance_map: DistanceMap, point: Float[np.ndarray, "3"], tangent: Float[np.ndarray, "3"], limit_mm: float
) -> tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r 3"]]:
    """Return the distance to the wall along rays across a vessel, mm, and the rays: 0 outside, at most `limit_mm`."""
    one, two = _frame(tangent[None])
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
    line = (1 - weight) * line + weight * _smooth(line, 2.0)
    line[0] = start
    size = np.concatenate([surface.distance(line[:count]), radius])
    return line, size


def _outside(points: Float[np.ndarray, "n 3"], parent: Line) -> int:
    """Return the index of the first point from which a side branch stays outside its parent's inscribed spheres."""
    distance, nearest = KDTree(parent.points).query(points)
    inside = np.flatnonzero(distance < parent.radius[nearest])
    return int(inside[-1]) + 1 if len(inside) else 1


def _meeting_point(body: Float[np.ndarray, "n 3"], parent: Line) -> int:
    """Return the index of the parent's point that the side branch's axis, drawn back, comes nearest to."""
    start = body[: min(len(body), _STRAIGHT + 1)]
    back = np.linalg.svd(start - start.mean(axis=0))[2][0]
    back *= np.sign(back @ (start[0] - start[-1]))
    relative = parent.points - start.mean(axis=0)
    along = np.clip(relative @ back, 0.0, None)
    miss = np.linalg.norm(relative - along[:, None] * back, axis=1)
    gap = np.linalg.norm(parent.points - body[0], axis=1)
    near = gap <= 2.0 * parent.radius + gap.min()
    score = np.where(near, miss + 0.1 * gap, np.inf)
    place = int(score.argmin())
    return int(np.clip(place, 1, len(parent.points) - 2))
