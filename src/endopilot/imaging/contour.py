"""The wall of a vessel at half height: where HU lie midway between those of the lumen and of what is beside it."""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import KDTree

from endopilot.imaging.grid import connected_components, distance_to_outside
from endopilot.imaging.voxels import dilated
from endopilot.types import Volume

_SMOOTHING_MM = 0.3  # width of the Gaussian against noise, mm: about the scanner's own blur
_BLUR_MM = 0.4  # width of that Gaussian and of a scanner's point-spread function (0.6 mm at half height) together, mm
_SURROUNDINGS_MM = 1.2  # width of the window in which the surroundings' HU are averaged, mm
_WALL_HU = 0.0  # even in fat and lung the vessel's wall lies next to the lumen: half a millimetre of tissue, blurred
_BLOCK = 8  # edge of the blocks in which voxels near the vessel are looked for, voxels
CALCIUM = 1.5  # times the lumen's HU; brighter voxels are calcium or metal
_FEWEST_VOXELS = 5  # smaller bright specks are noise
_RIM_MM = 1.2  # blur spreads calcium's brightness this far: at a distance of three of its widths nothing is left


def lumen_at_half_height(
    volume: Volume,
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    lumen_hu: float,
    excluded: Bool[np.ndarray, "nz ny nx"],
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the voxels of the lumen around dense points of paths (LPS mm) with rough radii, mm: the wall's level
    follows what is beside it (fat, muscle, lung). `excluded` voxels belong to other blood pools."""
    spacing = volume.spacing_mm[::-1]
    hu = ndimage.gaussian_filter(volume.voxels.astype(np.float32), _SMOOTHING_MM / spacing, truncate=3.0)
    distance, local_radius = _distance_to_paths(volume, points, radius, margin_mm=4.0)
    band = (distance <= 1.35 * local_radius + 0.7) & ~excluded
    rough = band & (hu > 0.5 * lumen_hu)
    beside = (distance <= 1.35 * local_radius + 4.0) & (hu < 0.6 * lumen_hu)
    beside &= ~dilated(rough, [round(step) for step in 2 * _BLUR_MM / spacing])
    window = _SURROUNDINGS_MM / spacing
    weight = ndimage.gaussian_filter(beside.astype(np.float32), window, truncate=3.0)
    surroundings = ndimage.gaussian_filter(np.where(beside, hu, np.float32(0)), window, truncate=3.0)
    surroundings /= np.maximum(weight, 1e-4)
    surroundings = np.clip(surroundings, _WALL_HU, 0.5 * lumen_hu)
    # A blurred disc has less than half its height at its own edge, the less the smaller it is (to first order in σ/r).
    share = 0.5 - 0.2 * np.minimum(_BLUR_MM / np.maximum(local_radius, 0.1), 1.0)
    level = surroundings + share * (lumen_hu - surroundings)
    calcium = band & (hu >= CALCIUM * lumen_hu)
    inside = band & (hu > level) & ~calcium
    label = connected_components(calcium)
    large = np.bincount(label.ravel()) >= _FEWEST_VOXELS
    _drop_rims(inside, calcium & large[label], distance, spacing)
    return inside


def _drop_rims(inside: np.ndarray, calcium: np.ndarray, distance: np.ndarray, spacing: np.ndarray) -> None:
    """Take out of the lumen, in place, what lies beside calcium and no nearer to the axis: its blurred rim."""
    plaque = np.argwhere(calcium)
    if len(plaque) == 0:
        return
    voxels = np.argwhere(inside)
    found = KDTree(plaque * spacing).query(voxels * spacing, distance_upper_bound=_RIM_MM)
    gap, nearest = (np.asarray(part) for part in found)
    beside = np.isfinite(gap)
    voxels, plaque = voxels[beside], plaque[nearest[beside]]
    rim = distance[tuple(voxels.T)] >= distance[tuple(plaque.T)]
    inside[tuple(voxels[rim].T)] = False


def _distance_to_paths(
    volume: Volume, points: np.ndarray, radius: np.ndarray, margin_mm: float
) -> tuple[Float[np.ndarray, "nz ny nx"], Float[np.ndarray, "nz ny nx"]]:
    """Return the distance to the nearest path point and that point's radius, mm; infinite and 0 far away."""
    shape = np.array(volume.voxels.shape)
    # Blocks of voxels first: most of the volume is far from the vessel.
    blocks = np.ones(-(-shape // _BLOCK), dtype=bool)
    index = np.clip(np.round(volume.world_to_index(points)).astype(int)[:, ::-1], 0, shape - 1) // _BLOCK
    blocks[tuple(index.T)] = False
    size = _BLOCK * volume.spacing_mm[::-1]
    reach = radius.max() * 1.35 + margin_mm
    near = distance_to_outside(blocks, tuple(size)) < reach + float(np.linalg.norm(size))
    corners = _BLOCK * np.argwhere(near)
    voxels = (corners[:, None] + np.array(list(product(range(_BLOCK), repeat=3)))).reshape(-1, 3)
    voxels = voxels[np.all(voxels < shape, axis=1)]
    found, nearest = KDTree(points).query(
        volume.index_to_world(voxels[:, ::-1].astype(float)), distance_upper_bound=reach
    )
    distance = np.full(tuple(shape), np.inf, dtype=np.float32)
    local_radius = np.zeros(tuple(shape), dtype=np.float32)
    distance[tuple(voxels.T)] = found
    local_radius[tuple(voxels.T)] = np.append(radius, 0.0)[nearest]
    return distance, local_radius
