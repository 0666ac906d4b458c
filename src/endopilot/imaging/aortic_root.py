"""The aortic root of a cardiac CT angiogram, the largest round bright disc, where vessels open into it, and their
ostia."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from endopilot.errors import InputError
from endopilot.imaging.grid import LEAST_BLOOD_HU, connected_components, distance_to_outside
from endopilot.lines import length_along
from endopilot.types import Insertion, Volume

_LEVELS_HU = (180.0, 230.0, 290.0, 360.0)  # thresholds tried one after another, until the aorta stands apart
_RADIUS_MM = (9.0, 24.0)  # inner radii of ascending aortas, mm: normal 12-18 (Wolak 2008), and small or dilated ones
_ROUND_SHARE = 0.6  # share of the directions in which the edge must lie near the circle; neighbours touch in the others
_FEWEST_SLICES_MM = 10.0  # length over which the disc must persist, mm
_MOST_ROOTS = 3  # chains of discs that are returned at most: the pulmonary trunk may be one, and the descending aorta
_DIRECTIONS = 32
_BRIGHTEST_HU = 600.0  # contrast in the superior vena cava is brighter, and no more likely to be the aorta
_BALL_MM = 7.0  # ball that opens the aorta: its surface goes on under the artery's mouth
_BOX_MM = 18.0  # half the edge of the box around the artery's beginning that is looked at, mm
_SECTIONS_MM = np.arange(1.0, 6.01, 0.5)  # heights above the aortic wall at which the artery's middle is measured, mm
_FITTED = 8  # so many of the lowest sections carry the parabola that goes on to the wall
_NEAR_MM = 4.5  # blood farther than this from the tracked path is not this artery's
_MOUTH_MM = 3.0  # nearer than this to the artery's axis, the opened aorta bulges into the mouth
_WALL_MM = 3.0  # width of the wall around the mouth from which the wall without the mouth is estimated, mm
_FEWEST_OF_WALL = 100  # with fewer voxels of wall around the mouth, the wall is not estimated
_DEEPEST_MM = 1.0  # a ball that opens the aorta bulges no deeper into a mouth: its cap of 3.5 mm radius is 0.9 mm high
TO_WALL_MM = 3.5  # a tree starts within this distance of the aorta's wall, where vesselness fades
_OPENING_MM = 5.0  # blood that joins a vessel to the aorta is looked for this far around its voxel nearest the wall


@dataclass(frozen=True, eq=False)
class AorticRoot:
    """The ascending aorta as discs (`centres` LPS mm, `radius` mm), one an axial slice from the lowest up; `blood_hu`
    is their median."""

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
    """Return one to three places that may be the ascending aorta, the likeliest first, on a `grid` in HU, of about 1.5
    mm. Raises InputError without contrast or such a vessel."""
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
    other = taken.get(disc.k)
    return other is not None and float(np.hypot(disc.j - other.j, disc.i - other.i)) < other.radius


def _weight(chain: list[_Disc]) -> float:
    """Rank chains: long, wide, round and bright; the right heart is often as round, and dimmer."""
    return sum((disc.radius * disc.roundness * disc.hu for disc in chain), start=0.0)


def _within(plane: np.ndarray, j: float, i: float, radius: float) -> np.ndarray:
    y, x = np.ogrid[: plane.shape[0], : plane.shape[1]]
    return plane[(y - j) ** 2 + (x - i) ** 2 <= radius**2]


def _discs(plane: Float[np.ndarray, "ny nx"], k: int, level: float, spacing: float) -> list[_Disc]:
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


@dataclass(frozen=True, eq=False)
class Opening:
    """Where a vessel comes to the aortic wall: its `voxel` (k, j, i) there, and its number among the connected ones."""

    voxel: Int[np.ndarray, "3"]
    vessel: int


def box_around(index: np.ndarray, margin: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the slices (k, j, i) around some voxel indices with a margin, clipped to the volume."""
    low = np.maximum(np.floor(index.min(axis=0) - margin).astype(int), 0)
    high = np.minimum(np.ceil(index.max(axis=0) + margin).astype(int) + 1, shape)
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def opens_into(
    hu: Float[np.ndarray, "nz ny nx"],
    blood_hu: float,
    aorta: Bool[np.ndarray, "nz ny nx"],
    vessel: Bool[np.ndarray, "nz ny nx"],
    start: Int[np.ndarray, "3"],
    spacing_mm: float,
) -> bool:
    """Return whether blood joins a vessel to the aorta around the vessel's voxel nearest to it."""
    box = box_around(start[None], np.full(3, _OPENING_MM / spacing_mm), vessel.shape)
    blood = hu[box] > blood_hu
    label = connected_components(blood)
    return bool(np.intersect1d(label[vessel[box] & blood], label[aorta[box] & blood]).size)


def openings(
    hu: Float[np.ndarray, "nz ny nx"],
    blood_hu: float,
    aorta: Bool[np.ndarray, "nz ny nx"],
    vessels: Int[np.ndarray, "nz ny nx"],
    spacing_mm: float,
) -> list[Opening]:
    """Return all places where blood joins a vessel to the aorta; `vessels` numbers connected vessels, 0 is none."""
    if not aorta.any():
        return []
    box = box_around(np.argwhere(aorta), np.full(3, TO_WALL_MM / spacing_mm + 1), aorta.shape)
    gap = distance_to_outside(~aorta[box], spacing_mm)
    patches = connected_components((gap <= TO_WALL_MM) & (vessels[box] > 0), corners=True)
    corner = np.array([part.start for part in box])
    found = []
    for patch in range(1, int(patches.max()) + 1):
        voxels = np.argwhere(patches == patch)
        nearest = voxels[gap[tuple(voxels.T)].argmin()] + corner
        number = int(vessels[tuple(nearest)])
        if opens_into(hu, blood_hu, aorta, vessels == number, nearest, spacing_mm):
            found.append(Opening(nearest, number))
    return found


def find_ostium(
    path: Float[np.ndarray, "n 3"],
    blood: Bool[np.ndarray, "nz ny nx"],
    aorta: Bool[np.ndarray, "nz ny nx"],
    grid: Volume,
) -> tuple[Insertion, Float[np.ndarray, "m 3"]]:
    """Return the ostium, and the path (LPS mm) begun anew from there. A parabola through centroids of the artery's
    blood at several heights is carried on to the wall; a second round looks around it, for the tracked path begins at
    the mouth's edge. `blood` is above half the lumen's HU; `aorta` is rough; both lie on `grid`."""
    spacing = float(grid.spacing_mm[0])
    half = round(_BOX_MM / spacing)
    centre = np.round(grid.world_to_index(path[0])).astype(int)[::-1]
    corner = np.clip(centre - half, 0, None)
    box = tuple(slice(a, b) for a, b in zip(corner, centre + half + 1, strict=True))
    deep = (distance_to_outside(blood[box], spacing) >= _BALL_MM) & aorta[box]
    if not deep.any():
        return Insertion(path[0], _heading(path)), path
    height = distance_to_outside(~deep, spacing) - _BALL_MM
    ostium = Insertion(path[0], _heading(path))
    for _ in range(2):
        middles = _middles(path, blood[box], height, corner, grid)
        if len(middles) < 3:
            break
        heights = np.array(sorted(middles))[:_FITTED]
        points = np.array([middles[h] for h in heights])
        fit = np.polynomial.Polynomial.fit
        curves = [fit(heights, points[:, axis], 2 if len(heights) >= 5 else 1) for axis in range(3)]
        wall = _height_of_wall(np.array([curve(0.0) for curve in curves]), height, corner, grid)
        position = np.array([curve(wall) for curve in curves])
        slope = np.array([curve.deriv()(0.5) for curve in curves])
        beginning = np.array([[curve(h) for curve in curves] for h in np.arange(wall, heights[-1] + 0.01, 0.25)])
        kept = np.linalg.norm(path - position, axis=1) > np.linalg.norm(beginning[-1] - position) + 1.0
        first = int(np.argmax(kept)) if kept.any() else len(path) - 1
        path = np.concatenate([beginning, path[first:]])
        ostium = Insertion(position, slope / np.linalg.norm(slope))
    return ostium, path


def _height_of_wall(
    mouth: Float[np.ndarray, "3"], height: Float[np.ndarray, "nz ny nx"], corner: np.ndarray, grid: Volume
) -> float:
    """Return the aortic wall's height under the artery's mouth, mm, by a quadric through the wall around, less
    outliers."""
    spacing = float(grid.spacing_mm[0])
    near = np.argwhere(np.abs(height) < 0.8 * spacing)
    offset = grid.index_to_world((near + corner)[:, ::-1].astype(float)) - mouth
    close = np.linalg.norm(offset, axis=1) < _MOUTH_MM + _WALL_MM
    offset, level = offset[close], height[tuple(near[close].T)]
    if len(offset) == 0:
        return 0.0
    slope = [values[tuple(near[close].T)] for values in np.gradient(height)]
    outward = np.array([values.mean() for values in slope])[::-1]
    outward = grid.direction @ outward / max(float(np.linalg.norm(outward)), 1e-9)
    above = offset @ outward
    u, v = (offset @ axis for axis in np.linalg.svd(outward[None])[2][1:])
    around = np.hypot(u, v) > _MOUTH_MM
    if around.sum() < _FEWEST_OF_WALL:
        return 0.0
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)[around]
    place = (above - level)[around]
    found = np.linalg.lstsq(terms, place, rcond=None)[0]
    for _ in range(2):
        error = np.abs(place - terms @ found)
        kept = error <= max(2.5 * float(np.median(error)), 0.2)
        found = np.linalg.lstsq(terms[kept], place[kept], rcond=None)[0]
    return float(np.clip(found[0], -_DEEPEST_MM, 0.0))


def _middles(
    path: np.ndarray, blood: np.ndarray, height: np.ndarray, corner: np.ndarray, grid: Volume
) -> dict[float, Float[np.ndarray, "3"]]:
    """Return the centroid of the artery's blood by height above the wall, mm, from the wall to where it is lost."""
    along = length_along(path)
    near = path[along < 12.0]
    back = near[0] - np.arange(0.5, 4.0, 0.5)[:, None] * _heading(path)
    outside = blood & (height > _SECTIONS_MM[0] - 0.5)
    label = connected_components(outside)
    at = np.round(grid.world_to_index(near)).astype(int)[:, ::-1] - corner
    at = at[np.all((at >= 0) & (at < blood.shape), axis=1)]
    names = label[tuple(at.T)]
    if not (names > 0).any():
        return {}
    voxels = np.argwhere(label == np.bincount(names[names > 0]).argmax())
    points = grid.index_to_world((voxels + corner)[:, ::-1].astype(float))
    distance, _ = KDTree(np.concatenate([back, near])).query(points)
    points, level = points[distance < _NEAR_MM], height[tuple(voxels[distance < _NEAR_MM].T)]
    middles = {}
    for h in _SECTIONS_MM:
        section = points[np.abs(level - h) < 0.5]
        if len(section) < 8:
            break
        middles[float(h)] = section.mean(axis=0)
    return middles


def _heading(path: np.ndarray) -> Float[np.ndarray, "3"]:
    smooth = ndimage.gaussian_filter1d(path, 3.0, axis=0, mode="nearest")
    step = smooth[min(8, len(path) - 1)] - smooth[0]
    return step / max(float(np.linalg.norm(step)), 1e-9)
