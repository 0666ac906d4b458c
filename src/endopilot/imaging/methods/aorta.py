"""The contrast-filled aorta between seed points, for CT angiograms of the thorax and abdomen.

1. The widest connection between the seeds, through voxels well above half the blood's HU, gives a path that stays in
   the aorta: a leak through a thin wall into a heart chamber is a narrower connection.
2. A watershed of the brightness, flooded from that path and from everything bright farther away than an aorta is wide,
   divides what holds contrast: the two floods meet at the walls, which are darker, and so chambers, pulmonary artery,
   bone and branches go to the other side.
3. Branch stumps and leaks thinner than the aorta go by a morphological opening; planes across the path at the first and
   last seed cut the ends.
4. The wall is where the HU lie midway between those of the blood nearby and of soft tissue.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.graph import MCP_Geometric
from skimage.segmentation import watershed

from endopilot.errors import InputError
from endopilot.imaging.grid import (
    LEAST_BLOOD_HU,
    connected_components,
    distance_to_outside,
    interpolate_like,
    resample,
)
from endopilot.imaging.segment import SegmentConfig
from endopilot.progress import progress
from endopilot.types import Insertion, LumenMask, Volume

_GRID_MM = 1.5  # working voxel: a tenth of the aorta's radius, and the walls between it and its neighbours still show
_WALL_HU = 50.0  # soft tissue around the lumen: vessel wall and muscle without contrast
_PATH_LEVELS = (0.6, 0.5, 0.4)  # shares of the blood's HU that the path stays above; lower ones where seeds are apart
_REACH_MM = 30.0  # bright voxels farther from the path are not the aorta: half of 60 mm, a large aneurysm
_CORE = 0.6  # share of the inscribed radius around the path that is aorta without question
_WIDEST_MM = 18.0  # with one seed the far end is free: a wider inscribed sphere is in a heart chamber
_THINNEST_MM = 3.0  # radius of the opening: branches and leaks thinner than this go
_SEED_MM = 6.0  # a seed is moved to the middle of the lumen within this distance


def segment_lumen(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Segment the aortic lumen from the first seed, where the device enters, by those between to the last, or to its
    far end. Raises InputError without a seed, contrast at a seed, or a contrast-filled path."""
    if not config.seeds:
        raise InputError("seeds: the aorta method needs one or two points in the lumen, LPS mm; give --seeds x y z")
    with progress("Segmenting the aorta", 4) as advance:
        grid = resample(volume, _GRID_MM)
        hu = ndimage.gaussian_filter(grid.voxels, 0.6)
        seeds = [_nearest_voxel(grid, seed) for seed in config.seeds]
        blood = min(_blood_hu(grid, index, seed) for index, seed in zip(seeds, config.seeds, strict=True))
        advance()
        path, radius = _find_path(hu, seeds, blood)
        advance()
        inside, beyond = _flood(hu, path, radius, blood)
        inside = _trim(inside, path, radius)
        advance()
        mask = _at_half_height(hu, inside, beyond, grid, volume)
        advance()
    line = grid.index_to_world(ndimage.gaussian_filter1d(path.astype(float), 4, axis=0, mode="nearest")[:, ::-1])
    heading = line[min(10, len(line) - 1)] - line[0]
    ostium = Insertion(line[0], heading / np.linalg.norm(heading))
    return LumenMask(Volume(mask, volume.spacing_mm, volume.origin_mm, volume.direction), ostium)


def _nearest_voxel(grid: Volume, seed: tuple[float, float, float]) -> tuple[int, int, int]:
    last = np.array(grid.voxels.shape[::-1]) - 1
    i, j, k = np.clip(np.round(grid.world_to_index(np.array(seed, dtype=float))), 0, last).astype(int)
    return int(k), int(j), int(i)


def _around(shape: tuple[int, ...], centre: tuple[int, int, int], radius_mm: float) -> tuple[slice, ...]:
    reach = round(radius_mm / _GRID_MM)
    return tuple(slice(max(c - reach, 0), min(c + reach + 1, n)) for c, n in zip(centre, shape, strict=True))


def _blood_hu(grid: Volume, centre: tuple[int, int, int], seed: tuple[float, float, float]) -> float:
    found = float(np.median(grid.voxels[_around(grid.voxels.shape, centre, 2 * _GRID_MM)]))
    if found < LEAST_BLOOD_HU:
        raise InputError(
            f"seeds: {found:.0f} HU around {tuple(seed)}, where blood with contrast has {LEAST_BLOOD_HU:.0f} or more; "
            "move the seed into the bright lumen, or give a CT with contrast"
        )
    return found


def _find_path(
    hu: Float[np.ndarray, "nz ny nx"], seeds: list[tuple[int, int, int]], blood: float
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the voxels (k, j, i) of the widest path through all seeds, and the inscribed radius along it, mm."""
    for level in _PATH_LEVELS:
        wall_distance = distance_to_outside(hu > level * blood, _GRID_MM)
        stops = [_widest_nearby(wall_distance, seed) for seed in seeds]
        if len(stops) == 1:
            stops.append(_far_end(wall_distance, stops[0]))
        pieces = [_widest_path(wall_distance, a, b) for a, b in pairwise(stops)]
        if all(piece is not None for piece in pieces):
            path = np.concatenate([piece for piece in pieces if piece is not None])
            if len(path) > 2:
                return path, wall_distance[tuple(path.T)]
            raise InputError(
                f"seeds: moved to the middle of the lumen, within {_SEED_MM:g} mm, they lie at one place; put them "
                f"farther apart along the vessel"
            )
    raise InputError("seeds: no contrast-filled path from seed to seed; put them in one lumen, or add one between")


def _widest_nearby(wall_distance: np.ndarray, seed: tuple[int, int, int]) -> tuple[int, int, int]:
    cube = _around(wall_distance.shape, seed, _SEED_MM)
    best = np.unravel_index(wall_distance[cube].argmax(), wall_distance[cube].shape)
    k, j, i = (int(where.start + offset) for where, offset in zip(cube, best, strict=True))
    return k, j, i


def _far_end(wall_distance: np.ndarray, start: tuple[int, int, int]) -> tuple[int, int, int]:
    label = connected_components(wall_distance > _GRID_MM)
    lumen = label == label[start]
    if wall_distance[lumen].max() > _WIDEST_MM:
        raise InputError(
            f"seeds: the lumen at the seed is joined to one of radius {wall_distance[lumen].max():.0f} mm (a heart "
            "chamber, or an aneurysm); give a second seed at the far end of the vessel"
        )
    steps, _ = MCP_Geometric(np.where(lumen, 1.0, -1.0)).find_costs([start])
    k, j, i = np.unravel_index(np.where(lumen, steps, -1.0).argmax(), lumen.shape)
    return int(k), int(j), int(i)


def _widest_path(
    wall_distance: np.ndarray, start: tuple[int, int, int], end: tuple[int, int, int]
) -> Int[np.ndarray, "n 3"] | None:
    """Return the path whose narrowest place is widest, kept to the middle of the lumen; None if there is none."""
    low, high = 0.0, float(min(wall_distance[start], wall_distance[end]))
    while high - low > _GRID_MM / 20:
        middle = (low + high) / 2
        label = connected_components(wall_distance >= middle)
        low, high = (middle, high) if label[start] == label[end] else (low, middle)
    if low == 0.0:
        return None
    # Beyond 8 mm the lumen is wide enough: a detour through a chamber must not be rewarded for its size.
    cost = np.full(wall_distance.shape, -1.0)
    passable = wall_distance >= low
    cost[passable] = np.minimum(wall_distance[passable], 8.0) ** -2
    search = MCP_Geometric(cost)
    search.find_costs([start], [end])
    return np.array(search.traceback(end))


def _flood(
    hu: np.ndarray, path: np.ndarray, radius: np.ndarray, blood: float
) -> tuple[Bool[np.ndarray, "nz ny nx"], Bool[np.ndarray, "nz ny nx"]]:
    """Divide the contrast-filled voxels into those that belong to the path and those that do not."""
    contrast = hu > LEAST_BLOOD_HU
    off_path = np.ones(hu.shape, dtype=bool)
    off_path[tuple(path.T)] = False
    distance, nearest = ndimage.distance_transform_edt(off_path, sampling=_GRID_MM, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    distance = distance.astype(np.float32)
    radius_at_path = np.zeros(hu.shape, dtype=np.float32)
    radius_at_path[tuple(path.T)] = radius
    markers = np.zeros(hu.shape, dtype=np.int8)
    markers[contrast & (distance > _REACH_MM)] = 2
    markers[contrast & (distance <= np.maximum(_CORE * radius_at_path[tuple(nearest)], _GRID_MM))] = 1
    # Stents and calcium are brighter than blood; capped, they do not draw the flood.
    label = watershed(-np.minimum(hu, blood), markers, mask=contrast)
    return label == 1, label == 2


def _trim(inside: np.ndarray, path: np.ndarray, radius: np.ndarray) -> Bool[np.ndarray, "nz ny nx"]:
    """Cut the ends at planes across the path and remove what is thinner than the aorta."""
    span = min(10, len(path) - 1)
    k, j, i = np.ogrid[: inside.shape[0], : inside.shape[1], : inside.shape[2]]
    for end, within in ((path[0], path[span]), (path[-1], path[-1 - span])):
        outward = (end - within) / np.linalg.norm(end - within)
        past = (k - end[0]) * outward[0] + (j - end[1]) * outward[1] + (i - end[2]) * outward[2] > 0
        near = (k - end[0]) ** 2 + (j - end[1]) ** 2 + (i - end[2]) ** 2 < (1.3 * _REACH_MM / _GRID_MM) ** 2
        inside = inside & ~(past & near)
    core = distance_to_outside(inside, _GRID_MM) >= _THINNEST_MM
    opened = inside & (distance_to_outside(~core, _GRID_MM) <= _THINNEST_MM)
    # A true lumen squeezed flat is thinner than the opening: keep the spheres around the path.
    for centre, sphere in zip(path.tolist(), radius.tolist(), strict=True):
        cube = _around(inside.shape, tuple(centre), sphere)
        z, y, x = np.ogrid[cube]
        ball = (z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 <= (sphere / _GRID_MM) ** 2
        opened[cube] |= inside[cube] & ball
    label = connected_components(opened)
    return label == label[tuple(path[len(path) // 2])]


def _at_half_height(
    hu: np.ndarray, inside: np.ndarray, beyond: np.ndarray, grid: Volume, volume: Volume
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the mask on the grid of `volume`, its wall where HU lie midway between nearby blood and soft tissue."""
    sigma = 4.0 / _GRID_MM
    weight = ndimage.gaussian_filter(inside.astype(np.float32), sigma)
    blood = ndimage.gaussian_filter(np.where(inside, hu, np.float32(0)), sigma) / np.maximum(weight, 1e-3)
    level = np.clip(hu - (blood + _WALL_HU) / 2, -200, 200)
    level[~ndimage.binary_dilation(inside).astype(bool) | beyond] = -200
    fine = interpolate_like(Volume(level, grid.spacing_mm, grid.origin_mm, grid.direction), volume, outside=-200.0) > 0
    label = connected_components(fine)
    return (label == np.bincount(label.ravel())[1:].argmax() + 1) if fine.any() else fine
