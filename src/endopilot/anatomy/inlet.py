"""Where a device enters a lumen: at a given place, where the vessel leaves the aorta, or at the widest open end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Integer

from endopilot.anatomy import parent_vessel
from endopilot.anatomy.coronary_ends import OpenEnd, open_ends, skeleton_of
from endopilot.anatomy.coronary_ostia import Side, end_score
from endopilot.anatomy.distance import distance_map_from_surface
from endopilot.anatomy.line_ends import InletEnd, likely_inlets
from endopilot.anatomy.lumen_graph import lumen_graph, trace_branches
from endopilot.anatomy.surface import Surface
from endopilot.imaging.grid import connected_components
from endopilot.types import DistanceMap, Insertion

ENTRANCE_RADII = 3.0
"""An ostium given nearer than this many radii to an end of the vessel enters at that end."""

SNAP_MM, SNAP_SD_MM = 10.0, 4.0
"""A given ostium enters at an open end at most the first away; its likely error is the second."""

PLAUSIBLE = -5.0
"""An end that scores less than this does not look like an inlet: the tip of a side branch."""

LIKENESS_SD = 0.25
"""Spread of the logarithm of how much an end looks like the inlet: half the likeness is worth as much as 9 mm."""

_BRANCH_MM = 4.0


def component(distance_map: DistanceMap, given: Insertion | None) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the connected inside at the ostium, or the largest one."""
    labels = connected_components(distance_map.values > 0, corners=True)
    count = labels.max()
    if count == 1:
        return labels == 1
    if count == 0 or given is None:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        return labels == sizes.argmax()
    return part_at(distance_map, labels, given)


def grid_points(
    distance_map: DistanceMap, inside: Bool[np.ndarray, "nz ny nx"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the positions of the grid points of a lumen and their distances to the wall, both in mm."""
    points = distance_map.origin_mm + distance_map.spacing_mm * np.argwhere(inside)[:, ::-1]
    return points, distance_map.values[inside].astype(float)


def beyond_parent(
    surface: Surface,
    distance_map: DistanceMap,
    inside: Bool[np.ndarray, "nz ny nx"],
    side: Side,
    inlet: Float[np.ndarray, "3"] | None,
) -> tuple[Insertion | None, Bool[np.ndarray, "nz ny nx"]]:
    """Return the ostium and the lumen beyond it where the lumen holds a piece of the aorta; else None and the lumen.

    The aorta is looked for on a coarser grid: on that of the coronary artery it has millions of points.

    Args:
        surface: the wall.
        distance_map: distance to it.
        inside: which of its grid points belong to the lumen.
        side: which coronary artery is wanted.
        inlet: where the artery begins, LPS mm, if the lumen holds no aorta; a stub of the aorta may bulge there.
    """
    if distance_map.values[inside].max(initial=0.0) < parent_vessel.PARENT_RADIUS_MM[0]:
        return None, inside
    coarse = distance_map
    if distance_map.spacing_mm < parent_vessel.GRID_MM:
        coarse = distance_map_from_surface(surface, spacing_mm=parent_vessel.GRID_MM, band_mm=2 * parent_vessel.GRID_MM)
    within = component(coarse, None)
    points, clearance = grid_points(coarse, within)
    usual, root = 0.0, int(clearance.argmax())
    aorta = inlet is None
    if inlet is not None:
        root = int(np.linalg.norm(points - inlet, axis=1).argmin())
    graph = lumen_graph(points, clearance, coarse.spacing_mm, root)
    if not aorta:
        paths = trace_branches(graph, minimum_length_mm=_BRANCH_MM)
        usual = float(np.median(graph.clearance[np.concatenate(paths)]))
    parent = parent_vessel.parent_region(coarse, within, graph, usual)
    ostium = None if parent is None else parent_vessel.ostium_beyond(coarse, within, parent, graph, side)
    if parent is None or ostium is None:
        return None, inside
    index = np.argwhere(inside)
    places = distance_map.origin_mm + distance_map.spacing_mm * index[:, ::-1]
    nearest = np.rint((places - coarse.origin_mm) / coarse.spacing_mm).astype(int)[:, ::-1]
    nearest = np.clip(nearest, 0, np.array(parent.shape) - 1)
    beyond = inside.copy()
    beyond[tuple(index.T)] = ~parent[tuple(nearest.T)]
    labels = connected_components(beyond, corners=True)
    return ostium, part_at(distance_map, labels, ostium)


def part_at(
    distance_map: DistanceMap, labels: Integer[np.ndarray, "nz ny nx"], place: Insertion
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the labelled part of a lumen that is nearest to a place."""
    index = np.argwhere(labels > 0)
    points = distance_map.origin_mm + distance_map.spacing_mm * index[:, ::-1]
    nearest = index[np.linalg.norm(points - place.position, axis=1).argmin()]
    return labels == labels[tuple(nearest)]


def entrance(
    distance_map: DistanceMap,
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    given: Insertion,
    side: Side | None,
    surface: Surface | None = None,
) -> Insertion:
    """Return where the device enters if a place some millimetres off is given: at an end near it, or in mid-vessel.

    An end that an artery may begin at, no farther than `SNAP_MM`, is the ostium; it gets no direction, since the
    centerline gives it better. In mid-vessel the direction is away from the vessel's inlet.

    Args:
        distance_map: the wall.
        points: grid points in the lumen, LPS mm.
        clearance: their distance to the wall, mm.
        given: the place, without a direction.
        side: which coronary artery this is, None for any other vessel.
        surface: the wall as triangles, which shows where a vessel is cut.
    """
    spacing = distance_map.spacing_mm
    ends: Sequence[InletEnd | OpenEnd]
    if side is None:
        ends = looks = inlets(surface, points, clearance, spacing)
        score = np.log([max(end.score, 1e-3) / looks[0].score for end in looks]) / LIKENESS_SD
    else:
        ends = shapes = open_ends(skeleton_of(points, clearance, spacing))
        score = np.array([end_score(end, side) for end in shapes])
    gap = np.array([np.linalg.norm(end.position - given.position) for end in ends])
    offer = np.where((gap < SNAP_MM) & (score > PLAUSIBLE), score - 0.5 * (gap / SNAP_SD_MM) ** 2, -np.inf)
    if np.isfinite(offer.max()):
        return Insertion(ends[int(offer.argmax())].position, np.zeros(3))
    inlet = int(np.linalg.norm(points - ends[int(score.argmax())].position, axis=1).argmin())
    return _directed(distance_map, points, clearance, given, inlet)


def _directed(
    distance_map: DistanceMap,
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    given: Insertion,
    inlet: int,
) -> Insertion:
    """Return an ostium inside a vessel with the direction away from the inlet; one near an end gets no direction."""
    graph = lumen_graph(points, clearance, distance_map.spacing_mm, inlet)
    node = int(np.linalg.norm(graph.points - given.position, axis=1).argmin())
    reach = ENTRANCE_RADII * float(clearance[np.linalg.norm(points - given.position, axis=1) < 3.0].max(initial=1.0))
    path = [node]
    while graph.predecessor[path[-1]] >= 0 and graph.length[node] - graph.length[path[-1]] < reach:
        path.append(int(graph.predecessor[path[-1]]))
    direction = graph.points[node] - graph.points[path[-1]]
    length = float(np.linalg.norm(direction))
    ahead = (graph.points - graph.points[node]) @ direction > length * reach
    beyond = ahead & (graph.length > graph.length[node] + reach)
    if graph.length[node] < reach or length == 0.0 or not beyond.any():
        return given
    return Insertion(given.position, direction / length)


def in_front(
    points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], given: Insertion
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Leave out what lies just behind a given ostium, so that the tree grows in the catheter's direction only."""
    relative = points - given.position
    distance = np.linalg.norm(relative, axis=1)
    reach = 2.0 * max(float(clearance[distance.argmin()]), float(clearance[distance < 3.0].max(initial=0.0)))
    keep = (distance > reach) | (relative @ given.direction >= 0)
    return (points[keep], clearance[keep]) if keep.sum() > 20 else (points, clearance)


def inlets(
    surface: Surface | None, points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], spacing_mm: float
) -> list[InletEnd]:
    """Return the ends of a lumen, given as grid points; the one that looks most like its inlet comes first."""
    graph = lumen_graph(points, clearance, spacing_mm, int(clearance.argmax()))
    graph = lumen_graph(graph.points, graph.clearance, spacing_mm, int(graph.length.argmax()))
    return likely_inlets(graph, trace_branches(graph, minimum_length_mm=_BRANCH_MM), wall=surface)
