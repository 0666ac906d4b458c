"""Finding the ascending aorta in a cardiac CT angiogram: the largest round bright disc that goes on slice by slice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from endopilot.errors import InputError
from endopilot.imaging.grid import LEAST_BLOOD_HU
from endopilot.types import Volume

_LEVELS_HU = (180.0, 230.0, 290.0, 360.0)
"""Thresholds tried one after another: at one of them the aorta stands apart from its neighbours."""
_RADIUS_MM = (9.0, 24.0)
"""Inner radii of ascending aortas, mm: normal 12-18 (Wolak 2008), with room for small women and aneurysms."""
_ROUND_SHARE = 0.6
"""Share of the directions in which the edge must lie near the circle; neighbours touch in the others."""
_FEWEST_SLICES_MM = 10.0
"""Length over which the disc must persist, mm."""
_MOST_ROOTS = 3
"""Chains of discs that are returned at most: the pulmonary trunk may be one, and the descending aorta."""
_DIRECTIONS = 32
_BRIGHTEST_HU = 600.0
"""Undiluted contrast in the superior vena cava is brighter than this, and no more likely to be the aorta."""


@dataclass(frozen=True, eq=False)
class AorticRoot:
    """The ascending aorta as discs, one an axial slice, from the lowest to the highest.

    Attributes:
        centres: LPS mm.
        radius: mm.
        blood_hu: median HU inside.
    """

    centres: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    blood_hu: float


@dataclass(frozen=True)
class _Disc:
    """A round bright disc in slice `k`: centre and radius in voxels, share of round edge, mean HU (capped)."""

    k: int
    j: float
    i: float
    radius: float
    roundness: float
    hu: float


def find_aortic_roots(grid: Volume) -> list[AorticRoot]:
    """Find what may be the ascending aorta, the likeliest first: a right heart as bright as the left is as likely.

    Args:
        grid: CT in HU along the LPS axes, isotropic, of about 1.5 mm: finer detail is of no use here.

    Returns:
        One to three, apart from each other.

    Raises:
        InputError: no contrast, or no such vessel in the volume.
    """
    hu = np.asarray(ndimage.gaussian_filter(grid.voxels, 0.7))
    spacing = float(grid.spacing_mm[0])
    if (ndimage.minimum_filter(hu, round(9.0 / spacing)) > LEAST_BLOOD_HU).sum() == 0:
        raise InputError(
            f"the volume holds no contrast-filled blood pool: nothing 9 mm wide exceeds {LEAST_BLOOD_HU:.0f} HU; "
            "give a CT angiogram in HU"
        )
    levels = [[_discs(hu[k], k, level, spacing) for k in range(len(hu))] for level in _LEVELS_HU]
    roots: list[AorticRoot] = []
    while len(roots) < _MOST_ROOTS:
        best = max((_best_chain(slices) for slices in levels), key=_weight)
        if len(best) * spacing < _FEWEST_SLICES_MM:
            break
        discs = np.array([[disc.i, disc.j, disc.k] for disc in best])
        radius = np.array([disc.radius for disc in best])
        blood = np.median(np.concatenate([_within(hu[disc.k], disc.j, disc.i, 0.7 * disc.radius) for disc in best]))
        roots.append(AorticRoot(grid.index_to_world(discs), radius * spacing, float(blood)))
        taken = {disc.k: disc for disc in best}
        levels = [[[disc for disc in discs if not _overlaps(disc, taken)] for discs in slices] for slices in levels]
    if not roots:
        raise InputError(
            "the ascending aorta was not found; give a CT angiogram that holds the aortic root, or seeds: the ostium "
            "first, then points along the vessel"
        )
    return roots


def _overlaps(disc: _Disc, taken: dict[int, _Disc]) -> bool:
    """Return whether a disc's middle lies in the disc that is taken in its slice."""
    other = taken.get(disc.k)
    return other is not None and float(np.hypot(disc.j - other.j, disc.i - other.i)) < other.radius


def _weight(chain: list[_Disc]) -> float:
    """Rank chains: long, wide, round and bright; the right heart is often as round, and dimmer."""
    return sum((disc.radius * disc.roundness * disc.hu for disc in chain), start=0.0)


def _within(plane: np.ndarray, j: float, i: float, radius: float) -> np.ndarray:
    y, x = np.ogrid[: plane.shape[0], : plane.shape[1]]
    return plane[(y - j) ** 2 + (x - i) ** 2 <= radius**2]


def _discs(plane: Float[np.ndarray, "ny nx"], k: int, level: float, spacing: float) -> list[_Disc]:
    """Return the round discs above a level in one slice."""
    depth = np.asarray(ndimage.distance_transform_edt(plane > level))
    low, high = (radius / spacing for radius in _RADIUS_MM)
    peaks = (depth >= 0.8 * low) & (depth <= high) & (depth == ndimage.maximum_filter(depth, round(6.0 / spacing)))
    angle = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    steps = np.arange(0.0, 1.6 * high, 0.5)
    found = []
    for peak in np.argwhere(peaks):
        j, i, radius, roundness = float(peak[0]), float(peak[1]), 0.0, 0.0
        for _ in range(2):  # the second round starts from the centre that the first one found
            y, x = j + np.outer(np.sin(angle), steps), i + np.outer(np.cos(angle), steps)
            outside = ndimage.map_coordinates(plane, [y, x], order=1, cval=-1000.0) < level
            edge = np.where(outside.any(axis=1), steps[outside.argmax(axis=1)], 2 * high)
            typical = float(np.quantile(edge, 0.4))
            near = np.abs(edge - typical) < 0.15 * typical + 0.5
            roundness = float(near.mean())
            if roundness < _ROUND_SHARE / 2:
                break
            j, i, radius = _fit_circle(j + np.sin(angle[near]) * edge[near], i + np.cos(angle[near]) * edge[near])
        if low <= radius <= high and roundness >= _ROUND_SHARE:
            hu = min(float(_within(plane, j, i, 0.7 * radius).mean()), _BRIGHTEST_HU)
            found.append(_Disc(k, j, i, radius, roundness, hu))
    return found


def _fit_circle(y: np.ndarray, x: np.ndarray) -> tuple[float, float, float]:
    """Return centre and radius of the least-squares circle (Kåsa 1976): x² + y² = 2ax + 2by + c."""
    solution, *_ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], axis=1), x**2 + y**2, rcond=None)
    a, b, c = solution
    return float(b), float(a), float(np.sqrt(max(c + a * a + b * b, 0.0)))


def _best_chain(slices: list[list[_Disc]]) -> list[_Disc]:
    """Return the heaviest chain of discs that move and grow little from one slice to the next."""
    best: list[_Disc] = []
    tails: list[list[_Disc]] = []
    for discs in slices:
        grown = []
        for disc in discs:
            before = [
                tail
                for tail in tails
                if np.hypot(disc.j - tail[-1].j, disc.i - tail[-1].i) < 0.2 * disc.radius
                and abs(disc.radius - tail[-1].radius) < 0.06 * disc.radius
            ]
            grown.append([*max(before, key=_weight, default=[]), disc])
        best = max([best, *grown], key=_weight)
        tails = grown
    return best
