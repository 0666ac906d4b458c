"""★ From a vessel mask, a surface or centerlines to an `Anatomy` that a wire can be simulated in."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import numpy as np

from endopilot import __version__
from endopilot.anatomy import polylines, repair
from endopilot.anatomy.centerline import refined_lines
from endopilot.anatomy.coronary_inlet import CoronaryInlet, coronary_inlet
from endopilot.anatomy.distance import (
    CATHETER_RADIUS_MM,
    MAXIMUM_GRID_POINTS,
    add_catheter,
    automatic_spacing,
    catheter_tilt_deg,
    distance_map_from_spheres,
    distance_map_from_surface,
)
from endopilot.anatomy.inlet import beyond_parent, component, entrance, grid_points, in_front, widest_open_end
from endopilot.anatomy.labels import dominance, label_tree, missing_main_vessel
from endopilot.anatomy.labels_coronary import SHORT_MM
from endopilot.anatomy.lumen_graph import lumen_graph, trace_branches
from endopilot.anatomy.sources import AnatomySource, Polylines, read_source, transformed
from endopilot.anatomy.surface import Surface, surface_from_mask
from endopilot.anatomy.tree import tree_from_lines
from endopilot.anatomy.units import SMALLEST_RADIUS_MM, check_unit
from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.settings import Finite, Positive, settings
from endopilot.types import Anatomy, DistanceMap, Insertion, LumenMask, VesselTree

__all__ = ["AnatomyConfig", "extract_anatomy", "read_source"]

CORONARY_RADIUS_MM = 1.6
"""Mean radius of a coronary tree at most: what counts for the grid where a lumen holds a piece of the aorta too."""

_RESOLVED_STEPS = 1.25
"""A catheter's radius in steps of the distance map, at least: wide vessels have coarse maps."""

SHORTEST_IN_DIAMETERS = 1.5
"""A lumen whose longest path is shorter than this many of its own mean diameters is no vessel."""


@settings
class AnatomyConfig:
    """How an anatomy is made."""

    vessel: Literal["rca", "lca", "generic"] = "generic"
    """Section names: AHA/SCCT segments of the right or left coronary artery, or generation and branch order."""
    ostium_mm: tuple[Finite, Finite, Finite] | None = None
    """Where the device enters, LPS mm, within some 5 mm; by default the mask's own ostium, or else where the vessel
    looks as if it began."""
    catheter_radius_mm: Positive | None = None
    """Inner radius of the guiding catheter, mm; by default 0.9 (6 French), the ostium's where that is narrower, and
    more where the map is too coarse for it."""
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
            _check_lines(content, config, source_name)
            tree, rule = polylines.tree_from_polylines(content, given, source_name)
            inlet: CoronaryInlet | None = None
            advance(2)
            distance_map = distance_map_from_spheres(tree, spacing_mm=config.spacing_mm)
        else:
            unstated = wrapped.coordinates is None and isinstance(content, Surface)
            axes = config.coordinates if unstated else None
            surface, finest, inlet, notes = _wall(content, given, config, source_name, axes)
            advance()
            tree, rule = _tree(surface, finest, given, inlet, config, source_name)
            advance()
            distance_map = _final_map(surface, tree, config)
        advance()
        crux = None if inlet is None else inlet.crux
        tree = label_tree(tree, config.vessel, crux=crux)
        short = _short(tree, config.vessel)
        notes += short + missing_main_vessel(tree)
        insertion = _insertion(tree, given)
        ostium_radius = float(np.median(tree.branches[0].centerline.radius[:3]))
        resolved = max(CATHETER_RADIUS_MM, _RESOLVED_STEPS * distance_map.spacing_mm)
        radius = config.catheter_radius_mm or min(resolved, ostium_radius)
        distance_map = add_catheter(distance_map, insertion, radius)
        advance()
    provenance = {
        "endopilot": __version__,
        "source": _source_record(wrapped),
        "config": asdict(config),
        "ostium_rule": rule,
        **(inlet.record() if inlet is not None else {}),
        "catheter_tilt_deg": round(catheter_tilt_deg(ostium_radius, radius), 1),
        "dominance": _dominance(tree, inlet, short),
        "notes": notes,
    }
    return Anatomy(name, tree, distance_map, insertion, radius, provenance)


def _check_lines(lines: Polylines | VesselTree, config: AnatomyConfig, label: str) -> None:
    if isinstance(lines, Polylines):
        check_unit(np.concatenate(lines.points), float(np.median(np.concatenate(lines.radius))), config.vessel, label)


def _wall(
    content: LumenMask | Surface, given: Insertion | None, config: AnatomyConfig, label: str, axes: str | None
) -> tuple[Surface, float, CoronaryInlet | None, list[str]]:
    """Return the closed wall of the wanted vessel, the voxels' shortest edge (mm), its inlet if found, and repairs."""
    inlet = None
    if isinstance(content, Surface):
        check_unit(content.vertices, None, config.vessel, label)
    if given is None and config.vessel != "generic":
        inlet = coronary_inlet(content, config.vessel, label, axes)
        given = None if inlet is None else Insertion(inlet.position, np.zeros(3))
    if isinstance(content, LumenMask):
        mask, notes = repair.connected_mask(content.volume, given, label, config.vessel)
        return surface_from_mask(mask), float(mask.spacing_mm.min()), inlet, notes
    surface, notes = repair.closed_surface(content, given, label, config.vessel)
    return surface, 0.0, inlet, notes


def _short(tree: VesselTree, vessel: str) -> list[str]:
    """Say so if a coronary artery ends sooner than any does."""
    longest = float(tree.longest_path().abscissa[-1])
    if vessel == "generic" or longest >= SHORT_MM:
        return []
    name = "right" if vessel == "rca" else "left"
    return [f"the {name} coronary artery is only {longest:.0f} mm long here: it is a vestige, or cut off or occluded"]


def _dominance(tree: VesselTree, inlet: CoronaryInlet | None, short: list[str]) -> str | None:
    """Return the dominance: which of both arteries reaches the crux, or what a single one's tree shows; else None."""
    if inlet is not None and inlet.paired:
        return None if inlet.crux is None else inlet.crux.dominance
    return None if short else dominance(tree)


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
    surface: Surface,
    finest_mm: float,
    given: Insertion | None,
    inlet: CoronaryInlet | None,
    config: AnatomyConfig,
    label: str,
) -> tuple[VesselTree, str]:
    """Return the centerline tree inside a closed wall, and the rule by which its root was chosen."""
    mean_radius = 2.0 * surface.volume / surface.area
    if mean_radius < min(SMALLEST_RADIUS_MM, finest_mm):
        raise InputError(
            f"{label}: the lumen is about one voxel thick (mean radius {mean_radius:.2g} mm, voxels of "
            f"{finest_mm:.2g} mm), too thin to follow; segment on a finer grid"
        )
    check_unit(surface.vertices, mean_radius, config.vessel, label)
    if config.vessel != "generic":  # a piece of the aorta in the lumen must not set the scale
        mean_radius = min(mean_radius, CORONARY_RADIUS_MM)
    extent = np.ptp(surface.vertices, axis=0)
    spacing = max(mean_radius / 5.0, 0.5 * finest_mm, float(np.prod(extent + 2) / MAXIMUM_GRID_POINTS) ** (1 / 3))
    distance_map = distance_map_from_surface(surface, spacing_mm=spacing, band_mm=2 * spacing)
    surface = surface.refined(3.0 * spacing)
    place = Insertion(inlet.position, np.zeros(3)) if inlet is not None else None
    inside = component(distance_map, given or place)
    rule = "widest open end" if place is None else "shape of the coronary arteries"
    if given is not None:
        rule = "given" if config.ostium_mm is not None else "segmentation"
    elif config.vessel != "generic":
        stub = None if inlet is None else inlet.position
        given, inside = beyond_parent(surface, distance_map, inside, config.vessel, stub)
        rule = rule if given is None else "where the vessel leaves the aorta"
        given = given or place
    points, clearance = grid_points(distance_map, inside)
    if len(points) < 20:
        raise InputError(f"{label}: the lumen is too small to follow ({len(points)} grid points); check the unit")
    if given is None:
        root = widest_open_end(distance_map, points, clearance)
    else:
        if not given.direction.any() and rule == "given":
            side = None if config.vessel == "generic" else config.vessel
            given = entrance(distance_map, points, clearance, given, side)
        points, clearance = in_front(points, clearance, given)
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
