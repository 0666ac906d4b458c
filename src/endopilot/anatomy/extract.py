"""★ From a vessel mask, a surface or centerlines to an `Anatomy` that a wire can be simulated in."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.stats import rankdata

from endopilot import __version__
from endopilot.anatomy import parent_vessel, polylines, repair
from endopilot.anatomy.centerline import refined_lines
from endopilot.anatomy.distance import (
    MAXIMUM_GRID_POINTS,
    add_catheter,
    automatic_spacing,
    distance_map_from_spheres,
    distance_map_from_surface,
)
from endopilot.anatomy.labels import dominance, label_tree
from endopilot.anatomy.line_ends import end_score
from endopilot.anatomy.lumen_graph import lumen_graph, trace_branches
from endopilot.anatomy.sources import AnatomySource, Polylines, read_source, transformed
from endopilot.anatomy.surface import Surface, surface_from_mask
from endopilot.anatomy.tree import tree_from_lines
from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.settings import Finite, Positive, settings
from endopilot.types import Anatomy, DistanceMap, Insertion, LumenMask, VesselTree

__all__ = ["AnatomyConfig", "extract_anatomy", "read_source"]

SMALLEST_MEAN_RADIUS_MM, LARGEST_MEAN_RADIUS_MM = 0.25, 40.0
"""Vessels that a guidewire enters have mean radii between these; others suggest a wrong unit."""

CORONARY_RADIUS_MM = 1.6
"""Mean radius of a coronary tree at most: what counts for the grid where a lumen holds a piece of the aorta too."""

ENTRANCE_RADII = 3.0
"""An ostium given nearer than this many radii to an end of the vessel enters at that end."""

SHORTEST_IN_DIAMETERS = 1.5
"""A lumen whose longest path is shorter than this many of its own mean diameters is no vessel."""


@settings
class AnatomyConfig:
    """How an anatomy is made."""

    vessel: Literal["rca", "lca", "generic"] = "generic"
    """Section names: AHA/SCCT segments of the right or left coronary artery, or generation and branch order."""
    ostium_mm: tuple[Finite, Finite, Finite] | None = None
    """Where the device enters, LPS mm; by default the mask's own ostium, or else the widest open end."""
    catheter_radius_mm: Positive | None = None
    """Inner radius of the guiding catheter, mm; by default the lumen's radius at the ostium."""
    spacing_mm: Positive | None = None
    """Grid spacing of the distance map, mm; by default 0.45 times the narrow vessels' radius, from 0.3 to 1.5 mm."""
    minimum_branch_length_mm: Positive = 4.0
    """Side branches shorter than this beyond their parent's lumen are dropped, mm."""
    scale: Positive = 1.0
    """Factor that turns the file's unit into mm: 10 for cm, 1000 for m."""
    coordinates: Literal["lps", "ras"] = "lps"
    """Axes of a surface or VTP file, which does not state them. Masks and Slicer markups do, and ignore this."""


def extract_anatomy(
    source: str | Path | AnatomySource | LumenMask | Surface | Polylines | VesselTree,
    *,
    name: str | None = None,
    label: int | None = None,
    config: AnatomyConfig = AnatomyConfig(),
) -> Anatomy:
    """Make an anatomy: centerline tree with section labels, distance map with guiding catheter, insertion.

    Args:
        source: a file with a mask, a surface or centerlines, as `read_source` reads it; or what was read or made.
        name: short name of the patient; that of the file, or "patient", if not given.
        label: which label of a mask file with several is the lumen.
        config: how to make it.

    Raises:
        InputError: the file cannot be read, or the source is empty, is no vessel, is not where the ostium is, or
            cannot be closed.
    """
    if isinstance(source, str | Path):
        source = read_source(source, label=label)
    wrapped = source if isinstance(source, AnatomySource) else AnatomySource(source)
    wrapped = transformed(wrapped, scale=config.scale, coordinates=config.coordinates)
    name = name or wrapped.file.partition(".")[0] or "patient"
    content, notes = wrapped.content, []
    given = content.ostium if isinstance(content, LumenMask) else None
    if config.ostium_mm is not None:
        given = Insertion(np.array(config.ostium_mm, dtype=float), np.zeros(3))
    source_name = wrapped.file or name
    with progress(f"anatomy {name}", 4) as advance:
        if isinstance(content, (Polylines, VesselTree)):
            tree, rule = polylines.tree_from_polylines(content, given, source_name)
            advance(2)
            distance_map = distance_map_from_spheres(tree, spacing_mm=config.spacing_mm)
        else:
            if isinstance(content, LumenMask):
                mask, remarks = repair.connected_mask(content.volume, given, source_name, config.vessel)
                surface, finest = surface_from_mask(mask), float(mask.spacing_mm.min())
            else:
                surface, remarks = repair.closed_surface(content, given, source_name, config.vessel)
                finest = 0.0
            notes += remarks
            advance()
            tree, rule = _tree(surface, finest, given, config, source_name)
            advance()
            distance_map = _final_map(surface, tree, config)
        advance()
        tree = label_tree(tree, config.vessel)
        insertion = _insertion(tree, given)
        radius = config.catheter_radius_mm or float(np.median(tree.branches[0].centerline.radius[:3]))
        distance_map = add_catheter(distance_map, insertion, radius)
        advance()
    provenance = {
        "endopilot": __version__,
        "source": _source_record(wrapped),
        "config": asdict(config),
        "ostium_rule": rule,
        "dominance": dominance(tree),
        "notes": notes,
    }
    return Anatomy(name, tree, distance_map, insertion, radius, provenance)


def _source_record(source: AnatomySource) -> dict[str, str | None]:
    """Return what the anatomy was made from: its file and hash, or the hash of arrays that came from no file."""
    digest, content = source.sha256, source.content
    if not digest:
        arrays: list[np.ndarray]
        if isinstance(content, LumenMask):
            volume = content.volume
            arrays = [volume.voxels, volume.spacing_mm, volume.origin_mm, volume.direction]
        elif isinstance(content, Surface):
            arrays = [content.vertices, content.faces]
        elif isinstance(content, VesselTree):
            arrays = [part for b in content.branches for part in (b.centerline.points, b.centerline.radius)]
        else:
            arrays = [*content.points, *content.radius]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()
    return {"file": source.file or None, "sha256": digest, "kind": type(content).__name__}


def _tree(
    surface: Surface, finest_mm: float, given: Insertion | None, config: AnatomyConfig, label: str
) -> tuple[VesselTree, str]:
    """Return the centerline tree inside a closed wall, and the rule by which its root was chosen."""
    mean_radius = 2.0 * surface.volume / surface.area
    if mean_radius < min(SMALLEST_MEAN_RADIUS_MM, finest_mm):
        raise InputError(
            f"{label}: the lumen is about one voxel thick (mean radius {mean_radius:.2g} mm, voxels of "
            f"{finest_mm:.2g} mm), too thin to follow; segment on a finer grid"
        )
    if not SMALLEST_MEAN_RADIUS_MM <= mean_radius <= LARGEST_MEAN_RADIUS_MM:
        raise InputError(
            f"{label}: the lumen's mean radius is {mean_radius:.3g} mm, which no vessel has; "
            "if the file is in m or cm, use --scale 1000 or --scale 10"
        )
    if config.vessel != "generic":  # a piece of the aorta in the lumen must not set the scale
        mean_radius = min(mean_radius, CORONARY_RADIUS_MM)
    extent = np.ptp(surface.vertices, axis=0)
    spacing = max(mean_radius / 5.0, 0.5 * finest_mm, float(np.prod(extent + 2) / MAXIMUM_GRID_POINTS) ** (1 / 3))
    distance_map = distance_map_from_surface(surface, spacing_mm=spacing, band_mm=2 * spacing)
    surface = surface.refined(3.0 * spacing)
    inside = _component(distance_map, given)
    rule = "widest open end"
    if given is not None:
        rule = "given" if config.ostium_mm is not None else "segmentation"
    elif config.vessel != "generic":
        given, inside = _beyond_parent(surface, distance_map, inside, config)
        rule = rule if given is None else "where the vessel leaves the aorta"
    points, clearance = _grid_points(distance_map, inside)
    if len(points) < 20:
        raise InputError(f"{label}: the lumen is too small to follow ({len(points)} grid points); check the unit")
    if given is None:
        root = _widest_open_end(distance_map, points, clearance, config)
    else:
        if not given.direction.any() and rule == "given":
            given = _directed(distance_map, points, clearance, given, config)
        points, clearance = _in_front(points, clearance, given)
        root = int(np.linalg.norm(points - given.position, axis=1).argmin())
    graph = lumen_graph(points, clearance, spacing, root)
    paths = trace_branches(graph, minimum_length_mm=config.minimum_branch_length_mm)
    middle = float(np.median(graph.clearance[np.concatenate(paths)]))
    step = float(np.clip(0.3 * middle, 0.25, 2.0))
    ostium = given if given is not None and given.direction.any() else None
    lines = refined_lines(surface, distance_map, graph, paths, step, ostium)
    tree = tree_from_lines(lines)
    longest = tree.longest_path()
    if longest.abscissa[-1] < SHORTEST_IN_DIAMETERS * 2 * float(longest.radius.mean()):
        raise InputError(
            f"{label}: is no vessel: its longest path of {longest.abscissa[-1]:.1f} mm is not much more than its width "
            f"of {2 * longest.radius.mean():.1f} mm; check the label or the segmentation"
        )
    return tree, rule


def _component(distance_map: DistanceMap, given: Insertion | None) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the connected inside at the ostium, or the largest one."""
    from scipy.ndimage import label

    labels, count = label(distance_map.values > 0, structure=np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    if count <= 1 or given is None:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        return labels == sizes.argmax()
    return _part_at(distance_map, labels, given)


def _grid_points(
    distance_map: DistanceMap, inside: Bool[np.ndarray, "nz ny nx"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the positions of the grid points of a lumen and their distances to the wall, both in mm."""
    points = distance_map.origin_mm + distance_map.spacing_mm * np.argwhere(inside)[:, ::-1]
    return points, distance_map.values[inside].astype(float)


def _beyond_parent(
    surface: Surface, distance_map: DistanceMap, inside: Bool[np.ndarray, "nz ny nx"], config: AnatomyConfig
) -> tuple[Insertion | None, Bool[np.ndarray, "nz ny nx"]]:
    """Return the ostium and the lumen beyond it where the lumen holds a piece of the aorta; else None and the lumen.

    The aorta is looked for on a coarser grid: on that of the coronary artery it has millions of points.
    """
    from scipy.ndimage import label

    if distance_map.values[inside].max(initial=0.0) < parent_vessel.PARENT_RADIUS_MM[0]:
        return None, inside
    coarse = distance_map
    if distance_map.spacing_mm < parent_vessel.GRID_MM:
        coarse = distance_map_from_surface(surface, spacing_mm=parent_vessel.GRID_MM, band_mm=2 * parent_vessel.GRID_MM)
    within = _component(coarse, None)
    points, clearance = _grid_points(coarse, within)
    usual, root = 0.0, int(clearance.argmax())
    aorta = clearance.max() > parent_vessel.AORTA_RADIUS_MM
    if not aorta:  # a bulge: the aorta's stub if it is at the inlet, else an aneurysm
        root = _widest_open_end(coarse, points, clearance, config)
        height = points[:, 2]
        if height[root] < height.max() - float(np.ptp(height)) / 3:  # the coronary ostia lie high in their trees
            return None, inside
    graph = lumen_graph(points, clearance, coarse.spacing_mm, root)
    if not aorta:
        paths = trace_branches(graph, minimum_length_mm=config.minimum_branch_length_mm)
        usual = float(np.median(graph.clearance[np.concatenate(paths)]))
    parent = parent_vessel.parent_region(coarse, within, graph, usual)
    ostium = None if parent is None else parent_vessel.ostium_beyond(coarse, within, parent, graph, config.vessel)
    if parent is None or ostium is None:
        return None, inside
    index = np.argwhere(inside)
    places = distance_map.origin_mm + distance_map.spacing_mm * index[:, ::-1]
    nearest = np.rint((places - coarse.origin_mm) / coarse.spacing_mm).astype(int)[:, ::-1]
    nearest = np.clip(nearest, 0, np.array(parent.shape) - 1)
    beyond = inside.copy()
    beyond[tuple(index.T)] = ~parent[tuple(nearest.T)]
    labels, _ = label(beyond, structure=np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    return ostium, _part_at(distance_map, labels, ostium)


def _part_at(
    distance_map: DistanceMap, labels: Integer[np.ndarray, "nz ny nx"], place: Insertion
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the labelled part of a lumen that is nearest to a place."""
    index = np.argwhere(labels > 0)
    points = distance_map.origin_mm + distance_map.spacing_mm * index[:, ::-1]
    nearest = index[np.linalg.norm(points - place.position, axis=1).argmin()]
    return labels == labels[tuple(nearest)]


def _directed(
    distance_map: DistanceMap,
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    given: Insertion,
    config: AnatomyConfig,
) -> Insertion:
    """Return an ostium inside a vessel with the direction away from the inlet; one near an end gets no direction."""
    inlet = _widest_open_end(distance_map, points, clearance, config)
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


def _in_front(
    points: Float[np.ndarray, "n 3"], clearance: Float[np.ndarray, "n"], given: Insertion
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Leave out what lies just behind a given ostium, so that the tree grows in the catheter's direction only."""
    relative = points - given.position
    distance = np.linalg.norm(relative, axis=1)
    reach = 2.0 * max(float(clearance[distance.argmin()]), float(clearance[distance < 3.0].max(initial=0.0)))
    keep = (distance > reach) | (relative @ given.direction >= 0)
    return (points[keep], clearance[keep]) if keep.sum() > 20 else (points, clearance)


def _widest_open_end(
    distance_map: DistanceMap,
    points: Float[np.ndarray, "n 3"],
    clearance: Float[np.ndarray, "n"],
    config: AnatomyConfig,
) -> int:
    """Return the grid point at the end that looks most like the inlet: wide, cut open, for coronaries high up."""
    spacing = distance_map.spacing_mm
    graph = lumen_graph(points, clearance, spacing, int(clearance.argmax()))
    first = int(graph.length.argmax())
    graph = lumen_graph(graph.points, graph.clearance, spacing, first)
    paths = trace_branches(graph, minimum_length_mm=config.minimum_branch_length_mm)
    ends = [*paths, paths[0][::-1]]
    tips = np.array([graph.points[path[-1]] for path in ends])
    score = np.array([end_score(distance_map, graph, path) for path in ends])
    middle = np.concatenate(paths)
    score *= [0.6 + 0.4 * _tapering(graph.points[middle], graph.clearance[middle], tip) for tip in tips]
    if config.vessel != "generic":  # the coronary ostia lie at the top of their trees
        score *= 0.5 + (tips[:, 2] - tips[:, 2].min()) / max(float(np.ptp(tips[:, 2])), 1.0)
    return int(np.linalg.norm(points - tips[score.argmax()], axis=1).argmin())


def _tapering(points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], tip: Float[np.ndarray, "3"]) -> float:
    """Return how steadily a tree narrows away from an end: its rank correlation, −1 where it widens throughout."""
    distance = np.linalg.norm(points - tip, axis=1)
    ranks = np.stack([rankdata(distance), rankdata(radius)])
    return -float(np.corrcoef(ranks)[0, 1]) if len(points) > 3 else 0.0


def _final_map(surface: Surface, tree: VesselTree, config: AnatomyConfig) -> DistanceMap:
    """Return the distance map at its final spacing, without lumens that the tree does not reach."""
    from scipy.ndimage import label

    radius = np.concatenate([branch.centerline.radius for branch in tree.branches])
    points = np.concatenate([branch.centerline.points for branch in tree.branches])
    spacing = config.spacing_mm or automatic_spacing(radius, np.ptp(surface.vertices, axis=0) + 5.0)
    result = distance_map_from_surface(surface, spacing_mm=spacing)
    labels, count = label(result.values > 0, structure=np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    if count > 1:
        index = np.rint((points - result.origin_mm) / spacing).astype(int)[:, ::-1]
        index = np.clip(index, 0, np.array(result.values.shape) - 1)
        reached = np.unique(labels[tuple(index.T)])
        foreign = (labels > 0) & ~np.isin(labels, reached)
        result.values[foreign] = result.values.min()
    return result


def _insertion(tree: VesselTree, given: Insertion | None) -> Insertion:
    """Return the ostium at the tree's start, with the given direction if it agrees with the vessel's."""
    line = tree.branches[0].centerline
    reach = min(len(line.points) - 1, max(2, int(np.searchsorted(line.abscissa, line.radius[0]))))
    direction = line.points[reach] - line.points[0]
    direction /= np.linalg.norm(direction)
    if given is not None and float(given.direction @ direction) > 0.5:
        direction = given.direction / np.linalg.norm(given.direction)
    return Insertion(position=line.points[0].copy(), direction=direction)
