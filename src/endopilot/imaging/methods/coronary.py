"""One coronary tree, from its ostium to its distal ends, in a cardiac CT angiogram: automatic.

1. The ascending aorta is found as the largest round bright disc that persists from slice to slice and that an artery
   opens into; its median HU are those of contrast-filled lumen in this scan.
2. Bright voxels that a ball of 3.5 mm fits in are aorta, chambers and large veins. Of the others, those that look like
   the middle of a bright tube at some scale are vessels.
3. The connected vessel that comes to the aorta's wall on the right side of it is the tree wanted; its paths are tracked
   to the distal ends, and its axis is drawn back to the aortic wall, which is the ostium.
4. Around the paths, the wall is where HU lie midway between those of the lumen and of what is beside it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from endopilot.errors import InputError
from endopilot.imaging.aortic_root import (
    TO_WALL_MM,
    AorticRoot,
    box_around,
    find_aortic_roots,
    find_ostium,
    openings,
    opens_into,
)
from endopilot.imaging.coronary_doubts import FoundTree, Scan, coronary_doubts
from endopilot.imaging.grid import (
    LEAST_BLOOD_HU,
    connected_components,
    distance_to_outside,
    interpolate_like,
    resample,
)
from endopilot.imaging.segment import SegmentConfig
from endopilot.imaging.vessel_tracking import lumen_at_half_height, track_tree, vesselness
from endopilot.imaging.voxels import dilated
from endopilot.lines import length_along
from endopilot.progress import progress
from endopilot.types import Insertion, LumenMask, Volume

_ROOT_GRID_MM = 1.5
_BODY_GRID_MM = 1.0
_GRID_MM = 0.5  # grids on which the aorta, the large blood pools and the vessels are sought
_MUSCLE_HU = 100.0  # myocardium in the arterial phase
_FAT_HU = -90.0  # epicardial fat
_LOW_SHARE = 0.25  # a vessel's voxels rise by this share of the step to lumen; the blur dims small vessels
_POOL_RADIUS_MM = 3.5  # such a ball fits in chambers, great vessels, and no coronary artery but a dilated one
_CORE_RADIUS_MM = 5.5
_NEAR_CORE_MM = 4.0  # such a ball fits in no dilated artery either: what is wide so near to it is a pool
_CORE_MEDIAN = 3
"""Edge of the median filter against noise where the large balls are sought, voxels of the body's grid. A Gaussian would
close the fat between an artery and a pool."""
_RESPONSE = 0.15  # vesselness of a vessel's voxels
_SCALES_MM = (0.6, 0.9, 1.3, 1.9, 2.8)  # scales of the vesselness: they answer most to radii of 0.8 to 4 mm
_GAP_MM = 1.0  # voxels between vessels this close together are bridged, if they are bright
_SEED_MM = 5.0  # a seed belongs to the vessel within this distance
_LEAST_TREE_MM3 = 250.0  # a smaller connected vessel is no coronary tree: 50 mm of 2.5 mm width hold as much
_RIVAL_SHARE = 0.85  # what is dimmer than this share of the aorta's blood is no second candidate for it
COARSEST_MM = 1.25  # longest edge of voxels in which a coronary artery of 2 mm still shows
_MOUTH_MM = 4.0  # length of the artery's beginning where the aorta's blood hides its radius, mm
_WIDEST_MM = 5.0  # largest radius expected of a coronary artery, mm
_MARGIN_MM = 8.0  # width of surroundings kept around the tree for the contour, mm
_OSTIUM_REACH_MM = 8.0  # around the ostium, the plane across the vessel cuts, and nothing else
_SIDE = {"rca": (-0.64, -0.77), "lca": (0.77, 0.64)}
"""Direction (x, y) from the aorta's axis to each ostium: the right one lies to the front and right, the left one to the
left and back."""


def segment_lumen(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Segment a coronary tree, without seeds automatically; the first sets where it begins, others add ends to be
    reached. Raises InputError where voxels are too coarse, or contrast, aorta, or a vessel at its wall or a seed is
    missing."""
    coarsest = float(volume.spacing_mm.max())
    if coarsest > COARSEST_MM:
        raise InputError(
            f"the CT is too coarse for coronary arteries ({coarsest:.3g} mm; {COARSEST_MM:g} mm at most), which are "
            "2 to 4 mm wide: give a reconstruction with thinner slices, or segment the aorta with --method aorta"
        )
    with progress("Segmenting the coronary tree", 5) as advance:
        grid = resample(volume, _GRID_MM)
        roots = _find_roots(grid, config)
        advance()
        if config.seeds:
            scan = _find_vessels(grid, roots[0].blood_hu if roots else _hu_at(volume, config.seeds[0]))
            aorta = _aorta(scan, roots[0]) if roots else np.zeros(scan.pools.shape, dtype=bool)
            tree, start = _tree_at_seed(scan, aorta, config.seeds[0])
        else:
            scan, aorta, tree, start = _unseeded_tree(grid, roots, config.vessel)
        advance(2)
        ends = [_vessel_near(scan, tree, seed) for seed in config.seeds[1:]]
        paths = [
            scan.grid.index_to_world(path[:, ::-1]) for path in track_tree(scan.response, tree, start, ends, _GRID_MM)
        ]
        advance()
        blood = scan.hu > scan.blood_hu
        ostium, paths[0] = find_ostium(paths[0], blood, aorta, scan.grid)
        radius = _rough_radius(paths, scan)
        mask = _refine(volume, scan, paths, radius, ostium)
        seen = {"volume": volume, "aorta": aorta, "tree": tree, "ostium": ostium.position}
        found = FoundTree(**vars(scan), **seen, paths=paths, radius=radius, lumen=mask)
        warnings = coronary_doubts(found, config.vessel)
        if not config.seeds:
            warnings = (*_rival_aortas(scan, aorta, roots, config.vessel, tree, start), *warnings)
        advance()
    found_mask = Volume(mask, volume.spacing_mm, volume.origin_mm, volume.direction)
    return LumenMask(found_mask, ostium, warnings=warnings)


def _find_roots(grid: Volume, config: SegmentConfig) -> list[AorticRoot]:
    """Return what may be the ascending aorta; nothing where it is not in the volume and a seed is given."""
    try:
        return find_aortic_roots(resample(grid, _ROOT_GRID_MM))
    except InputError:
        if config.seeds:
            return []
        raise


def _hu_at(volume: Volume, seed: tuple[float, float, float]) -> float:
    index = volume.world_to_index(np.array(seed, dtype=float))[::-1]
    box = box_around(index[None], 2.0 / volume.spacing_mm[::-1], volume.voxels.shape)
    found = float(np.max(ndimage.gaussian_filter(volume.voxels[box].astype(np.float32), 0.7)))
    if found < LEAST_BLOOD_HU:
        raise InputError(
            f"seeds: {found:.0f} HU at most within 2 mm of {tuple(seed)}, where blood with contrast has "
            f"{LEAST_BLOOD_HU:.0f} or more; move the seed into the vessel, or give a CT with contrast"
        )
    return found


def _find_vessels(grid: Volume, lumen_hu: float) -> Scan:
    hu = np.asarray(ndimage.gaussian_filter(grid.voxels, 0.35 / _GRID_MM, truncate=3.0))
    body = resample(grid, _BODY_GRID_MM)
    above_muscle = _MUSCLE_HU + _LOW_SHARE * (lumen_hu - _MUSCLE_HU)
    above_fat = _FAT_HU + _LOW_SHARE * (lumen_hu - _FAT_HU)
    pools = _pools(body, above_muscle, grid)
    # A small vessel in fat is dimmer than muscle, but visible where no thick tissue is, in which a wide ball fits.
    tissue = distance_to_outside(body.voxels > above_fat, _BODY_GRID_MM)
    thick = _inside(_beyond_balls(tissue, _POOL_RADIUS_MM), body, grid)
    thin = ((hu > above_muscle) & ~pools) | ((hu > above_fat) & ~thick)
    response = vesselness(
        np.clip(grid.voxels, _FAT_HU / 2, 1.1 * lumen_hu),
        thin,
        spacing_mm=_GRID_MM,
        sigmas_mm=_SCALES_MM,
        contrast_hu=lumen_hu,
    )
    # Short shapeless gaps, such as at a bifurcation, are bridged through bright voxels.
    vessels = thin & dilated(response > _RESPONSE, round(_GAP_MM / _GRID_MM / 2))
    return Scan(grid, hu, lumen_hu, pools, vessels, response)


def _pools(body: Volume, level_hu: float, grid: Volume) -> Bool[np.ndarray, "nz ny nx"]:
    """Return where blood above a level is thick and near to where it is thicker than in any artery of the heart."""
    depth = distance_to_outside(body.voxels > level_hu, _BODY_GRID_MM)
    # Noise leaves holes in a dim pool, between which no large ball fits.
    smooth = np.asarray(ndimage.median_filter(body.voxels, _CORE_MEDIAN))
    core_depth = distance_to_outside(smooth > level_hu, _BODY_GRID_MM)
    from_core = _beyond_balls(core_depth, _CORE_RADIUS_MM) - _NEAR_CORE_MM
    return _inside(np.maximum(_beyond_balls(depth, _POOL_RADIUS_MM), from_core), body, grid)


def _beyond_balls(depth: Float[np.ndarray, "nz ny nx"], radius_mm: float) -> Float[np.ndarray, "nz ny nx"]:
    """Return the distance from all balls that fit where `depth` is the distance to the outside, mm."""
    # Half a voxel of the body's grid more, so that no rim is left.
    return distance_to_outside(depth < radius_mm, _BODY_GRID_MM) - radius_mm - _BODY_GRID_MM / 2


def _inside(distance: Float[np.ndarray, "k j i"], body: Volume, grid: Volume) -> Bool[np.ndarray, "nz ny nx"]:
    """Return where a distance on the body's grid is 0 or less, on the vessels' grid."""
    return interpolate_like(Volume(distance, body.spacing_mm, body.origin_mm, body.direction), grid, outside=1.0) <= 0


def _aorta(scan: Scan, root: AorticRoot) -> Bool[np.ndarray, "nz ny nx"]:
    reach = 1.15 * root.radius + 1.0
    box = box_around(
        scan.grid.world_to_index(root.centres)[:, ::-1], np.full(3, reach.max() / _GRID_MM), scan.pools.shape
    )
    voxels = np.argwhere(scan.pools[box]) + [part.start for part in box]
    points = scan.grid.index_to_world(voxels[:, ::-1].astype(float))
    distance, disc = KDTree(root.centres).query(points)
    aorta = np.zeros(scan.pools.shape, dtype=bool)
    aorta[tuple(voxels[distance < reach[disc]].T)] = True
    return aorta


_Tree = tuple[Scan, Bool[np.ndarray, "nz ny nx"], Bool[np.ndarray, "nz ny nx"], Int[np.ndarray, "3"]]
"""The scan, the aorta in it, the connected vessel wanted, and its voxel nearest the aortic wall."""


def _unseeded_tree(grid: Volume, roots: list[AorticRoot], vessel: str) -> _Tree:
    """Return the tree at the likeliest aorta that one opens into; the pulmonary trunk has arteries pass by at most."""
    passing: _Tree | None = None
    for root in roots:
        scan = _find_vessels(grid, root.blood_hu)
        aorta = _aorta(scan, root)
        found = _tree_at_aorta(scan, root, aorta, vessel)
        if found is None:
            continue
        if opens_into(scan.hu, scan.blood_hu, aorta, *found, _GRID_MM):
            return scan, aorta, *found
        passing = passing or (scan, aorta, *found)
    if passing is not None:  # a narrow ostium may be too dim to look open
        return passing
    raise InputError(
        f"vessel={vessel!r}: no such artery comes to the aorta's wall in this volume; "
        "give a CT that holds the aortic root, or seeds: the ostium first, then points along the vessel (LPS mm)"
    )


def _rival_aortas(
    scan: Scan, aorta: np.ndarray, roots: list[AorticRoot], vessel: str, tree: np.ndarray, start: np.ndarray
) -> list[str]:
    """Tell what else may be the ascending aorta, since such an artery opens into it too, or into none visibly."""
    doubts = []
    if not opens_into(scan.hu, scan.blood_hu, aorta, tree, start, _GRID_MM):
        doubts.append("the artery does not visibly open into the aorta: the ostium may be elsewhere; give a seed at it")
    label = connected_components(scan.vessels, corners=True)
    sizes = np.bincount(label.ravel()) * _GRID_MM**3
    for root in roots:
        other = _aorta(scan, root)
        if (other & aorta).any() or root.blood_hu < _RIVAL_SHARE * scan.lumen_hu:
            continue
        found = openings(scan.hu, scan.blood_hu, other, label, _GRID_MM)
        large = [o.voxel for o in found if sizes[o.vessel] >= _LEAST_TREE_MM3]
        if large and _on_side(scan, root, np.array(large), vessel).any():
            x, y, z = root.centres[len(root.centres) // 2]
            doubts.append(
                f"two vessels may be the ascending aorta; the one not taken passes ({x:.0f}, {y:.0f}, {z:.0f}) mm, and "
                "an artery opens into it too; if it is the aorta, give a seed at the ostium there"
            )
    return doubts


def _tree_at_seed(
    scan: Scan, aorta: np.ndarray, seed: tuple[float, float, float]
) -> tuple[Bool[np.ndarray, "nz ny nx"], Int[np.ndarray, "3"]]:
    """Return the connected vessel at a seed, and where it begins: at the aortic wall, if the seed is near, or there."""
    at = _vessel_near(scan, scan.vessels, seed)
    label = connected_components(scan.vessels, corners=True)
    tree = label == label[tuple(at)]
    box = box_around(at[None], np.full(3, 2 * _SEED_MM / _GRID_MM), tree.shape)
    gap = distance_to_outside(~aorta[box], _GRID_MM)
    voxels = np.argwhere(tree[box] & (gap <= TO_WALL_MM)) if aorta[box].any() else np.zeros((0, 3), dtype=int)
    if len(voxels):
        at = voxels[gap[tuple(voxels.T)].argmin()] + [part.start for part in box]
    return tree, at


def _tree_at_aorta(
    scan: Scan, root: AorticRoot, aorta: np.ndarray, vessel: str
) -> tuple[Bool[np.ndarray, "nz ny nx"], Int[np.ndarray, "3"]] | None:
    """Return the connected vessel that belongs to the ostium wanted, and its voxel nearest the aortic wall, if any."""
    label = connected_components(scan.vessels, corners=True)
    box = box_around(np.argwhere(aorta), np.full(3, TO_WALL_MM / _GRID_MM + 1), aorta.shape)
    gap = distance_to_outside(~aorta[box], _GRID_MM)
    touching = np.argwhere((gap <= TO_WALL_MM) & (label[box] > 0))
    sizes = np.bincount(label.ravel())
    best, start = 0, None
    corner = np.array([part.start for part in box])
    # A vein may join the vessel and touch the aorta too: only where the ostium may be is it looked for.
    touching = touching[_on_side(scan, root, touching + corner, vessel)]
    for name in np.unique(label[box][tuple(touching.T)]):
        voxels = touching[label[box][tuple(touching.T)] == name]
        if sizes[name] > sizes[best] * (best > 0):
            best, start = int(name), voxels[gap[tuple(voxels.T)].argmin()] + corner
    if start is None or sizes[best] * _GRID_MM**3 < _LEAST_TREE_MM3:
        return None
    return label == best, start


def _on_side(scan: Scan, root: AorticRoot, voxels: Int[np.ndarray, "n 3"], vessel: str) -> Bool[np.ndarray, "n"]:
    """Return which voxels at the aorta's wall are where the wanted artery's ostium may be."""
    points = scan.grid.index_to_world(voxels[:, ::-1].astype(float))
    disc = np.abs(root.centres[:, 2] - points[:, 2, None]).argmin(axis=1)
    outward = (points[:, :2] - root.centres[disc, :2]) @ np.array(_SIDE[vessel])
    return (points[:, 2] >= root.centres[0, 2]) & (outward > 0)  # what comes to a chamber below is no ostium


def _vessel_near(scan: Scan, vessels: np.ndarray, seed: tuple[float, float, float]) -> Int[np.ndarray, "3"]:
    voxels = np.argwhere(vessels)
    if len(voxels) == 0:
        raise InputError("seeds: the volume holds no vessel-like structure; give a CT angiogram in HU")
    distance, nearest = KDTree(voxels).query(scan.grid.world_to_index(np.array(seed, dtype=float))[::-1])
    if distance * _GRID_MM > _SEED_MM:
        raise InputError(
            f"seeds: no vessel (of this tree) within {_SEED_MM:g} mm of {tuple(seed)}, the nearest is "
            f"{distance * _GRID_MM:.0f} mm away; move the seed into the vessel (LPS mm)"
        )
    return voxels[nearest]


def _refine(
    volume: Volume, scan: Scan, lines: list[np.ndarray], radius: list[np.ndarray], ostium: Insertion
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the lumen around the paths on the volume's own grid, cut at the ostium."""
    points = np.concatenate(lines)
    box = box_around(volume.world_to_index(points)[:, ::-1], _MARGIN_MM / volume.spacing_mm[::-1], volume.voxels.shape)
    corner = np.array([part.start for part in box])
    crop = Volume(
        volume.voxels[box], volume.spacing_mm, volume.index_to_world(corner[::-1].astype(float)), volume.direction
    )
    pools = Volume(scan.pools.astype(np.float32), scan.grid.spacing_mm, scan.grid.origin_mm, scan.grid.direction)
    excluded = interpolate_like(pools, crop, outside=0.0) > 0.5
    _cut(excluded, crop, ostium)
    lumen = lumen_at_half_height(crop, points, np.concatenate(radius), scan.lumen_hu, excluded)
    mask = np.zeros(volume.voxels.shape, dtype=bool)
    if lumen.any():
        label = connected_components(lumen)
        mask[box] = label == np.bincount(label.ravel())[1:].argmax() + 1
    return mask


def _cut(excluded: np.ndarray, crop: Volume, ostium: Insertion) -> None:
    """Around the ostium, let the plane across the vessel exclude what lies behind it, and nothing else."""
    centre = crop.world_to_index(ostium.position)[::-1]
    box = box_around(centre[None], _OSTIUM_REACH_MM / crop.spacing_mm[::-1], excluded.shape)
    k, j, i = np.meshgrid(*(np.arange(part.start, part.stop) for part in box), indexing="ij")
    offset = crop.index_to_world(np.stack([i, j, k], axis=-1).astype(float)) - ostium.position
    near = np.linalg.norm(offset, axis=-1) < _OSTIUM_REACH_MM
    excluded[box] = np.where(near, offset @ ostium.direction < 0, excluded[box])


def _rough_radius(lines: list[np.ndarray], scan: Scan) -> list[Float[np.ndarray, "_"]]:
    """Return the lumen radius along each path, mm, from the distance to voxels below half height."""
    index = np.round(scan.grid.world_to_index(np.concatenate(lines))).astype(int)[:, ::-1]
    box = box_around(index, np.full(3, (_WIDEST_MM + 1.0) / _GRID_MM), scan.hu.shape)
    blood = scan.hu[box] > scan.blood_hu
    depth = np.asarray(ndimage.maximum_filter(distance_to_outside(blood, _GRID_MM), 3)) - _GRID_MM / 2
    pieces = []
    for number, line in enumerate(lines):
        at = np.round(scan.grid.world_to_index(line)).astype(int)[:, ::-1] - [part.start for part in box]
        radius = np.clip(depth[tuple(np.clip(at, 0, np.array(depth.shape) - 1).T)], 0.4, _WIDEST_MM)
        along = length_along(line)
        beyond = (along > _MOUTH_MM) & (along < 2 * _MOUTH_MM)
        if number == 0 and beyond.any():
            # At its mouth the artery has no wall of its own: take what it has a little farther on.
            radius[along <= _MOUTH_MM] = np.median(radius[beyond])
        pieces.append(ndimage.median_filter(radius, 9, mode="nearest"))
    return pieces
