"""One coronary tree, from its ostium to its distal ends, in a cardiac CT angiogram: automatic.

1. The ascending aorta is found as the largest round bright disc that persists from slice to slice; its median HU tell
   how bright contrast-filled lumen is in this scan.
2. Bright voxels that a ball of 3.5 mm fits in are aorta, chambers and large veins. Of the others, those that look like
   the middle of a bright tube at some scale are vessels.
3. The connected vessel that comes to the aorta's wall on the right side of it is the tree wanted; its paths are tracked
   to the distal ends, and its axis is drawn back to the aortic wall, which is the ostium.
4. Around the paths, the wall is where HU pass half way from the lumen to what lies beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from endopilot.errors import InputError
from endopilot.imaging.aortic_root import AorticRoot, find_aortic_root
from endopilot.imaging.contour import lumen_at_half_height
from endopilot.imaging.grid import connected_components, distance_to_outside, interpolate_like, resample
from endopilot.imaging.segment import SegmentConfig
from endopilot.imaging.tracking import track_tree
from endopilot.imaging.vesselness import vesselness
from endopilot.progress import progress
from endopilot.types import Insertion, LumenMask, Volume

_ROOT_GRID_MM = 1.5
_BODY_GRID_MM = 1.0
_GRID_MM = 0.5
"""Grids on which the aorta, the large blood pools and the vessels are sought."""
_MUSCLE_HU = 100.0
"""Myocardium in the arterial phase."""
_LOW_SHARE = 0.25
"""A vessel's voxels rise this share of the way from muscle to lumen; small vessels are dimmed by the scanner's blur."""
_POOL_RADIUS_MM = 3.5
"""A ball of this radius fits in chambers and great vessels, and in no coronary artery."""
_RESPONSE = 0.15
"""Vesselness of a vessel's voxels."""
_SCALES_MM = (0.6, 0.9, 1.3, 1.9)
"""Scales of the vesselness: they answer most to radii of 0.8 to 2.7 mm."""
_GAP_MM = 1.0
"""Voxels between vessels this close together are bridged, if they are bright."""
_TO_WALL_MM = 3.5
"""Vesselness fades where the artery opens into the aorta: the tree starts within this distance of the wall."""
_SEED_MM = 5.0
"""A seed belongs to the vessel within this distance."""
_LEAST_TREE_MM3 = 40.0
"""A smaller connected vessel is no coronary tree."""
_AXIS_MM = 5.0
"""Length of the vessel's beginning that gives its axis at the ostium, mm."""
_WALL_HU = 50.0
"""The aortic wall."""
_WALL_BALL_MM = 7.0
"""Ball that opens the aorta to find its surface under the artery's mouth."""
_OSTIUM_BOX = 40
"""Half the edge of the box around the ostium in which the aortic wall is sought, voxels of the vessels' grid."""
_OSTIUM_REACH_MM = 8.0
"""Around the ostium, the plane across the vessel cuts, and nothing else."""
_SIDE = {"rca": (-0.64, -0.77), "lca": (0.77, 0.64)}
"""Direction (x, y) from the aorta's axis to each ostium: the right one lies to the front and right, the left one to the
left and back."""


@dataclass(frozen=True, eq=False)
class _Scan:
    """What is known of the scan on the grid of the vessels.

    Attributes:
        grid: CT in HU.
        hu: the same, lightly smoothed.
        lumen_hu: HU of contrast-filled lumen.
        pools: aorta, chambers, great vessels.
        vessels: voxels of thin vessels.
        response: vesselness.
    """

    grid: Volume
    hu: Float[np.ndarray, "nz ny nx"]
    lumen_hu: float
    pools: Bool[np.ndarray, "nz ny nx"]
    vessels: Bool[np.ndarray, "nz ny nx"]
    response: Float[np.ndarray, "nz ny nx"]


def segment_lumen(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Segment the right or left coronary tree.

    Without seeds everything is found automatically. The first seed overrides where the tree begins, the others add
    distal ends that must be reached.

    Raises:
        InputError: there is no contrast, no aorta, no such vessel at its wall, or no vessel at a seed.
    """
    with progress("Segmenting the coronary tree", 5) as advance:
        root = find_aortic_root(resample(volume, _ROOT_GRID_MM))
        advance()
        scan = _find_vessels(volume, root.blood_hu)
        advance()
        aorta = _aorta(scan, root)
        tree, start = _choose_tree(scan, root, aorta, config)
        advance()
        ends = [_vessel_near(scan, tree, seed) for seed in config.seeds[1:]]
        paths = [
            scan.grid.index_to_world(path[:, ::-1]) for path in track_tree(scan.response, tree, start, ends, _GRID_MM)
        ]
        advance()
        ostium = _ostium(paths[0], scan, aorta)
        mask = _refine(volume, scan, paths, ostium)
        advance()
    return LumenMask(Volume(mask, volume.spacing_mm, volume.origin_mm, volume.direction), ostium)


def _find_vessels(volume: Volume, lumen_hu: float) -> _Scan:
    """Tell blood pools and thin vessels apart."""
    low = _MUSCLE_HU + _LOW_SHARE * (lumen_hu - _MUSCLE_HU)
    body = resample(volume, _BODY_GRID_MM)
    depth = distance_to_outside(ndimage.gaussian_filter(body.voxels, 0.35) > low, _BODY_GRID_MM)
    # Opening by a ball, and half a voxel of the body's grid more, so that no rim of a pool is left.
    beyond = distance_to_outside(depth < _POOL_RADIUS_MM, _BODY_GRID_MM) - _POOL_RADIUS_MM - _BODY_GRID_MM / 2
    grid = resample(volume, _GRID_MM)
    pools = interpolate_like(Volume(beyond, body.spacing_mm, body.origin_mm, body.direction), grid, outside=1.0) <= 0
    hu = ndimage.gaussian_filter(grid.voxels, 0.35 / _GRID_MM)
    thin = (hu > low) & ~pools
    response = vesselness(
        np.clip(grid.voxels, 0.0, 1.1 * lumen_hu),
        thin,
        spacing_mm=_GRID_MM,
        sigmas_mm=_SCALES_MM,
        contrast_hu=lumen_hu,
    )
    tubes = response > _RESPONSE
    # Short dark or shapeless gaps, such as at a bifurcation, are bridged through bright voxels.
    reach = round(_GAP_MM / _GRID_MM / 2)
    vessels = thin & ndimage.maximum_filter(tubes, 2 * reach + 1)
    return _Scan(grid, hu, lumen_hu, pools, vessels, response)


def _aorta(scan: _Scan, root: AorticRoot) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the pool voxels around the aorta's axis."""
    voxels = np.argwhere(scan.pools)
    points = scan.grid.index_to_world(voxels[:, ::-1].astype(float))
    distance, disc = KDTree(root.centres).query(points, distance_upper_bound=1.3 * root.radius.max())
    mine = np.isfinite(distance)
    mine[mine] = distance[mine] < 1.15 * root.radius[disc[mine]] + 1.0
    aorta = np.zeros(scan.pools.shape, dtype=bool)
    aorta[tuple(voxels[mine].T)] = True
    return aorta


def _choose_tree(
    scan: _Scan, root: AorticRoot, aorta: np.ndarray, config: SegmentConfig
) -> tuple[Bool[np.ndarray, "nz ny nx"], Int[np.ndarray, "3"]]:
    """Return the connected vessel that belongs to the ostium wanted, and its voxel nearest the aortic wall."""
    label = connected_components(scan.vessels, corners=True)
    if config.seeds:
        seed = _vessel_near(scan, scan.vessels, config.seeds[0])
        tree = label == label[tuple(seed)]
        return tree, seed
    corner, opposite = np.argwhere(aorta).min(axis=0), np.argwhere(aorta).max(axis=0) + 1
    reach = round(_TO_WALL_MM / _GRID_MM) + 1
    box = tuple(slice(max(a - reach, 0), b + reach) for a, b in zip(corner, opposite, strict=True))
    gap = distance_to_outside(~aorta[box], _GRID_MM)
    touching = np.argwhere((gap <= _TO_WALL_MM) & (label[box] > 0))
    sizes = np.bincount(label.ravel())
    best, start = 0, None
    for name in np.unique(label[box][tuple(touching.T)]):
        voxels = touching[label[box][tuple(touching.T)] == name]
        nearest = voxels[gap[tuple(voxels.T)].argmin()] + [part.start for part in box]
        point = scan.grid.index_to_world(nearest[::-1].astype(float))
        disc = int(np.abs(root.centres[:, 2] - point[2]).argmin())
        outward = point[:2] - root.centres[disc, :2]
        if outward @ np.array(_SIDE[config.vessel]) > 0 and sizes[name] > sizes[best] * (best > 0):
            best, start = int(name), nearest
    if start is None or sizes[best] * _GRID_MM**3 < _LEAST_TREE_MM3:
        raise InputError(
            f"vessel={config.vessel!r}: no such artery comes to the aorta's wall in this volume; "
            "give seeds: the ostium first, then points along the vessel (LPS mm)"
        )
    return label == best, start


def _vessel_near(scan: _Scan, vessels: np.ndarray, seed: tuple[float, float, float]) -> Int[np.ndarray, "3"]:
    """Return the vessel voxel nearest a seed."""
    voxels = np.argwhere(vessels)
    distance, nearest = KDTree(voxels).query(scan.grid.world_to_index(np.array(seed, dtype=float))[::-1])
    if distance * _GRID_MM > _SEED_MM:
        raise InputError(
            f"seeds: no vessel of this tree within {_SEED_MM:g} mm of {tuple(seed)}, the nearest is "
            f"{distance * _GRID_MM:.0f} mm away; move the seed into the vessel (LPS mm)"
        )
    return voxels[nearest]


def _ostium(path: Float[np.ndarray, "n 3"], scan: _Scan, aorta: np.ndarray) -> Insertion:
    """Return where the vessel's axis, drawn back from its first millimetres, meets the aortic wall."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    first = path[along <= _AXIS_MM]
    centre = first.mean(axis=0)
    axis = np.linalg.svd(first - centre)[2][0]
    axis = axis * np.sign(axis @ (first[-1] - first[0]))
    begin = centre + axis * float((path[0] - centre) @ axis)
    corner = np.round(scan.grid.world_to_index(begin)).astype(int)[::-1] - _OSTIUM_BOX
    box = tuple(slice(max(c, 0), max(c, 0) + 2 * _OSTIUM_BOX) for c in corner)
    # The opening by a large ball takes the artery's mouth away from the aorta's surface.
    blood = scan.hu[box] > 0.5 * (scan.lumen_hu + _WALL_HU)
    deep = (distance_to_outside(blood, _GRID_MM) >= _WALL_BALL_MM) & aorta[box]
    if not deep.any():
        return Insertion(begin, axis)
    inside = _WALL_BALL_MM - distance_to_outside(~deep, _GRID_MM)
    steps = np.arange(3.0, -8.0, -0.1)
    track = begin + steps[:, None] * axis
    index = scan.grid.world_to_index(track)[:, ::-1] - [part.start for part in box]
    met = np.flatnonzero(ndimage.map_coordinates(inside, index.T, order=1, cval=-1.0) > 0)
    return Insertion(track[met[0]] if met.size else begin, axis)


def _refine(volume: Volume, scan: _Scan, paths: list[np.ndarray], ostium: Insertion) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the lumen around the paths on the volume's own grid, cut at the ostium."""
    gap = paths[0][0] - ostium.position
    steps = np.arange(0.0, 1.0, _GRID_MM / max(np.linalg.norm(gap), _GRID_MM))[:, None]
    lines = [np.concatenate([ostium.position + steps * gap, paths[0]]), *paths[1:]]
    half = scan.hu > 0.5 * (scan.lumen_hu + _WALL_HU)
    radius = np.concatenate([_radius_along(line, scan, half, i == 0) for i, line in enumerate(lines)])
    points = np.concatenate(lines)
    index = volume.world_to_index(points)[:, ::-1]
    margin = 8.0 / volume.spacing_mm[::-1]
    low = np.maximum(np.floor(index.min(axis=0) - margin).astype(int), 0)
    high = np.minimum(np.ceil(index.max(axis=0) + margin).astype(int) + 1, volume.voxels.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    crop = Volume(
        volume.voxels[box], volume.spacing_mm, volume.index_to_world(low[::-1].astype(float)), volume.direction
    )
    others = Volume(scan.pools.astype(np.float32), scan.grid.spacing_mm, scan.grid.origin_mm, scan.grid.direction)
    excluded = interpolate_like(others, crop, outside=0.0) > 0.5
    k, j, i = np.indices(excluded.shape, dtype=np.float32)
    world = crop.index_to_world(np.stack([i, j, k], axis=-1)) - ostium.position
    near = np.linalg.norm(world, axis=-1) < _OSTIUM_REACH_MM
    excluded = np.where(near, world @ ostium.direction < 0, excluded)
    lumen = lumen_at_half_height(crop, points, radius, scan.lumen_hu, excluded)
    label = connected_components(lumen)
    mask = np.zeros(volume.voxels.shape, dtype=bool)
    if lumen.any():
        mask[box] = label == np.bincount(label.ravel())[1:].argmax() + 1
    return mask


def _radius_along(line: np.ndarray, scan: _Scan, half: np.ndarray, first: bool) -> Float[np.ndarray, "n"]:
    """Return the rough lumen radius along a path, mm, from the distance to voxels below half height."""
    index = np.round(scan.grid.world_to_index(line)).astype(int)[:, ::-1]
    reach = round(4.0 / _GRID_MM)
    low, high = np.maximum(index.min(axis=0) - reach, 0), index.max(axis=0) + reach + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    depth = ndimage.maximum_filter(distance_to_outside(half[box], _GRID_MM), 3)
    at = np.clip(index - low, 0, np.array(depth.shape) - 1)
    radius = np.clip(depth[tuple(at.T)] - _GRID_MM / 2, 0.4, _POOL_RADIUS_MM)
    if first:  # at its mouth the artery has no wall of its own: take what it has a little farther on
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        beyond = (along > 5.0) & (along < 9.0)
        if beyond.any():
            radius[along <= 5.0] = np.median(radius[beyond])
    return ndimage.median_filter(radius, 9, mode="nearest")
