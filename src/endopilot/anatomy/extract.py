"""★ From a vessel mask, a surface or centerlines to an `Anatomy` that a wire can be simulated in."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from endopilot import __version__
from endopilot.anatomy.centerline import refined_lines
from endopilot.anatomy.distance import (
    CATHETER_RADIUS_MM,
    ENGAGED_MM,
    add_catheter,
    automatic_spacing,
    distance_map_from_spheres,
)
from endopilot.anatomy.labels import dominance, label_tree
from endopilot.anatomy.labels_coronary import LONGEST_LEFT_MAIN_MM, SHORT_MM
from endopilot.anatomy.tree import sampled, tree_from_lines
from endopilot.errors import InputError, place_text
from endopilot.imaging.grid import connected_components
from endopilot.progress import progress
from endopilot.settings import Finite, Within, public, settings
from endopilot.types import Anatomy, DistanceMap, Insertion, LumenMask, VesselTree
from endopilot.vessels import coverage, repair, repair_surface
from endopilot.vessels.coronary_inlet import CoronaryInlet, coronary_inlet
from endopilot.vessels.coronary_ostia import course_off_deg
from endopilot.vessels.graph import lumen_graph
from endopilot.vessels.inlet import beyond_parent, component, entrance, grid_points, in_front, inlets
from endopilot.vessels.line_graph import found_lines
from endopilot.vessels.medial_lines import traced_lines
from endopilot.vessels.sources import (
    ANSWERED,
    ASSUMED,
    SMALLEST_RADIUS_MM,
    AnatomySource,
    Polylines,
    check_unit,
    read_source,
    transformed,
    unit_name,
)
from endopilot.vessels.surface import MAXIMUM_GRID_POINTS, Surface, distance_map_from_surface, surface_from_mask
from endopilot.vessels.topology import parted, touch_remarks

CORONARY_RADIUS_MM = 1.6  # mean radius of a coronary tree at most, for the grid where the aorta is there too
_RESOLVED_STEPS = 1.25  # a catheter's radius in steps of the distance map, at least: wide vessels have coarse maps

_OTHER_SIDE_DEG = 5.0
"""A coronary artery is in doubt if its course is nearer to that of the other one by this, degrees; in 48 of the
atlas and 2 real ones its own is the nearer one by 16° at least."""

SHORTEST_IN_DIAMETERS = 1.5  # a lumen whose longest path is shorter than so many mean diameters is no vessel

_KNOWN = {ASSUMED: " (not stated)", ANSWERED: " (--scale)"}


@settings
class AnatomyConfig:
    """How an anatomy is made."""

    vessel: Literal["rca", "lca", "generic"] = "generic"
    """Section names: AHA/SCCT segments of the right or left coronary artery, or generation and branch order."""
    ostium_mm: tuple[Finite, Finite, Finite] | None = None
    """Where the device enters, LPS mm, within some 5 mm; by default the mask's own ostium, or else where the vessel
    looks as if it began."""
    catheter_radius_mm: Annotated[float, Within(0, 20, above_low=True)] | None = None
    """Inner radius of the guiding catheter, mm; by default 0.9 (6 French), the ostium's where that is narrower, and
    more where the map is too coarse for it."""
    spacing_mm: Annotated[float, Within(0.02, 5)] | None = None
    """Grid spacing of the distance map, mm; by default 0.45 times the narrow vessels' radius, from 0.3 to 1.5 mm."""
    minimum_branch_length_mm: Annotated[float, Within(0, 1000, above_low=True)] = 4.0
    """Side branches shorter than this beyond their parent's lumen are dropped, mm."""
    scale: Annotated[float, Within(1e-4, 10000)] | None = None
    """Factor that turns the file's unit into mm: 1 for mm, 10 for cm, 1000 for m; by default what the file states, or
    else mm where no other unit gives a usual vessel."""
    coordinates: Literal["lps", "ras"] | None = None
    """Axes of a surface or centerline whose file states none; LPS if not given. A file that states others is
    refused."""


@public
def extract_anatomy(
    source: str | Path | AnatomySource | LumenMask | Surface | Polylines | VesselTree,
    *,
    name: str | None = None,
    label: int | str | None = None,
    threshold: float | None = None,
    config: AnatomyConfig | None = None,
) -> Anatomy:
    """Make an anatomy: centerline tree with section labels, distance map with guiding catheter, insertion.

    Args:
        source: a file with a mask, a surface or centerlines, as `read_source` reads it; or what was read or made.
        name: short name of the patient; that of the file, or "patient", if not given.
        label: number or name of the segment that is the lumen, where a mask file has several.
        threshold: of a mask file of grey levels, the value at the wall.
        config: how to make it.

    Raises:
        InputError: the file cannot be read, or the source is empty, is no vessel, is not where the ostium is, or
            cannot be closed.
    """
    config = config or AnatomyConfig()
    if isinstance(source, str | Path):
        source = read_source(source, label=label, threshold=threshold)
    wrapped = source if isinstance(source, AnatomySource) else AnatomySource(source)
    wrapped = transformed(wrapped, scale=config.scale, coordinates=config.coordinates)
    name = name or wrapped.file.partition(".")[0] or "patient"
    content, balance, notes = wrapped.content, {}, list(wrapped.notes)
    doubts = list(content.warnings) if isinstance(content, LumenMask) else []
    given = content.ostium if isinstance(content, LumenMask) else None
    if config.ostium_mm is not None:
        given = Insertion(np.array(config.ostium_mm, dtype=float), np.zeros(3))
    source_name, unit = wrapped.file or name, {"factor": wrapped.factor, "odds": wrapped.odds}
    with progress(f"anatomy {name}", 4) as advance:
        if isinstance(content, VesselTree):
            own = [branch.centerline for branch in content.branches]
            content = Polylines(tuple(line.points for line in own), tuple(line.radius for line in own))
        elif isinstance(content, Polylines):
            points, radius = np.concatenate(content.points), np.concatenate(content.radius)
            check_unit(points, float(np.median(radius)), config.vessel, source_name, **unit)
        if isinstance(content, Polylines):
            made = found_lines(content, given, source_name, config.vessel)
            tree, rule, balance = tree_from_lines(made.lines), made.rule, made.coverage
            notes += made.notes
            inlet: CoronaryInlet | None = None
            advance(2)
            distance_map = distance_map_from_spheres(tree, spacing_mm=config.spacing_mm)
        else:
            unstated = wrapped.coordinates is None and isinstance(content, Surface)
            if isinstance(content, Surface):  # before grids of its size are made
                check_unit(content.vertices, None, config.vessel, source_name, **unit)
            axes = config.coordinates if unstated else None
            surface, lumen, widened, inlet = _wall(content, given, config, source_name, axes)
            voxels_mm = lumen.mask.spacing_mm
            check_unit(surface.vertices, surface.mean_radius, config.vessel, source_name, **unit)
            notes += lumen.notes
            advance()
            finest = float(voxels_mm.min()) if isinstance(content, LumenMask) else 0.0
            tree, rule = _tree(surface, finest, given, inlet, config, source_name)
            advance()
            distance_map = _final_map(surface, tree, config)
            left = coverage.unreached(lumen.lines, *sampled(tree), float(voxels_mm.max()))
            balance = coverage.record(lumen.lines, widened, left)
            line = tree.branches[0].centerline
            notes += coverage.left_out_text(left, line.points[0], 3.0 * float(line.radius[0]) + float(voxels_mm.max()))
        advance()
        crux = None if inlet is None else inlet.crux
        tree = label_tree(tree, config.vessel, crux=crux)
        notes += _doubts(tree, config.vessel)
        insertion = _insertion(tree, given)
        ostium_radius = float(np.median(tree.branches[0].centerline.radius[:3]))
        resolved = max(CATHETER_RADIUS_MM, _RESOLVED_STEPS * distance_map.spacing_mm)
        radius = config.catheter_radius_mm or min(resolved, ostium_radius)
        distance_map = add_catheter(distance_map, insertion, radius)
        advance()
    dominant = None if tree.longest_path().abscissa[-1] < SHORT_MM else dominance(tree)
    if inlet is not None and inlet.other is not None:
        dominant = None if inlet.crux is None else inlet.crux.dominance
    provenance = {
        "endopilot": __version__,
        "source": {
            "file": wrapped.file or None,
            "sha256": wrapped.sha256 or None,
            "kind": type(wrapped.content).__name__,
        },
        "config": asdict(config),
        "ostium_rule": rule,
        **(inlet.record() if inlet is not None else {}),
        "catheter_tilt_deg": round(float(np.degrees(np.arctan2(max(ostium_radius - radius, 0.0), ENGAGED_MM))), 1),
        "dominance": dominant,
        "coverage": balance,
        "notes": [_understood(tree, wrapped, config.coordinates), *doubts, *notes],
    }
    return Anatomy(name, tree, distance_map, insertion, radius, provenance)


def _wall(
    content: LumenMask | Surface, given: Insertion | None, config: AnatomyConfig, label: str, axes: str | None
) -> tuple[Surface, repair.Lumen, Float[np.ndarray, "wide 3"], CoronaryInlet | None]:
    """Return the vessel's closed wall, its voxels with notes of repairs, where widened (LPS mm), an artery's inlet."""
    inlet, remarks = None, list[str]()
    repair.pieces_of.cache_clear()  # what a caller's mask held before may be another vessel
    if isinstance(content, LumenMask):
        volume, remarks = repair_surface.without_wall(content.volume)
        content = replace(content, volume=volume)
    if given is None and config.vessel != "generic":
        inlet = coronary_inlet(content, config.vessel, label, axes)
        given = None if inlet is None else Insertion(inlet.position, np.zeros(3))
    if isinstance(content, LumenMask):
        lumen = repair.connected_mask(content.volume, given, label, config.vessel)
        mask, wide, thin = coverage.widened(lumen.mask, lumen.lines, config.minimum_branch_length_mm)
        finest, surface = float(mask.spacing_mm.min()), surface_from_mask(mask)
        if surface.mean_radius < min(SMALLEST_RADIUS_MM, finest):
            raise InputError(
                f"{label}: the lumen is about one voxel thick (mean radius {surface.mean_radius:.2g} mm, voxels of "
                f"{finest:.2g} mm), too thin to follow; segment on a finer grid"
            )
        return surface, replace(lumen, notes=[*remarks, *lumen.notes, *thin]), wide, inlet
    surface, notes = repair_surface.closed_surface(content, given, label, config.vessel)
    step = min(surface.mean_radius, CORONARY_RADIUS_MM) / 5.0
    voxels = coverage.voxelised(surface, max(step, SMALLEST_RADIUS_MM))
    notes += touch_remarks(parted(voxels)[1], parted=False)
    return surface, repair.Lumen(voxels, traced_lines(voxels), notes), np.empty((0, 3)), inlet


def _doubts(tree: VesselTree, vessel: str) -> list[str]:
    """Say so if a labelled coronary tree is short, runs as the other coronary artery does, or lacks a main vessel."""
    if vessel == "generic":
        return []
    asked, found, other = ("right", "left", "lca") if vessel == "rca" else ("left", "right", "rca")
    longest, off, said = float(tree.longest_path().abscissa[-1]), course_off_deg(tree), list[str]()
    if longest < SHORT_MM:
        said.append(
            f"the {asked} coronary artery is only {longest:.0f} mm long here: a vestige, or cut off or occluded"
        )
    elif off[vessel] >= off[other] + _OTHER_SIDE_DEG:
        said.append(
            f"the vessel runs as a {found} coronary artery does: {off[other]:.0f}° from the usual course of one, "
            f"{off[vessel]:.0f}° from that of the {asked} one; check --vessel, and the axes of the file"
        )
    for number, name in (("6", "anterior descending"), ("11", "circumflex")):
        if vessel == "lca" and number not in tree.sections_present:
            said.append(
                f"the left main does not fork within {LONGEST_LEFT_MAIN_MM:g} mm here: the {name} artery is missing, "
                "cut off or a piece apart, and the sections of the other one are named by its course alone"
            )
    return said


def _tree(
    surface: Surface,
    finest_mm: float,
    given: Insertion | None,
    inlet: CoronaryInlet | None,
    config: AnatomyConfig,
    label: str,
) -> tuple[VesselTree, str]:
    """Return the centerline tree inside a closed wall, and the rule by which its root was chosen."""
    mean_radius = surface.mean_radius
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
        likeliest = inlets(surface, points, clearance, spacing)[0]
        root = int(np.linalg.norm(points - likeliest.position, axis=1).argmin())
    else:
        if not given.direction.any() and rule == "given":
            side = None if config.vessel == "generic" else config.vessel
            given = entrance(distance_map, points, clearance, given, side, surface)
        points, clearance = in_front(points, clearance, given)
        root = int(np.linalg.norm(points - given.position, axis=1).argmin())
    graph = lumen_graph(points, clearance, spacing, root)
    paths = graph.traced(config.minimum_branch_length_mm)
    middle = float(np.median(graph.radius[np.concatenate(paths)]))
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
    spacing = config.spacing_mm or automatic_spacing(tree.line.radius, np.ptp(surface.vertices, axis=0) + 5.0)
    result = distance_map_from_surface(surface, spacing_mm=spacing)
    labels = connected_components(result.values > 0, corners=True)
    if labels.max() > 1:
        index = np.rint((tree.line.points - result.origin_mm) / spacing).astype(int)[:, ::-1]
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


def _understood(tree: VesselTree, source: AnatomySource, coordinates: str | None) -> str:
    """Return what was understood: inlet, extent and narrowest place, unit and axes as taken."""
    lines = [branch.centerline for branch in tree.branches]
    farthest, narrowest = max(float(line.abscissa[-1]) for line in lines), min(line.radius.min() for line in lines)
    if isinstance(source.content, LumenMask) or not source.file:
        read = "mm in LPS"
    else:
        axes = source.coordinates or coordinates
        stated = " (--coordinates)" if coordinates and not source.coordinates else "" if axes else " (not stated)"
        read = f"{unit_name(source.factor)}{_KNOWN.get(source.odds, '')} in {(axes or 'lps').upper()}{stated}"
    return (
        f"Understood: enters at {place_text(lines[0].points[0])}, {2 * lines[0].radius[0]:.1f} mm wide; "
        f"{farthest:.0f} mm to the farthest end, {2 * narrowest:.1f} mm wide at the narrowest; read as {read}"
    )
