"""The phantom: the CT angiogram that a scanner would have made of an anatomy.

Surfaces are rendered from signed distances: a voxel takes the share of each tissue that it holds, then the scanner's
point-spread function blurs image and noise alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32
from scipy.spatial import KDTree

from endopilot.atlas.heart_reference import HeartFit
from endopilot.phantom import chest
from endopilot.phantom.metal import add_metal, leads, stents
from endopilot.phantom.painter import COARSE_MM, SLAB, Grid, Painter, smooth_min, window
from endopilot.phantom.scanner import misregister, scan, smear
from endopilot.settings import Ascending, NonNegative, Share, Within, public, settings
from endopilot.types import Anatomy, Centerline, Volume

_REACH_MM = 5.0  # distances to small vessels are computed up to this far, mm
_FAT_MM = 5.5  # fat reaches at least this far from a coronary's axis, mm
_WALL_MM = 0.5  # thickness of a coronary wall, mm


_Side = Annotated[int, Within(16, 2048)]
_Blur = Annotated[float, Within(0, 20)]


@settings
class PhantomConfig:
    """Scanner, contrast and disease of a synthetic CT angiogram. Two numbers: a value is drawn between."""

    in_plane_mm: Annotated[float, Within(0.05, 10)] = 0.4
    """Voxel size in the axial plane, mm."""
    slice_mm: Annotated[float, Within(0.05, 20)] = 0.5
    """Distance between slices, mm."""
    lumen_hu: Annotated[tuple[NonNegative, NonNegative], Ascending] = (300.0, 550.0)
    """CT number of the contrasted arterial lumen, HU."""
    noise_hu: Annotated[tuple[NonNegative, NonNegative], Ascending] = (20.0, 50.0)
    """Standard deviation of the image noise, HU."""
    psf_mm: Annotated[tuple[_Blur, _Blur], Ascending] = (0.5, 0.7)
    """Width of the point-spread function at half its height, mm."""
    calcium: Annotated[float, Within(0, 1000)] = 2.0
    """Mean number of calcified plaques."""
    right_heart: Annotated[tuple[NonNegative, NonNegative], Ascending] = (0.35, 0.8)
    """CT number of the right ventricle's blood as a share of the lumen's: less where saline has diluted it."""
    motion_mm: Annotated[float, Within(0, 10)] = 0.0
    """How far the heart moves while it is scanned, mm: it is smeared along its path, most at the ends."""
    step_mm: Annotated[float, Within(0, 10)] = 0.0
    """How far the heart jumps from one heart beat's slab of slices to the next, mm: step artefacts."""
    slab_mm: Annotated[float, Within(1, 1000)] = 30.0
    """Height of the slabs, mm."""
    grain_mm: Annotated[float, Within(0, 20)] = 0.0
    """Additional width of the noise's grain at equal SD, mm: iterative reconstruction."""
    blooming_mm: Annotated[float, Within(0, 20)] = 0.0
    """Calcium looks this much wider on every side, mm, over the lumen too."""
    stents: Annotated[int, Within(0, 4)] = 0
    """Number of stents in the tree's main vessels."""
    leads: Annotated[int, Within(0, 2)] = 0
    """Number of pacemaker leads in the right heart, with their streaks."""
    veins: Share = 0.0
    """CT number of the cardiac veins as a share of the lumen's; they touch the artery's wall. 0: dim and 2 mm off."""
    appendage_mm: Annotated[float, Within(0, 200)] = 0.0
    """The left atrial appendage is wider by this on every side, mm, and then touches the arteries' walls."""
    graft: bool = False
    """A bypass graft runs from the ascending aorta to the artery: to the LAD of a left tree."""
    margin_mm: Annotated[float, Within(0, 200, above_low=True)] = 16.0
    """Width of surroundings beyond the tree on every side, mm."""
    voxels: tuple[_Side, _Side, _Side] | None = None
    """Voxels along x, y and z about the middle of the box that the margin gives; as many as fill it by default."""


@dataclass(frozen=True, eq=False)
class _Plaque:
    """A plaque: its tissue, the voxels around it, and the signed distance to its surface there, mm, positive inside."""

    tissue: str
    box: tuple[slice, slice, slice]
    depth: Float32[np.ndarray, "nz ny nx"]


@public
def make_phantom(anatomy: Anatomy, *, config: PhantomConfig | None = None, seed: int = 0) -> Volume:
    """Return a synthetic CT angiogram of a coronary anatomy: int16 HU along the LPS axes. A stenosis named in the
    provenance gets a soft plaque; the seed draws contrast, noise, plaques and surroundings."""
    config = config or PhantomConfig()
    generator = np.random.Generator(np.random.Philox(key=np.array([seed, 0x7068616E], dtype=np.uint64)))
    heart = chest.place(anatomy.tree)
    # A stream of its own, so that the rest of the scan is the same with and without what disturbs it.
    disturbance = np.random.Generator(np.random.Philox(key=np.array([seed, 0x68617264], dtype=np.uint64)))
    graft = [chest.bypass_graft(heart, anatomy.tree)] if config.graft else []
    grid = _field_of_view(anatomy, config, graft)
    lumen_hu, noise_hu, psf_mm = (
        generator.uniform(*span) for span in (config.lumen_hu, config.noise_hu, config.psf_mm)
    )
    tissue = _tissue_hu(generator, lumen_hu, config.right_heart)
    coronaries = [branch.centerline for branch in anatomy.tree.branches]
    coronaries += chest.other_coronary(heart, anatomy.tree)
    coronaries += graft
    lumen = _small_vessels(grid, coronaries)
    veins = _small_vessels(grid, chest.cardiac_veins(heart, anatomy.tree, touching=config.veins > 0))
    if config.veins > 0:
        tissue["vein"] = config.veins * lumen_hu
    coarse, organs = _organs(grid, heart, coronaries, generator, config.appendage_mm)
    painter = Painter(grid, coarse, in_plane_mm=config.in_plane_mm, slice_mm=config.slice_mm)
    image = _render(grid, painter, organs, lumen, veins, tissue)
    for plaque in _plaques(grid, anatomy, generator, config.calcium):
        bloom = np.float32(config.blooming_mm if plaque.tissue == "calcium" else 0.0)
        depth = np.minimum(plaque.depth, -lumen[plaque.box]) + bloom
        painter.paint(image[plaque.box], depth, tissue[plaque.tissue])
    metal = leads(heart, config.leads) + stents(chest.main_paths(anatomy.tree), config.stents, disturbance)
    if metal:
        add_metal(image, grid, metal, disturbance)
    spacing = config.slice_mm, config.in_plane_mm, config.in_plane_mm
    pericardium = next(organ.depth for organ in organs if organ.name == "fat")
    if config.motion_mm > 0:
        smear(image, painter, pericardium, spacing, config.motion_mm, generator)
    if config.step_mm > 0:
        misregister(image, painter, pericardium, spacing, config.step_mm, config.slab_mm, disturbance)
    scan(image, spacing, psf_mm, noise_hu, config.grain_mm, generator)
    return Volume(
        voxels=np.clip(np.rint(image), -1024, 3071).astype(np.int16),
        spacing_mm=np.array([config.in_plane_mm, config.in_plane_mm, config.slice_mm]),
        origin_mm=np.array([grid.x[0], grid.y[0], grid.z[0]]),
        direction=np.eye(3),
    )


def _field_of_view(anatomy: Anatomy, config: PhantomConfig, grafts: Sequence[Centerline] = ()) -> Grid:
    """Return a grid around the tree and its grafts; the aorta beside the ostium, and above it by twice the margin."""
    lines = [*(branch.centerline for branch in anatomy.tree.branches), *grafts]
    points = np.concatenate([line.points for line in lines])
    low, high = points.min(axis=0) - config.margin_mm, points.max(axis=0) + config.margin_mm
    high[2] = max(high[2], anatomy.insertion.position[2] + 2 * config.margin_mm)
    across = np.array([44.0, 36.0])
    if chest.is_left(anatomy.tree):
        low[:2] = np.minimum(low[:2], anatomy.insertion.position[:2] - across)
    else:
        high[:2] = np.maximum(high[:2], anatomy.insertion.position[:2] + across)
    steps = (config.in_plane_mm, config.in_plane_mm, config.slice_mm)
    if config.voxels is not None:
        half = 0.5 * np.array(config.voxels) * steps
        low, high = (low + high) / 2 - half, (low + high) / 2 + half - 0.5 * np.array(steps)
    axes = [np.arange(a, b, step) for a, b, step in zip(low, high, steps, strict=True)]
    return Grid(*axes)


def _tissue_hu(generator: np.random.Generator, lumen_hu: float, right_heart: tuple[float, float]) -> dict[str, float]:
    """Draw the CT numbers of one scan, HU (see docs/concepts/phantom.md for their ranges)."""
    right = generator.uniform(*right_heart)
    return {
        "lung": generator.uniform(-830, -780),
        "chest wall": 45.0,
        "lung vessels": lumen_hu * 0.9,
        "liver": generator.uniform(80, 110),
        "stomach": 30.0,
        "cortical bone": 620.0,
        "spongy bone": 230.0,
        "fat": generator.uniform(-95, -80),
        "descending aorta": lumen_hu * 0.97,
        "myocardium": generator.uniform(92, 110),
        "vessel wall": 45.0,
        "right atrium": lumen_hu * right * generator.uniform(0.7, 1.0),
        "vena cava": lumen_hu * generator.uniform(0.4, 1.3),
        "right ventricle": lumen_hu * right,
        "left atrium": lumen_hu * generator.uniform(0.93, 1.0),
        "left ventricle": lumen_hu * generator.uniform(0.93, 1.0),
        "aorta": lumen_hu,
        "lumen": lumen_hu,
        "vein": generator.uniform(120, 200),
        "coronary wall": 35.0,
        "soft plaque": generator.uniform(50, 75),
        "calcium": generator.uniform(700, 1200),
    }


def _small_vessels(grid: Grid, lines: Sequence[Centerline]) -> Float32[np.ndarray, "nz ny nx"]:
    """Return the signed distance to the wall of tubes with rounded ends, mm, positive inside, not below -5."""
    depth = np.full(grid.shape, -_REACH_MM, dtype=np.float32)
    for line in lines:
        chosen = np.unique(np.append(np.arange(0, len(line.points), 2), len(line.points) - 1))
        points, radius = line.points[chosen], line.radius[chosen]
        for a, b, ra, rb in zip(points[:-1], points[1:], radius[:-1], radius[1:], strict=True):
            reach = max(ra, rb) + _REACH_MM
            box, (z, y, x) = window(grid, np.minimum(a, b) - reach, np.maximum(a, b) + reach)
            x, y, z, step = x - a[0], y - a[1], z - a[2], b - a
            share = (x * step[0] + y * step[1] + z * step[2]) * np.float32(1 / (step @ step))
            np.clip(share, 0, 1, out=share)
            square = x * x + y * y + z * z - 2 * share * (x * step[0] + y * step[1] + z * step[2])
            square += share * share * np.float32(step @ step)
            np.sqrt(np.maximum(square, 0, out=square), out=square)
            np.maximum(depth[box], ra + share * np.float32(rb - ra) - square, out=depth[box])
    return depth


def _plaques(grid: Grid, anatomy: Anatomy, generator: np.random.Generator, mean_count: float) -> list[_Plaque]:
    paths = chest.main_paths(anatomy.tree)
    plaques = []
    for stenosis in anatomy.provenance.get("stenoses", ()):
        line = paths[0]
        half = 0.6 * stenosis["length_mm"]
        ends = stenosis["abscissa_mm"] + np.array([-half, half])
        wall = float(np.interp(ends, line.abscissa, line.radius).max()) + 0.4
        near = int(np.searchsorted(line.abscissa, stenosis["abscissa_mm"]))
        plaques.append(_plaque(grid, "soft plaque", line, near, (0.0, 0.0), (half, wall, wall)))
    for number in range(generator.poisson(mean_count)):
        line = paths[number % len(paths)]
        near = int(generator.integers(4, round(0.75 * len(line.points))))
        along, across, around = (float(a) for a in generator.uniform((1.0, 0.4, 0.8), (3.5, 0.9, 1.4)))
        place = float(line.radius[near]) + 0.4 * across, float(generator.uniform(0, 2 * np.pi))
        plaques.append(_plaque(grid, "calcium", line, near, place, (along, across, around)))
    return plaques


def _plaque(
    grid: Grid,
    tissue: str,
    line: Centerline,
    index: int,
    place: tuple[float, float],
    semi_axes: tuple[float, float, float],
) -> _Plaque:
    """Return an ellipsoid beside a point of the line: how far from it (mm), at which angle from its normal (rad), and
    the semi-axes along the line, away from it and around it, mm."""
    tangent = line.points[index + 1] - line.points[index - 1]
    tangent = tangent / np.linalg.norm(tangent)
    outward = np.cos(place[1]) * line.normals[index] + np.sin(place[1]) * np.cross(tangent, line.normals[index])
    frame = np.stack([tangent, outward, np.cross(tangent, outward)])
    centre, reach = line.points[index] + place[0] * outward, max(semi_axes) + 1.0
    box, (z, y, x) = window(grid, centre - reach, centre + reach)
    local = [(x - centre[0]) * e[0] + (y - centre[1]) * e[1] + (z - centre[2]) * e[2] for e in frame]
    # Distance to an ellipsoid, exact to first order at its surface.
    level = np.sqrt(sum((u / a) ** 2 for u, a in zip(local, semi_axes, strict=True)))
    slope = np.sqrt(sum((u / a**2) ** 2 for u, a in zip(local, semi_axes, strict=True)))
    return _Plaque(tissue, box, (level * (1 - level) / np.maximum(slope, 1e-6)).astype(np.float32))


def _organs(
    grid: Grid, heart: HeartFit, coronaries: Sequence[Centerline], generator: np.random.Generator, appendage_mm: float
) -> tuple[Grid, tuple[chest.Organ, ...]]:
    axes = (np.arange(axis[0] - COARSE_MM, axis[-1] + 2 * COARSE_MM, COARSE_MM) for axis in (grid.x, grid.y, grid.z))
    coarse = Grid(*axes)
    z, y, x = np.meshgrid(coarse.z, coarse.y, coarse.x, indexing="ij")
    positions = np.stack([x, y, z], axis=-1).astype(np.float32)
    vessels = KDTree(np.concatenate([line.points[::2] for line in coronaries]))
    distance, _ = vessels.query(positions, distance_upper_bound=2 * _FAT_MM)
    return coarse, chest.organs(heart, positions, _FAT_MM - np.minimum(distance, 2 * _FAT_MM), generator, appendage_mm)


def _render(
    grid: Grid,
    painter: Painter,
    organs: Sequence[chest.Organ],
    lumen: Float32[np.ndarray, "nz ny nx"],
    veins: Float32[np.ndarray, "nz ny nx"],
    tissue: dict[str, float],
) -> Float32[np.ndarray, "nz ny nx"]:
    """Paint the organs from the outside in, then veins, coronary walls and lumens."""
    image = np.full(grid.shape, tissue["lung"], dtype=np.float32)
    for begin in range(0, grid.shape[0], SLAB):
        rows = slice(begin, begin + SLAB)
        slab, vessel = image[rows], lumen[rows]
        for organ in organs:
            if organ.name == "aorta":
                # The aorta's lumen opens the coronary walls at the ostia: they are painted just before it.
                painter.paint(slab, np.minimum(veins[rows], -vessel - np.float32(1.0)), tissue["vein"])
                painter.paint(slab, vessel + np.float32(_WALL_MM), tissue["coronary wall"])
            found = painter.fine(organ.depth, rows)
            if found is None:
                continue
            fine, (box_y, box_x) = found
            if organ.clearance_mm is not None:
                fine = smooth_min(fine, -vessel[:, box_y, box_x] - np.float32(organ.clearance_mm))
            painter.paint(slab[:, box_y, box_x], fine, tissue[organ.name])
        painter.paint(slab, vessel, tissue["lumen"])
    return image
