"""What makes a segmented coronary tree doubtful: one sentence for each finding, for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from endopilot.errors import place_text
from endopilot.imaging.aortic_root import box_around, openings
from endopilot.imaging.grid import connected_components, distance_to_outside
from endopilot.imaging.vessel_tracking import CALCIUM
from endopilot.lines import length_along
from endopilot.types import Volume

_BLOCK_MM = 1.5  # slices are compared in blocks of this size, so that noise counts little
_EDGES = 98.0  # percentile of the change from slice to slice: that of the edges of heart and vessels
_STEEPEST, _OF_STEEPEST = 90.0, 60.0
"""Percentile of the gradient in the slice above which a block is an edge there, and that of the change of such edges. A
flat surface between two slices changes much of the image, but not these."""
_TISSUE_HU = (-100.0, 700.0)  # ribs and lung do not jump with the heart: edges are those between fat, muscle and blood
_STEP = 1.35  # between slabs of two heart beats, both change by this factor more than from slice to slice around it
_NEIGHBOURS = 9  # slices around a pair that tell its usual change
_LUNG_HU = -300.0
_WIDE_END_MM = 1.5  # distal ends of coronary arteries are thinner: at a wider one the vessel was lost
_END_MM = 4.0  # length of a vessel's end whose radius counts
_STUB_MM = 10.0  # shorter paths are stubs and bumps, as at the artery's mouth: nothing is lost at their wide ends
_AHEAD_MM, _AHEAD_COSINE = 7.0, 0.8  # a vessel so far beyond an end, and in its direction, continues it behind a gap
_LEAST_CONTINUATION_MM = 8.0  # a continuation is at least so long
_SHORTEST_MM = {"rca": 60.0, "lca": 60.0}  # shortest main vessels, mm: a right artery before the crux, an LAD
_SECOND_MM = 30.0  # a left tree has two vessels of at least this length, LAD and LCx
_VEIN_SHARE, _VEIN_MM, _VEIN_RADIUS_MM = 0.8, 15.0, 1.0  # a vessel this wide, dimmer over this length, is a vein
_GRAFT_MM = 12.0  # a vessel that leaves the aorta so far above the ostium is a bypass graft,
_LEFT_ABOVE_MM = 26.0
"""unless it may be the left artery: in seven patients' CT angiograms the left ostium lies 9 to 24 mm above the right
one, on the other side of the aorta, since the aortic root is tilted."""
_LEAST_GRAFT_MM3 = 100.0
_METAL_HU = 2000.0  # brighter than calcium: leads, stents, clips
_METAL_MM3, _METAL_NEAR_MM = 4.0, 15.0  # metal of this volume, so near to the tree, disturbs it
_BEYOND_MM = 10.0  # the mask of a thin distal end may be this much shorter than its path
_FILLED_MM = 2.0  # calcium or metal so near to where the mask ends fills the vessel
_WALL_HU = 50.0  # the aortic wall


@dataclass(frozen=True, eq=False)
class Scan:
    """A CT on the grid of the vessels: HU (`grid`, and `hu` lightly smoothed), HU of contrast-filled lumen, and voxels
    of blood pools and thin vessels with their vesselness."""

    grid: Volume
    hu: Float[np.ndarray, "nz ny nx"]
    lumen_hu: float
    pools: Bool[np.ndarray, "nz ny nx"]
    vessels: Bool[np.ndarray, "nz ny nx"]
    response: Float[np.ndarray, "nz ny nx"]

    @property
    def blood_hu(self) -> float:
        """HU midway between the aortic wall and lumen: what is brighter is blood."""
        return 0.5 * (self.lumen_hu + _WALL_HU)


@dataclass(frozen=True, eq=False)
class FoundTree(Scan):
    """A coronary tree in a scan: paths (LPS mm, radii) from the ostium to every end, each from where it leaves those
    before it; `aorta` and `lumen` lie on `volume`'s voxels."""

    volume: Volume
    aorta: Bool[np.ndarray, "nz ny nx"]
    tree: Bool[np.ndarray, "nz ny nx"]
    ostium: Float[np.ndarray, "3"]
    paths: Sequence[Float[np.ndarray, "_ 3"]]
    radius: Sequence[Float[np.ndarray, "_"]]
    lumen: Bool[np.ndarray, "_ _ _"]


def coronary_doubts(found: FoundTree, vessel: str) -> tuple[str, ...]:
    """Return what is doubtful about a right ("rca") or left ("lca") tree: nothing for a clean one."""
    return (
        *_steps(found.volume),
        *_metal(found),
        *_lost_ends(found),
        *_filled(found),
        *_missing(found, vessel),
        *_grafts(found, vessel),
        *_veins(found),
    )


def _steps(volume: Volume) -> list[str]:
    """Tell where the heart jumps from one slice to the next."""
    size = [max(round(_BLOCK_MM / spacing), 1) for spacing in volume.spacing_mm[:2]]
    voxels = volume.voxels
    rows, columns = (extent // side for extent, side in zip(voxels.shape[1:], size[::-1], strict=True))
    trimmed = voxels[:, : rows * size[1], : columns * size[0]].astype(np.float32)
    blocks = np.maximum(trimmed.reshape(len(voxels), rows, size[1], columns, size[0]).mean(axis=(2, 4)), _LUNG_HU)
    everywhere = np.percentile(np.abs(np.diff(blocks, axis=0)), _EDGES, axis=(1, 2))
    change = np.minimum(_over_usual(everywhere), _over_usual(_change_of_edges(blocks)))
    steps = np.flatnonzero(change > _STEP)
    if len(steps) == 0:
        return []
    # The blur spreads a step over neighbouring slices: the largest change is its place.
    apart = np.split(steps, np.flatnonzero(np.diff(steps) > 2) + 1)
    steps = [run[change[run].argmax()] for run in apart]
    middle = (np.array(voxels.shape[2:0:-1]) - 1) / 2
    levels = ", ".join(f"{volume.index_to_world(np.array([*middle, k + 0.5]))[2]:.0f}" for k in steps)
    return [
        f"step artefacts at z {levels} mm: the heart lies elsewhere on the other side; vessels may end or be displaced "
        "there; take another phase, or check the mask there"
    ]


def _change_of_edges(blocks: Float[np.ndarray, "nz ny nx"]) -> Float[np.ndarray, "_"]:
    """Return by how much the edges in each slice change to the next, HU."""
    tissue = np.clip(blocks, *_TISSUE_HU)
    found = []
    for before, after in pairwise(tissue):
        both = before + after
        steepness = np.hypot(ndimage.sobel(both, 0), ndimage.sobel(both, 1))
        edges = steepness >= np.percentile(steepness, _STEEPEST)
        found.append(np.percentile(np.abs(after - before)[edges], _OF_STEEPEST))
    return np.array(found)


def _over_usual(change: Float[np.ndarray, "_"]) -> Float[np.ndarray, "_"]:
    return change / np.maximum(ndimage.median_filter(change, _NEIGHBOURS, mode="nearest"), 1e-6)


def _metal(found: FoundTree) -> list[str]:
    label = connected_components(found.grid.voxels > _METAL_HU, corners=True)
    if label.max() == 0:
        return []
    cell = float(found.grid.spacing_mm.prod())
    large = np.flatnonzero(np.bincount(label.ravel())[1:] * cell >= _METAL_MM3) + 1
    voxels = np.argwhere(np.isin(label, large))
    if len(voxels) == 0:
        return []
    places = found.grid.index_to_world(voxels[:, ::-1].astype(float))
    near = distance_to_outside(~found.tree, float(found.grid.spacing_mm[0]))[tuple(voxels.T)]
    if near.min() > _METAL_NEAR_MM:
        return []
    return [
        f"metal {near.min():.0f} mm from the vessel, at {place_text(places[near.argmin()])}: streaks and blooming may "
        "hide the lumen there or add to it; check the mask there"
    ]


def _lost_ends(found: FoundTree) -> list[str]:
    """Tell ends that are wide, and ends behind which a vessel goes on."""
    label = connected_components(found.vessels & ~found.tree, corners=True)
    others = np.argwhere(label > 0)
    numbers = label[tuple(others.T)]
    points = found.grid.index_to_world(others[:, ::-1].astype(float))
    doubts = []
    for path, radius in zip(found.paths, found.radius, strict=True):
        to_end = np.linalg.norm(path - path[-1], axis=1)
        if to_end[0] < _STUB_MM:
            continue
        wide = float(np.median(radius[to_end <= _END_MM]))
        if _goes_on(path, points, numbers, found):
            doubts.append(
                f"a vessel ends at {place_text(path[-1])} and seems to go on behind a gap; give a seed beyond it"
            )
        elif wide >= _WIDE_END_MM:
            doubts.append(
                f"a vessel ends at {place_text(path[-1])} while it is still {2 * wide:.1f} mm wide; its rest may be "
                "missing"
            )
    return doubts


def _goes_on(path: np.ndarray, points: np.ndarray, numbers: np.ndarray, found: FoundTree) -> bool:
    """Return whether another vessel, as bright as the lumen, begins ahead of a path's end."""
    to_end = np.linalg.norm(path - path[-1], axis=1)
    before = path[int(np.argmax(to_end <= _AHEAD_MM))]
    heading = (path[-1] - before) / max(float(np.linalg.norm(path[-1] - before)), 1e-9)
    offset = points - path[-1]
    distance = np.linalg.norm(offset, axis=1)
    ahead = (distance <= _AHEAD_MM) & (offset @ heading >= _AHEAD_COSINE * distance)
    for number in np.unique(numbers[ahead]):
        other = points[numbers == number]
        index = np.round(found.grid.world_to_index(other)).astype(int)[:, ::-1]
        bright = float(np.quantile(found.hu[tuple(index.T)], 0.9)) > _VEIN_SHARE * found.lumen_hu
        reach = np.linalg.norm(other - path[-1], axis=1)
        # It leads away from the end: it begins there, and does not pass by.
        along = float(((other - path[-1])[reach.argmax()] @ heading) / reach.max())
        if bright and np.ptp(reach) >= _LEAST_CONTINUATION_MM and along > 0:
            return True
    return False


def _filled(found: FoundTree) -> list[str]:
    """Tell where the mask ends at calcium or metal long before the vessel does."""
    doubts, places = [], np.zeros((0, 3))
    for path in found.paths:
        index = np.round(found.volume.world_to_index(path)).astype(int)[:, ::-1]
        index = np.clip(index, 0, np.array(found.lumen.shape) - 1)
        inside = np.flatnonzero(found.lumen[tuple(index.T)])
        if len(inside) == 0:  # it leaves a vessel that is reported
            continue
        last = inside[-1]
        beyond = float(np.linalg.norm(np.diff(path[last:], axis=0), axis=1).sum())
        box = box_around(index[last : last + 1], _FILLED_MM / found.volume.spacing_mm[::-1], found.lumen.shape)
        known = (np.linalg.norm(places - path[last], axis=1) < _STUB_MM).any()  # of a branch that leaves there
        if not known and beyond > _BEYOND_MM and float(found.volume.voxels[box].max()) > CALCIUM * found.lumen_hu:
            places = np.vstack([places, path[last]])
            doubts.append(
                f"calcium or metal fills a vessel at {place_text(path[last])}: the mask ends there, and {beyond:.0f} "
                "mm of the vessel beyond are not in it"
            )
    return doubts


def _missing(found: FoundTree, vessel: str) -> list[str]:
    """Tell trees that are shorter than main vessels are, and left trees of one vessel."""
    lengths = sorted((float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in found.paths), reverse=True)
    if lengths[0] < _SHORTEST_MM[vessel]:
        return [f"the tree ends {lengths[0]:.0f} mm from its ostium: main vessels are longer; most of it is missing"]
    if vessel == "lca" and (len(lengths) < 2 or lengths[1] < _SECOND_MM):
        return ["the left tree has one long vessel: the LAD or the LCx is missing"]
    return []


def _grafts(found: FoundTree, vessel: str) -> list[str]:
    """Tell vessels that leave the aorta far above the ostium."""
    if not found.aorta.any():
        return []
    label = connected_components(found.vessels | found.tree, corners=True)
    sizes = np.bincount(label.ravel()) * float(found.grid.spacing_mm.prod())
    tree = set(np.unique(label[found.tree]).tolist())
    spacing = float(found.grid.spacing_mm[0])
    places = [
        (found.grid.index_to_world(opening.voxel[::-1].astype(float)), opening.vessel)
        for opening in openings(found.hu, found.blood_hu, found.aorta, label, spacing)
        if sizes[opening.vessel] >= _LEAST_GRAFT_MM3
    ]
    lowest = min([found.ostium[2], *(place[2] for place, number in places if number in tree)])
    return [
        f"a vessel leaves the aorta at {place_text(place)}, {place[2] - lowest:.0f} mm above the ostium: probably a "
        "bypass graft; "
        + ("it joins the tree and is part of the mask" if number in tree else "it is not part of the mask")
        for place, number in places
        if place[2] - lowest > (_LEFT_ABOVE_MM if vessel == "rca" and _across_aorta(found, place) else _GRAFT_MM)
    ]


def _across_aorta(found: FoundTree, place: Float[np.ndarray, "3"]) -> bool:
    """Return whether a place at the aorta's wall lies on the other side of its axis than the ostium."""
    outward = []
    for point in (found.ostium, place):
        index = found.grid.world_to_index(point)
        rows, columns = np.nonzero(found.aorta[np.clip(round(index[2]), 0, len(found.aorta) - 1)])
        outward.append(index[:2] - (columns.mean(), rows.mean()) if len(rows) else np.zeros(2))
    return bool(outward[0] @ outward[1] < 0)


def _veins(found: FoundTree) -> list[str]:
    """Tell wide vessels of the tree whose blood is dimmer than the lumen."""
    doubts = []
    for path, radius in zip(found.paths, found.radius, strict=True):
        hu = ndimage.map_coordinates(found.hu, found.grid.world_to_index(path)[:, ::-1].T, order=1, mode="nearest")
        dim = (ndimage.median_filter(hu, 15, mode="nearest") < _VEIN_SHARE * found.lumen_hu) & (
            radius >= _VEIN_RADIUS_MM
        )
        along = length_along(path)
        places = np.flatnonzero(dim)
        runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if len(places) else []
        inside = max(runs, key=lambda run: along[run[-1]] - along[run[0]], default=places)
        if len(inside) and along[inside[-1]] - along[inside[0]] >= _VEIN_MM:
            middle = inside[len(inside) // 2]
            doubts.append(
                f"a vessel at {place_text(path[middle])} has {np.median(hu[inside]):.0f} HU where the lumen has "
                f"{found.lumen_hu:.0f}: a vein may have been taken for the artery; check the mask there"
            )
    return doubts
