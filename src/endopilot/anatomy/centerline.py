"""Centerlines on the medial axis: `refined_lines` moves traced paths below the grid. A point moves by the first
harmonic of the exact wall distance on a ring around it, which is zero on the axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.distance import sample
from endopilot.anatomy.tree import cross_axes, resampled, smoothed, tangents
from endopilot.lines import length_along
from endopilot.types import DistanceMap, Insertion
from endopilot.vessels.graph import Line, RootedGraph
from endopilot.vessels.surface import Surface

ROUNDNESS = 0.05  # a cross-section whose half-axes differ by less than twice this share of its radius counts as round

_RING = 12
_FEWEST_DIRECTIONS = 5  # with fewer directions on the ring a vessel has too little wall to be centred by
_STRAIGHT = 10  # this many steps of a branch from where it leaves its parent show where it comes from
_NEAR_WALL = 0.8  # the ring on which the radius is measured, in distances to the wall
_CROSSED = 0.25  # a way narrower than this share of a branch's radius crosses a wall: 0.0 to 0.1 at thin flaps
_WAY = 12  # places at which such a way is looked at
_FLAT = 0.75  # a vessel whose smaller half-axis falls below this share of its radius is not drawn out any farther
_ROUND = 0.9  # a half-axis counts as different from the radius where it is smaller than this share of it
_AHEAD = 0.87  # cosine of the largest angle at which a line may leave a known ostium off the catheter's axis
_SIGHT = np.linspace(0.0, 1.0, 50)  # shares of a line of sight at which the lumen is looked at
_LED_ELSEWHERE = 2.0  # a line drawn out to its cut ends within this many radii of the tip that it was traced from
_LONGEST_BRIDGE = 4.0  # a known ostium is joined to a line that begins at most this many radii away

_REFINEMENTS = 8
_STEP_LIMIT = 0.3  # a refinement moves a point by at most this share of its distance to the wall


def refined_lines(
    surface: Surface,
    distance_map: DistanceMap,
    graph: RootedGraph,
    paths: list[Int[np.ndarray, "_"]],
    step_mm: float,
    ostium: Insertion | None = None,
) -> list[Line]:
    """Return traced paths on the medial axis, each joined to its parent where the axes meet. They are cut back from
    ends, whose caps the inscribed sphere feels, and drawn out to the cut of a vessel cut flat; the first to the ostium,
    if known."""
    home = np.full(len(graph.points), -1)
    lines: list[Line] = []
    for index, nodes in enumerate(paths):
        parent = int(home[nodes[0]]) if index else -1
        kept = nodes[: graph.before_cap(nodes)]
        if index == 0:
            kept = kept[::-1][: graph.before_cap(kept[::-1])][::-1]
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
            begun = ostium and _from_ostium(distance_map, drawn, width, points, radius, ostium, step_mm)
            points, radius = begun or _from_tip(drawn, width, points, radius, graph.points[nodes], step_mm)
        else:
            home[nodes[1:]] = len(lines)
            place = _meeting_point(distance_map, points, float(radius[0]), lines[parent])
            points, radius = _joined(surface, lines[parent], place, points, radius, step_mm)
        lines.append(Line(points, radius, parent, place))
    return lines if ostium is None else _without_inlets(distance_map, lines, ostium)


def _to_axis(
    surface: Surface, distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], parent: Line | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Move a line onto its vessel's axis; return it with its radii. Where a branch runs together with its parent, the
    directions in which it opens into the parent do not count."""
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
    """Return inscribed-sphere radii that ripples of the wall do not shrink, as the least distance around the axis
    would: the mean by direction on a ring near the wall, less the second harmonic where that is more than ripple."""
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
    distance, nearest = KDTree(parent.points).query(points)
    inside = np.flatnonzero(distance < parent.radius[nearest])
    return int(inside[-1]) + 1 if len(inside) else 1


def _meeting_point(distance_map: DistanceMap, body: Float[np.ndarray, "n 3"], radius_mm: float, parent: Line) -> int:
    """Return the parent's point that the side branch's axis, drawn back, comes nearest to, on a straight way that
    crosses no wall, such as a flap beside the tear that the branch comes through."""
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


def to_cut(
    distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], step_mm: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Draw a line out as long as the lumen keeps its width, to the cut of a vessel that ends flat, each step along the
    last ones, centred by the walls beside it. Where it grows narrow or flat, it is no longer the same vessel."""
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


def _from_ostium(
    distance_map: DistanceMap,
    drawn: Float[np.ndarray, "n 3"],
    width: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "m 3"],
    radius: Float[np.ndarray, "m"],
    ostium: Insertion,
    step_mm: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]] | None:
    """Return the first line so that it begins at a known ostium, or None where no line of sight leads there."""
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


def _from_tip(
    drawn: Float[np.ndarray, "n 3"],
    width: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "m 3"],
    radius: Float[np.ndarray, "m"],
    traced: Float[np.ndarray, "t 3"],
    step_mm: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Return the first line so that it begins at the tip that it was traced from: where a short left main meets its
    branches, a line that is cut back from the cap is cut back round the bend."""
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


def _without_inlets(distance_map: DistanceMap, lines: list[Line], ostium: Insertion) -> list[Line]:
    """Leave out lines that lead back to the ostium's own cut, the other side of a wide inlet, and no branch: in a
    dissection's merged lumens a wire beside the first line would seem to lie far ahead, on the returning part."""
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
