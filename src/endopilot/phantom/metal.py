"""Metal in the chest: pacemaker leads and stents, as points of matter, and the streaks that they draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import zoom

from endopilot.atlas import curves as shape
from endopilot.atlas.heart_reference import HeartFit
from endopilot.lines import length_along, places_on
from endopilot.phantom.painter import Grid
from endopilot.types import Centerline

_LEADS = (
    [(-12, 17, 60), (-15, 20, -5), (-18, 14, -30), (-6, -6, -43), (12, -26, -45), (33, -43, -51)],
    [(-11, 18, 60), (-15, 21, -8), (-20, 14, -16), (-19, 2, 2), (-13, -5, 8)],
)
"""From the upper vena cava to the right ventricle's apex, and to the right atrium's appendage (reference heart, mm)."""
_LEAD_MM, _LEAD_HU = 0.9, 9000.0  # radius of a lead, and mean CT number of conductors and insulation
_STRUT_MM2, _STRUT_HU = 0.01, 25000.0  # cross-section of a strut (0.1 mm by 0.1 mm), its metal's CT number
_CROWN_MM, _CROWNS = 1.4, 6  # a stent is a row of zigzag rings this long, each with so many peaks
_WATER = 2e-5  # attenuation of water divided by 1000: 1 HU along 1 mm adds this to the line integral
_SATURATION = 4.0  # line integral that the beam approaches behind ever more metal: softer photons are gone
_VIEWS = 120  # views of half a turn
_BIN_MM = 1.0  # width of the detector's bins, and spacing of the grid on which streaks are reconstructed, mm
_SWAY_MM = 1.5  # metal in the heart moves this far during a slice's scan, mm: views disagree, streaks result


@dataclass(frozen=True, eq=False)
class Metal:
    """Metal as points of matter, LPS mm, and of each its excess CT number times volume, HU mm³."""

    points: Float[np.ndarray, "n 3"]
    mass: Float[np.ndarray, "n"]


def leads(heart: HeartFit, count: int) -> list[Metal]:
    """Return pacemaker leads: the first to the right ventricle's apex, the second to the right atrial appendage."""
    found = []
    for waypoints in _LEADS[:count]:
        line = heart.from_reference(shape.curve_through(np.array(waypoints, dtype=float)))
        line = shape.curve_through(line[::4], 0.25)
        normal = shape.parallel_normals(shape.tangents(line))
        side = np.cross(shape.tangents(line), normal)
        u, v = np.meshgrid(*[np.arange(-0.75, 0.76, 0.3)] * 2)
        inside = np.hypot(u, v) < _LEAD_MM
        across = u[inside][:, None, None] * normal + v[inside][:, None, None] * side
        points = (line + across).reshape(-1, 3)
        total = np.pi * _LEAD_MM**2 * float(length_along(line)[-1]) * _LEAD_HU
        found.append(Metal(points, np.full(len(points), total / len(points))))
    return found


def stents(lines: Sequence[Centerline], count: int, generator: np.random.Generator) -> list[Metal]:
    """Return stents in the proximal halves of vessels, in turn: zigzag rings of struts at the lumen's wall."""
    found = []
    for number in range(count):
        line = lines[number % len(lines)]
        length = float(generator.uniform(14.0, 26.0))
        begin = float(generator.uniform(8.0, max(0.5 * line.abscissa[-1] - length, 9.0)))
        turn = np.arange(0.0, 2 * np.pi, 0.01)
        zigzag = 0.5 * _CROWN_MM * (2 / np.pi) * np.arcsin(np.sin(_CROWNS * turn))
        along = (begin + np.arange(0.0, length, _CROWN_MM)[:, None] + zigzag).ravel()
        around = np.tile(turn, len(along) // len(turn))
        along = np.clip(along, 0.0, line.abscissa[-1])
        normal = places_on(line.normals, line.abscissa, along)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        side = np.cross(places_on(shape.tangents(line.points), line.abscissa, along), normal)
        # A stent is no wider at one end than its balloon: the mean radius.
        radius = float(np.interp(along, line.abscissa, line.radius).mean())
        points = places_on(line.points, line.abscissa, along)
        points += radius * (np.cos(around)[:, None] * normal + np.sin(around)[:, None] * side)
        strut_mm = np.hypot(radius * 0.01, np.abs(np.gradient(zigzag)))
        mass = np.tile(strut_mm * _STRUT_MM2 * _STRUT_HU, len(along) // len(turn))
        found.append(Metal(points, mass))
    return found


def add_metal(
    image: Float32[np.ndarray, "nz ny nx"], grid: Grid, metal: Sequence[Metal], generator: np.random.Generator
) -> None:
    """Add leads and stents, and their streaks, to an image in HU, in place: what filtered back-projection makes of the
    errors of line integrals where the beam hardens, and where metal moves from view to view."""
    points = np.concatenate([part.points for part in metal])
    mass = np.concatenate([part.mass for part in metal])
    spacing = np.array([axis[1] - axis[0] for axis in (grid.z, grid.y, grid.x)])
    index = (points[:, ::-1] - [grid.z[0], grid.y[0], grid.x[0]]) / spacing
    _deposit(image, index, mass / spacing.prod())
    sway = generator.normal(size=2)
    sway *= _SWAY_MM / np.linalg.norm(sway)
    angles = float(generator.uniform(0, np.pi)) + np.arange(_VIEWS) * (np.pi / _VIEWS)
    thick = max(round(_BIN_MM / spacing[0]), 1)
    middle = np.array([grid.x[[0, -1]].mean(), grid.y[[0, -1]].mean()])
    layer = np.floor((index[:, 0] + 0.5) / thick).astype(int)
    for number in range(-(-len(grid.z) // thick)):
        inside = layer == number
        if not inside.any():
            continue
        rows = image[number * thick : (number + 1) * thick]
        width_mm = float(np.hypot(np.ptp(grid.x), np.ptp(grid.y)))
        area = mass[inside] / (thick * spacing[0])
        error = _sinogram_error(points[inside, :2] - middle, area, sway, angles, width_mm)
        rows += _back_projected(error, angles, grid, middle)


def _deposit(image: np.ndarray, index: Float[np.ndarray, "n 3"], hu: Float[np.ndarray, "n"]) -> None:
    low = np.floor(index).astype(int)
    share = index - low
    for corner in np.ndindex(2, 2, 2):
        at = low + corner
        weight = np.where(corner, share, 1 - share).prod(axis=1) * hu
        inside = np.all((at >= 0) & (at < image.shape), axis=1)
        np.add.at(image, tuple(at[inside].T), weight[inside].astype(np.float32))


def _sinogram_error(
    place: Float[np.ndarray, "n 2"],
    mass: Float[np.ndarray, "n"],
    sway: Float[np.ndarray, "2"],
    angles: Float[np.ndarray, "views"],
    width_mm: float,
) -> Float[np.ndarray, "views bins"]:
    """Return by how much the measured line integrals of one slice err (no unit); mass in HU mm²."""
    half = int(width_mm / 2 / _BIN_MM) + 4
    error = np.zeros((_VIEWS, 2 * half + 1))
    for view, angle in enumerate(angles):
        ray = np.array([np.cos(angle), np.sin(angle)])
        true = place @ ray
        moved = true + (view / (_VIEWS - 1) - 0.5) * float(sway @ ray)
        integrals = []
        for at in (moved, true):
            bins = at / _BIN_MM + half
            left = np.floor(bins).astype(int)
            kept = (left >= 0) & (left < 2 * half)
            weight = mass[kept] * _WATER / _BIN_MM
            share = (bins - left)[kept]
            integrals.append(
                np.bincount(left[kept], weight * (1 - share), 2 * half + 1)
                + np.bincount(left[kept] + 1, weight * share, 2 * half + 1)
            )
        error[view] = _SATURATION * -np.expm1(-integrals[0] / _SATURATION) - integrals[1]
    return error


def _back_projected(
    error: Float[np.ndarray, "views bins"], angles: Float[np.ndarray, "views"], grid: Grid, middle: np.ndarray
) -> Float32[np.ndarray, "ny nx"]:
    """Return the filtered back-projection of a sinogram (Ram-Lak filter) on the image's pixels, HU."""
    from scipy.signal import fftconvolve  # slow to import

    bins = error.shape[1]
    offset = np.arange(-bins, bins + 1)
    ramp = np.where(offset % 2, -1 / (np.pi * np.where(offset == 0, 1, offset)) ** 2, 0.0)
    ramp[bins] = 0.25
    filtered = fftconvolve(error, ramp[None], mode="full", axes=1)[:, bins : 2 * bins] / _BIN_MM
    y, x = (
        np.linspace(axis[0], axis[-1], max(round(np.ptp(axis) / _BIN_MM), 2)) - m
        for axis, m in ((grid.y, middle[1]), (grid.x, middle[0]))
    )
    found = np.zeros((len(y), len(x)))
    places = np.arange(bins) - bins // 2
    for view, angle in enumerate(angles):
        at = (y[:, None] * np.sin(angle) + x * np.cos(angle)) / _BIN_MM
        found += np.interp(at, places, filtered[view])
    hu = found * (np.pi / _VIEWS) / _WATER
    size = len(grid.y), len(grid.x)
    return np.asarray(zoom(hu, [n / m for n, m in zip(size, hu.shape, strict=True)], order=1), dtype=np.float32)
