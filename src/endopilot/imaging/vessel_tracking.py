"""Vesselness, how much a place looks like the middle of a bright tube; following it from the ostium to the ends; and
the wall at half height: where HU lie midway between those of the lumen and of what is beside it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from endopilot.imaging.grid import connected_components, distance_to_outside
from endopilot.imaging.voxels import dilated
from endopilot.types import Volume

_SHORTEST_BRANCH_MM = 4.0  # shorter side branches are bumps of the wall
_COST_FLOOR = 0.05  # added to the vesselness, so that a path through a gap has a finite cost
_SMOOTHING_MM = 1.5  # width of the Gaussian that takes the voxel steps out of a path, mm


def vesselness(
    hu: Float32[np.ndarray, "nz ny nx"],
    where: Bool[np.ndarray, "nz ny nx"],
    *,
    spacing_mm: float,
    sigmas_mm: Sequence[float],
    contrast_hu: float,
) -> Float32[np.ndarray, "nz ny nx"]:
    """Return the largest response over scales: 0 where nothing is tube-like, about 1 in the middle of a bright tube.

    Of the Hessian's eigenvalues λ₁ ≤ λ₂ ≤ λ₃ at scale σ, a bright tube has λ₁ ≈ λ₂ ≪ 0; the surface of a chamber has
    only λ₁ ≪ 0. The response is therefore −σ²λ₂ (Sato et al. 1998), divided by e⁻¹ times the contrast, which is what a
    straight tube of radius √2·σ gives: its profile 1 − exp(−r²/2σ²) has −σ²·d²/dx² = u·exp(−u) with u = r²/2σ². It is 0
    but `where` it is wanted, and at the border; a tube of radius r answers most at σ = r/√2.
    """
    where = where.copy()
    for axis in range(3):
        border: list[slice | list[int]] = [slice(None)] * 3
        border[axis] = [0, -1]
        where[tuple(border)] = False
    k, j, i = np.nonzero(where)
    best = np.zeros(len(k), dtype=np.float32)
    for sigma in sigmas_mm:
        smooth = np.asarray(ndimage.gaussian_filter(hu, sigma / spacing_mm, truncate=3.0))
        middle = _middle_eigenvalue(*_hessian(smooth, k, j, i))
        response = -middle * np.float32((sigma / spacing_mm) ** 2 * np.e / contrast_hu)
        np.maximum(best, response, out=best)
    result = np.zeros(hu.shape, dtype=np.float32)
    result[k, j, i] = best
    return result


def _hessian(smooth: np.ndarray, k: np.ndarray, j: np.ndarray, i: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the second differences xx, yy, zz, xy, xz, yz at some voxels, HU per voxel²."""

    def at(dk: int, dj: int, di: int) -> np.ndarray:
        return smooth[k + dk, j + dj, i + di]

    centre = 2 * at(0, 0, 0)
    return (
        at(0, 0, 1) + at(0, 0, -1) - centre,
        at(0, 1, 0) + at(0, -1, 0) - centre,
        at(1, 0, 0) + at(-1, 0, 0) - centre,
        (at(0, 1, 1) + at(0, -1, -1) - at(0, 1, -1) - at(0, -1, 1)) / 4,
        (at(1, 0, 1) + at(-1, 0, -1) - at(1, 0, -1) - at(-1, 0, 1)) / 4,
        (at(1, 1, 0) + at(-1, -1, 0) - at(1, -1, 0) - at(-1, 1, 0)) / 4,
    )


def _middle_eigenvalue(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> np.ndarray:
    """Return symmetric 3×3 matrices' middle eigenvalue (Smith 1961), 25 times as fast as by LAPACK matrix by matrix."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt(np.maximum((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6, 1e-12))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2 * spread**3), -1, 1)) / 3
    return mean + 2 * spread * np.cos(angle - 2 * np.pi / 3)


def track_tree(
    response: Float[np.ndarray, "nz ny nx"],
    passable: Bool[np.ndarray, "nz ny nx"],
    start: Int[np.ndarray, "3"],
    ends: list[Int[np.ndarray, "3"]],
    spacing_mm: float,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the paths (voxel indices k, j, i) from `start` to every distal end, farthest first, each from where it
    leaves those before it, until what is left is shorter than a branch (after TEASAR, Sato et al. 2000). A strong
    vesselness makes steps in `passable` voxels cheap; `ends` must be reached, whatever the length."""
    voxels = np.argwhere(passable)
    number = np.full(passable.shape, -1, dtype=np.int32)
    number[passable] = np.arange(len(voxels))
    root = int(number[tuple(start)])
    lengths, costs = _graphs(number, voxels, response[passable])
    _, before = dijkstra(costs, indices=root, return_predecessors=True)
    length = dijkstra(lengths, indices=root) * spacing_mm
    # The box around the tree, not the volume, bounds the distance transform.
    corner, opposite = voxels.min(axis=0), voxels.max(axis=0) + 1
    box = np.pad(passable[tuple(slice(a, b) for a, b in zip(corner, opposite, strict=True))], 1)
    depth = distance_to_outside(box, spacing_mm)[tuple((voxels - corner + 1).T)]

    left = np.isfinite(length)
    on_path = np.zeros(len(voxels), dtype=bool)
    pending = [int(number[tuple(end)]) for end in ends if np.isfinite(length[number[tuple(end)]])]
    paths = []
    while pending or left.any():
        asked = bool(pending)
        tip = pending.pop() if asked else int(np.where(left, length, -1.0).argmax())
        path = _trace(before, tip, on_path)
        if asked or not paths or length[path[-1]] - length[path[0]] >= _SHORTEST_BRANCH_MM:
            paths.append(voxels[path])
            on_path[path] = True
        # The path stands for what lies within the lumen around it, and for a bump too short to be a branch.
        left[tip] = False
        remaining = np.flatnonzero(left)
        distance, nearest = KDTree(voxels[path]).query(voxels[remaining])
        left[remaining[distance * spacing_mm <= 1.5 * depth[path][nearest] + 1.5]] = False
    return [_smooth(path, _SMOOTHING_MM / spacing_mm) for path in sorted(paths, key=len, reverse=True)]


def _graphs(number: np.ndarray, voxels: np.ndarray, response: np.ndarray) -> tuple[csr_matrix, csr_matrix]:
    """Return the graphs of neighbouring voxels, weighted with the step's length and with its cost."""
    shape = np.array(number.shape)
    rows, columns, steps = [], [], []
    half = [offset for offset in product((-1, 0, 1), repeat=3) if offset > (0, 0, 0)]
    for offset in half:
        other = voxels + np.array(offset)
        exists = np.all((other >= 0) & (other < shape), axis=1)
        target = np.full(len(voxels), -1)
        target[exists] = number[tuple(other[exists].T)]
        linked = np.flatnonzero(target >= 0)
        rows.append(linked)
        columns.append(target[linked])
        steps.append(np.full(len(linked), np.linalg.norm(offset)))
    a, b, step = np.concatenate(rows), np.concatenate(columns), np.concatenate(steps)
    price = 1 / (_COST_FLOOR + np.clip(response, 0, 1))
    cost = step * (price[a] + price[b]) / 2
    size = (len(voxels), len(voxels))
    both = (np.concatenate([a, b]), np.concatenate([b, a]))
    return csr_matrix((np.tile(step, 2), both), shape=size), csr_matrix((np.tile(cost, 2), both), shape=size)


def _trace(before: np.ndarray, tip: int, on_path: np.ndarray) -> Int[np.ndarray, "n"]:
    path = [tip]
    while before[path[-1]] >= 0 and not on_path[path[-1]]:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def _smooth(path: Int[np.ndarray, "n 3"], sigma: float) -> Float[np.ndarray, "n 3"]:
    """Smooth a path with its ends held: it is continued point-symmetrically beyond them."""
    line = path.astype(float)
    head, tail = 2 * line[0] - line[:0:-1], 2 * line[-1] - line[-2::-1]
    smooth = ndimage.gaussian_filter1d(np.concatenate([head, line, tail]), sigma, axis=0)
    return smooth[len(head) : len(head) + len(line)]


_NOISE_MM = 0.3  # width of the Gaussian against noise, mm: about the scanner's own blur
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
    hu = ndimage.gaussian_filter(volume.voxels.astype(np.float32), _NOISE_MM / spacing, truncate=3.0)
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
