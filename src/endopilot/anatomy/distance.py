"""The signed distance to the vessel wall, from inscribed spheres, and the guiding catheter joined to it: the union of
round cones along branches, joined smoothly, so that a quadratic B-spline of it is a good contact potential."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.lines import length_along
from endopilot.types import Centerline, DistanceMap, Insertion, VesselTree
from endopilot.vessels.surface import BAND_MM, MAXIMUM_GRID_POINTS, grid_of

FILLET = 0.5  # strength of the fillet where a branch leaves its parent, in radii of the branch
CATHETER_RADIUS_MM = 0.9  # inside of a 6 French guiding catheter, 0.071 inch across (Medtronic Launcher)
CATHETER_LENGTH_MM = 20.0  # length of catheter behind the ostium that a distance map holds, mm
ENGAGED_MM = 3.0  # a guiding catheter's tip lies this deep in the ostium, mm


def automatic_spacing(radius: Float[np.ndarray, "n"], extent_mm: Float[np.ndarray, "3"]) -> float:
    """Return a grid spacing in mm that resolves the lumen: 0.45 times the radius that all but the narrowest twentieth
    of the centerline exceeds, from 0.3 to 1.5 mm, and no smaller than `MAXIMUM_GRID_POINTS` allows over `extent_mm`."""
    spacing = float(np.clip(0.45 * np.quantile(radius, 0.05), 0.3, 1.5))
    smallest = float(np.prod(np.maximum(extent_mm, 1.0)) / MAXIMUM_GRID_POINTS) ** (1 / 3)
    return round(max(spacing, smallest), 3)


def distance_map_from_spheres(
    tree: VesselTree, *, beside: Sequence[Sequence[Centerline]] = (), spacing_mm: float | None = None
) -> DistanceMap:
    """Return the signed distance to the smooth union of a tree's inscribed spheres; `beside` are further lines of
    spheres of each branch's lumen. The spacing, mm, is `automatic_spacing`'s if None."""
    lumens = [[branch.centerline] for branch in tree.branches]
    for own, others in zip(lumens, beside, strict=False):
        own.extend(others)
    whole = Centerline.joined(line for own in lumens for line in own)
    margin = whole.radius[:, None] + BAND_MM
    lower, upper = (whole.points - margin).min(axis=0), (whole.points + margin).max(axis=0)
    spacing = automatic_spacing(whole.radius, upper - lower) if spacing_mm is None else float(spacing_mm)
    shape, origin = grid_of(lower, upper, spacing)
    result = DistanceMap(np.full(shape, -BAND_MM, dtype=np.float32), spacing, origin)
    for own in lumens:
        radius = own[0].radius
        _join(result, own, BAND_MM, FILLET * float(radius[min(len(radius) - 1, 3)]))
    return result


def _join(distance_map: DistanceMap, lines: Sequence[Centerline], band: float, fillet_mm: float) -> None:
    values, spacing, origin = distance_map.values, distance_map.spacing_mm, distance_map.origin_mm
    window = _window(Centerline.joined(lines), origin, spacing, values.shape, band)
    corner = origin + spacing * np.array([part.start for part in window[::-1]])
    field = np.maximum.reduce([_tube_field(line, values[window].shape, corner, spacing, band) for line in lines])
    values[window] = smooth_union(values[window], field, spacing_mm=spacing, fillet_mm=fillet_mm)


def add_catheter(
    distance_map: DistanceMap, insertion: Insertion, radius_mm: float, length_mm: float = CATHETER_LENGTH_MM
) -> DistanceMap:
    """Return the map, grown as needed, joined with a straight guiding catheter of `length_mm`, a tube with a round end
    centred on the ostium: open by at least `radius_mm`. Raises InputError for a radius or length that is not positive.
    """
    if not (radius_mm > 0 and length_mm > 0):
        raise InputError(f"catheter: radius {radius_mm} mm and length {length_mm} mm must both be positive")
    spacing, band = distance_map.spacing_mm, -float(distance_map.values.min())
    steps = max(2, math.ceil(length_mm / max(radius_mm, spacing)))
    abscissa = np.linspace(-length_mm, 0.0, steps)
    line = Centerline(
        points=insertion.position + abscissa[:, None] * insertion.direction,
        radius=np.full(steps, float(radius_mm)),
        abscissa=abscissa,
        normals=np.zeros((steps, 3)),
    )
    grown = _grow(distance_map, line.points.min(axis=0), line.points.max(axis=0), radius_mm + band, -band)
    _join(grown, [line], band, FILLET * float(radius_mm))
    return grown


def smooth_union(
    first: Float[np.ndarray, "nz ny nx"], second: Float[np.ndarray, "nz ny nx"], *, spacing_mm: float, fillet_mm: float
) -> Float[np.ndarray, "nz ny nx"]:
    """Return the union of two signed distances with a fillet where walls cross: ``max(a, b) + (k − |a − b|)₊² / 4k``,
    whose k = fillet · (1 − cos θ) falls with the angle of the gradients, so that tubes that carry on do not bulge."""
    highest = np.maximum(first, second)
    near = np.abs(first - second) < 2 * fillet_mm
    near &= (first > first.min()) & (second > second.min())
    if fillet_mm <= 0 or not near.any() or min(first.shape) < 2:
        return highest
    box = tuple(slice(max(0, i.min() - 1), i.max() + 2) for i in np.nonzero(near))
    one, two, inside = first[box], second[box], near[box]
    if min(one.shape) < 2:
        return highest
    gradients = [np.stack([g[inside] for g in np.gradient(field, spacing_mm)], axis=-1) for field in (one, two)]
    lengths = [np.maximum(np.linalg.norm(gradient, axis=-1), 1e-3) for gradient in gradients]
    cosine = np.sum(gradients[0] * gradients[1], axis=-1) / (lengths[0] * lengths[1])
    cosine[np.minimum(*lengths) < 0.5] = 1.0  # on a medial axis there is no direction, and no wall to round
    width = np.maximum(fillet_mm * (1.0 - np.clip(cosine, -1.0, 1.0)), 1e-6)
    lift = np.maximum(width - np.abs(one[inside] - two[inside]), 0.0) ** 2 / (4.0 * width)
    result = highest[box]
    result[inside] += lift.astype(result.dtype)
    highest[box] = result
    return highest


def sample(distance_map: DistanceMap, points: Float[np.ndarray, "n 3"], *, order: int = 1) -> Float[np.ndarray, "n"]:
    """Return the map's value in mm at LPS points, by spline interpolation; outside the grid, the nearest value."""
    from scipy.ndimage import map_coordinates

    index = (points - distance_map.origin_mm) / distance_map.spacing_mm
    return map_coordinates(distance_map.values, index[:, ::-1].T, order=order, mode="nearest", output=np.float64)


def _grow(
    distance_map: DistanceMap, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], margin: float, fill: float
) -> DistanceMap:
    spacing, origin = distance_map.spacing_mm, distance_map.origin_mm
    size = np.array(distance_map.values.shape[::-1])
    before = np.maximum(0, np.ceil((origin - (lower - margin)) / spacing)).astype(int)
    after = np.maximum(0, np.ceil((upper + margin - origin) / spacing).astype(int) - (size - 1))
    pad = [(int(before[axis]), int(after[axis])) for axis in (2, 1, 0)]
    values = np.pad(distance_map.values, pad, constant_values=np.float32(fill))
    return DistanceMap(values=values, spacing_mm=spacing, origin_mm=origin - before * spacing)


def _window(
    line: Centerline, origin: Float[np.ndarray, "3"], spacing: float, shape: tuple[int, ...], band: float
) -> tuple[slice, slice, slice]:
    margin = line.radius[:, None] + band
    first = np.floor(((line.points - margin).min(axis=0) - origin) / spacing).astype(int)
    last = np.ceil(((line.points + margin).max(axis=0) - origin) / spacing).astype(int) + 1
    first = np.maximum(first, 0)
    last = np.minimum(last, np.array(shape[::-1]))
    return (slice(first[2], last[2]), slice(first[1], last[1]), slice(first[0], last[0]))


def _tube_field(
    line: Centerline, shape: tuple[int, ...], corner: Float[np.ndarray, "3"], spacing: float, band: float
) -> Float[np.ndarray, "nz ny nx"]:
    """Return the union of the round cones along a line on a grid, −band far outside.

    A round cone is the union of the spheres whose centre c(τ) moves from a to b and whose radius r(τ) = r_a − sτ is
    linear. Its value max over τ of r(τ) − |p − c(τ)| is concave in τ, with its maximum at τ = t − q·s/√(1 − s²),
    where t and q are p's coordinates along and across the axis.
    """
    values = np.full(shape, -band, dtype=np.float32)
    points, radius = _thinned(line, 0.5 * spacing)
    axes = [(corner[axis] + spacing * np.arange(shape[2 - axis])) for axis in range(3)]
    for start, end, r_start, r_end in zip(points[:-1], points[1:], radius[:-1], radius[1:], strict=True):
        reach = np.maximum(r_start, r_end) + band
        ranges = []
        for axis in range(3):
            low = math.ceil((min(start[axis], end[axis]) - reach - corner[axis]) / spacing)
            high = math.floor((max(start[axis], end[axis]) + reach - corner[axis]) / spacing) + 1
            ranges.append(slice(max(low, 0), max(min(high, shape[2 - axis]), 0)))
        x, y, z = ((axes[axis][ranges[axis]] - start[axis]).astype(np.float32) for axis in range(3))
        if min(x.size, y.size, z.size) == 0:
            continue
        length = float(np.linalg.norm(end - start))
        direction = ((end - start) / length).astype(np.float32) if length > 1e-9 else np.zeros(3, dtype=np.float32)
        slope = (r_start - r_end) / length if length > 1e-9 else 0.0
        along = (z * direction[2])[:, None, None] + (y * direction[1])[None, :, None] + x * direction[0]
        square = (z * z)[:, None, None] + (y * y)[None, :, None] + x * x
        if abs(slope) >= 1.0:  # one end sphere holds the other
            centre = np.float32(0.0 if slope > 0 else length)
        else:
            across = np.sqrt(np.maximum(square - along * along, 0.0))
            centre = np.clip(along - across * np.float32(slope / math.sqrt(1.0 - slope * slope)), 0.0, length)
        distance = np.sqrt(np.maximum(square - 2.0 * along * centre + centre * centre, 0.0))
        here = values[ranges[2], ranges[1], ranges[0]]
        np.maximum(here, np.float32(r_start) - np.float32(slope) * centre - distance, out=here)
    return values


def _thinned(line: Centerline, step: float) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    length = length_along(line.points)
    if len(length) < 3 or length[-1] < step:
        return line.points, line.radius
    keep = np.unique(np.searchsorted(length, np.arange(0.0, length[-1], step)))
    keep = np.union1d(keep, [0, len(length) - 1])
    return line.points[keep], line.radius[keep]
