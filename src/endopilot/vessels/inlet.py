"""Where a device enters a lumen: at a given place, where the vessel leaves the aorta, or at the likeliest open end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.ndimage import center_of_mass, distance_transform_edt

from endopilot.imaging.grid import connected_components
from endopilot.types import DistanceMap, Insertion
from endopilot.vessels.coronary_ostia import Side, end_score
from endopilot.vessels.ends import InletEnd, OpenEnd, likely_inlets, open_ends, skeleton_of
from endopilot.vessels.graph import RootedGraph, lumen_graph
from endopilot.vessels.surface import Surface, distance_map_from_surface

Vessel = Literal["rca", "lca", "generic"]

PARENT_RATIO = 2.5  # a lumen this many times wider than the tree's median, at its inlet, is the parent vessel
PARENT_RADIUS_MM = (3.5, 6.0)  # no aortic root is narrower, no coronary artery wider (an aneurysm is)
AORTA_RADIUS_MM = 7.0  # a lumen with a coronary artery that is as wide as this somewhere holds the aorta itself
GRID_MM = 0.6  # grid spacing at which the parent vessel is looked for, mm
COMPARABLE = 0.25  # a piece with at least this share of the largest one's size may be the other coronary artery
ENTRANCE_RADII = 3.0  # an ostium given nearer than this many radii to an end of the vessel enters at that end
SNAP_MM, SNAP_SD_MM = 10.0, 4.0  # a given ostium enters at an end so near at most; its likely error
PLAUSIBLE = -5.0  # an end that scores less than this does not look like an inlet: the tip of a side branch
LIKENESS_SD = 0.25  # spread of the logarithm of likeness to an inlet: half of it is worth as much as 9 mm

_BRANCH_MM = 4.0


def piece_on_side(sizes: Float[np.ndarray, "n"], centres: Float[np.ndarray, "n 3"], vessel: Vessel) -> int:
    """Return which of several lumens (of sizes in any unit of volume) is the vessel: the largest, or of those nearly as
    large the one on an artery's side, the right coronary artery having the smaller x in LPS."""
    if vessel == "generic":
        return int(sizes.argmax())
    large = np.flatnonzero(sizes >= COMPARABLE * sizes.max())
    return int(large[(centres[large, 0] * (1 if vessel == "rca" else -1)).argmin()])


def component(distance_map: DistanceMap, given: Insertion | None) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the connected inside at the ostium, or the largest one."""
    labels = connected_components(distance_map.values > 0, corners=True)
    if given is not None and labels.max() > 1:
        return part_at(distance_map, labels, given)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()


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
    """Return the ostium and the lumen beyond it where the lumen holds a piece of the aorta (looked for on a coarser
    grid); else None and the lumen. `inlet` is where the artery begins (LPS mm) otherwise; a stub may bulge there."""
    if distance_map.values[inside].max(initial=0.0) < PARENT_RADIUS_MM[0]:
        return None, inside
    coarse = distance_map
    if distance_map.spacing_mm < GRID_MM:
        coarse = distance_map_from_surface(surface, spacing_mm=GRID_MM, band_mm=2 * GRID_MM)
    within = component(coarse, None)
    points, clearance = grid_points(coarse, within)
    root = int(clearance.argmax() if inlet is None else np.linalg.norm(points - inlet, axis=1).argmin())
    graph = lumen_graph(points, clearance, coarse.spacing_mm, root)
    usual = 0.0 if inlet is None else float(np.median(graph.radius[np.concatenate(graph.traced(_BRANCH_MM))]))
    parent = _parent_region(coarse, within, graph, usual)
    ostium = None if parent is None else _ostium_beyond(coarse, within, parent, graph, side)
    if parent is None or ostium is None:
        return None, inside
    places, _ = grid_points(distance_map, inside)
    nearest = np.rint((places - coarse.origin_mm) / coarse.spacing_mm).astype(int)[:, ::-1]
    nearest = np.clip(nearest, 0, np.array(parent.shape) - 1)
    beyond = inside.copy()
    beyond[inside] = ~parent[tuple(nearest.T)]
    labels = connected_components(beyond, corners=True)
    return ostium, part_at(distance_map, labels, ostium)


def part_at(
    distance_map: DistanceMap, labels: Integer[np.ndarray, "nz ny nx"], place: Insertion
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the labelled part of a lumen that is nearest to a place."""
    points, _ = grid_points(distance_map, labels > 0)
    return labels == labels[labels > 0][np.linalg.norm(points - place.position, axis=1).argmin()]


def entrance(
    distance_map: DistanceMap,
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    given: Insertion,
    side: Side | None,
    surface: Surface | None = None,
) -> Insertion:
    """Return where the device enters if a place some millimetres off is given: at an end within `SNAP_MM`, without a
    direction, which the centerline gives better; or in mid-vessel, away from the inlet. `clearance` is the grid points'
    distance to the wall, mm."""
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
    way = graph.back(node, graph.length[node] - graph.length >= reach)
    direction = graph.points[node] - graph.points[way[-1]]
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
    graph = lumen_graph(points, clearance, spacing_mm)
    return likely_inlets(graph, graph.traced(_BRANCH_MM), wall=surface)


def _parent_region(
    distance_map: DistanceMap, inside: Bool[np.ndarray, "nz ny nx"], graph: RootedGraph, usual_mm: float
) -> Bool[np.ndarray, "nz ny nx"] | None:
    """Return the parent vessel's grid points around the graph's root, reached by spheres of `PARENT_RATIO` times the
    usual radius; None if none. A bulge farther along is an aneurysm and stays."""
    spacing = distance_map.spacing_mm
    wide = float(np.clip(PARENT_RATIO * usual_mm, *PARENT_RADIUS_MM))
    core = inside & (distance_map.values > wide)
    if not core.any():
        return None
    root = graph.points[int(np.flatnonzero(graph.before < 0)[0])]
    points, clearance = grid_points(distance_map, core)
    gap = np.linalg.norm(points - root, axis=1)
    # The inlet lies on the parent's own wall, which is not round: at most about its width away from a centre.
    touching = np.flatnonzero(gap < 2.0 * clearance + 2.0 * spacing)
    if len(touching) == 0:
        return None
    labels = connected_components(core, corners=True)
    own = labels == labels[core][touching[gap[touching].argmin()]]
    return inside & (np.asarray(distance_transform_edt(~own)) * spacing < wide + spacing)


def _ostium_beyond(
    distance_map: DistanceMap,
    inside: Bool[np.ndarray, "nz ny nx"],
    parent: Bool[np.ndarray, "nz ny nx"],
    graph: RootedGraph,
    vessel: Vessel,
) -> Insertion | None:
    """Return where the vessel leaves its parent: the largest one, or of both coronary arteries the one wanted."""
    origin, spacing = distance_map.origin_mm, distance_map.spacing_mm
    labels = connected_components(inside & ~parent, corners=True)
    if (count := int(labels.max())) == 0:
        return None
    places = np.rint((graph.points - origin) / spacing).astype(int)[:, ::-1]
    piece = labels[tuple(places.T)]
    # How far a piece reaches beyond the parent distinguishes a vessel from a crust of the parent's wall.
    reach = np.array(
        [np.ptp(graph.length[piece == i]) if (piece == i).any() else 0.0 for i in range(1, count + 1)], dtype=float
    )
    centres = np.array(center_of_mass(labels > 0, labels, range(1, count + 1)))[:, ::-1]
    chosen = piece_on_side(reach, origin + spacing * centres, vessel)
    tip = int(np.where(piece == chosen + 1, graph.length, -1.0).argmax())
    way = graph.back(tip, piece != chosen + 1)
    # The direction is left open: the refined centerline gives it better than this grid.
    return Insertion(graph.points[way[-1]].copy(), np.zeros(3)) if len(way) >= 3 else None
