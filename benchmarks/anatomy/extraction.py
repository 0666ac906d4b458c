"""Errors of extraction on lumens whose truth is known: analytic tubes, and lumens rebuilt from real centerlines."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks.anatomy import analytic_lumens as analytic
from benchmarks.anatomy.compare import compare_with_atlas
from benchmarks.figures import Bar
from endopilot.anatomy.distance import distance_map_from_spheres, sample
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.projection import project_tip
from endopilot.anatomy.tree import sampled
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.errors import InputError
from endopilot.evaluation.anatomy_score import compare_trees
from endopilot.progress import progress
from endopilot.runs import existing
from endopilot.types import Anatomy, LumenMask, VesselTree, Volume
from endopilot.vessels.sources import read_source
from endopilot.vessels.surface import BAND_MM, distance_map_from_surface, surface_from_mask

VOXELS_MM = ((0.35, 0.35, 0.35), (0.5, 0.5, 0.5), (0.35, 0.35, 0.5), (0.4, 0.4, 0.8))
"""Voxel edges of the masks, mm. Errors are given in units of the shortest edge."""

POSE = (Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.13, -0.21, 0.17]))
"""Rotation and shift (mm) of the shapes, so that they are not aligned with the voxels."""

FORK_DEG = (30.0, 60.0, 90.0)
NEAR_WALL_MM = 2.0
COMPARED_POINTS = 100_000
PROJECTED = 1_000_000

VOXEL_BAR, STORED_MB_BAR, SPEED_BAR = Bar(0.1), Bar(20.0), Bar(1e6, at_least=True)
OVERLAP_BAR, INSIDE_ACCURACY_BAR_MM, RADIUS_BAR_MM = Bar(0.98, at_least=True), Bar(0.15), Bar(0.1)
Judged = dict[str, tuple[float, Bar | None]]
"""Figures, each with its bar if it has one."""

REBUILT_VOXEL_MM = (0.35, 0.35, 0.5)
"""Voxels of the lumens that are rebuilt from real centerlines: a coronary CTA's, mm."""


def bench_anatomy(
    *, centerlines: Path | None = None, compare: tuple[Path, ...] = (), atlas: AtlasConfig = AtlasConfig(count=40)
) -> list[dict[str, Any]]:
    """Extract lumens whose centerlines are known, and print each error beside its bar; or compare with the atlas.

    With --compare it measures bends, forks, calibre and ostium of given anatomies beside the atlas instead: median and
    5th to 95th percentile, and the distance of the two distributions in standard deviations (Wasserstein-1).

    Args:
        centerlines: folder with VMTK's rca_cl.vtp and lca_cl.vtp of a real patient, whose lumen is rebuilt from the
            radii and extracted again; left out if not given.
        compare: anatomies, or folders of anatomies, to compare with the atlas.
        atlas: the patients to compare with; their kind is that of the given anatomies.

    Returns:
        What `compare_with_atlas` does, or the rows of `extraction_errors`.

    Raises:
        InputError: a folder holds no centerlines or no anatomy.
    """
    if compare:
        return compare_with_atlas([existing(folder) for folder in compare], atlas)
    return extraction_errors(None if centerlines is None else existing(centerlines))


def extraction_errors(centerlines: Path | None = None) -> list[dict[str, Any]]:
    """Measure centerlines, distance maps and projection where the truth is known.

    Args:
        centerlines: see `bench_anatomy`.

    Returns:
        Rows of case, figure, value, bar and passed; figures without a bar are for comparison. Axis and radius
        errors are means over the centerline's points against the tubes' true axes and radii, in the shortest voxel
        edge; the distance map's is the root mean square within 2 mm of the wall, ends left out, in the same unit.

    Raises:
        InputError: the folder holds no centerlines.
    """
    files = _centerline_files(centerlines)
    rows: list[dict[str, Any]] = []
    shapes = moved_shapes()
    with progress("Anatomy", 2 * len(shapes) * len(VOXELS_MM) + 1 + len(files)) as advance:
        for name, tree in shapes.items():
            for voxel in VOXELS_MM:
                case = f"{name}, voxel {' × '.join(f'{edge:g}' for edge in voxel)} mm"
                mask = analytic.mask_of(analytic.cut_flat(tree), analytic.half_extent(tree, 3.0), voxel)
                rows += _rows(case, _axis_and_radius(tree, mask))
                advance()
                rows += _rows(case, _wall(tree, mask))
                advance()
        for file in files:
            name = file.name.removesuffix("_cl.vtp")
            truth = extract_anatomy(read_source(file), name=name, config=AnatomyConfig(vessel=name))  # pyright: ignore[reportArgumentType]
            rows += _rows(f"real {name.upper()}", _found_again(truth, name))
            advance()
        rows += _rows("synthetic RCA", _projection_speed())
        advance()
    return rows


def _centerline_files(folder: Path | None) -> list[Path]:
    if folder is None:
        return []
    files = [folder / f"{name}_cl.vtp" for name in ("rca", "lca")]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{folder}: holds no {' and no '.join(missing)}; give a folder of VMTK centerlines")
    return files


def moved_shapes() -> dict[str, VesselTree]:
    """Return tubes and forks whose axes are known, turned and shifted against the voxels."""
    shapes = {"straight": analytic.straight_tree(), "torus": analytic.torus_tree(), "helix": analytic.helix_tree()}
    for angle in FORK_DEG:
        middle = np.array([0.0, 0.0, -20.0])
        shapes[f"fork of {angle:g}°"] = analytic.moved(analytic.forked_tree(angle), np.eye(3), middle)
    return {name: analytic.moved(tree, *POSE) for name, tree in shapes.items()}


def _rows(case: str, figures: Judged) -> Iterator[dict[str, Any]]:
    for figure, (value, bar) in figures.items():
        shown = float(f"{value:.4g}")
        plain = {"figure": figure, "value": shown, "bar": None, "passed": None}
        yield {"case": case} | (plain if bar is None else bar.row(figure, value) | {"value": shown})


def _axis_and_radius(tree: VesselTree, mask: LumenMask) -> Judged:
    """Return the errors of the extracted centerline."""
    found = extract_anatomy(mask, name="bench")
    voxel = float(mask.volume.spacing_mm.min())
    points, radius = sampled(found.tree)
    gap = np.min([analytic.distance_to_line(b.centerline.points, points) for b in tree.branches], axis=0)
    axis, _ = sampled(tree)
    true_radius = analytic.tree_distance(tree, axis)[np.asarray(KDTree(axis).query(points)[1])]
    overlap = compare_trees(found.tree, tree, smallest_radius_mm=0.0).overlap
    return {
        "axis error, voxels": (float(gap.mean()) / voxel, VOXEL_BAR),
        "radius error, voxels": (float(np.abs(radius - true_radius).mean()) / voxel, VOXEL_BAR),
        "overlap": (overlap, OVERLAP_BAR),
        "axis error max, mm": (float(gap.max()), None),
    }


def _wall(tree: VesselTree, mask: LumenMask) -> Judged:
    """Return the distance map's error near the wall, and that of a binary distance transform of the same mask."""
    voxel = float(mask.volume.spacing_mm.min())
    ours = distance_map_from_surface(surface_from_mask(mask.volume), spacing_mm=voxel)
    k, j, i = np.nonzero(np.abs(ours.values) < BAND_MM - 0.1)
    points = ours.origin_mm + ours.spacing_mm * np.stack([i, j, k], axis=1)
    error = _error_near_wall(tree, points, ours.values[k, j, i])
    volume, edges = mask.volume, mask.volume.spacing_mm[::-1]
    inside, outside = (
        np.asarray(distance_transform_edt(part, sampling=edges)) for part in (volume.voxels, ~volume.voxels)
    )
    index = np.argwhere((inside > 0) | (outside < BAND_MM))
    centres = volume.index_to_world(index[:, ::-1].astype(float))
    binary = _error_near_wall(tree, centres, (inside - outside)[tuple(index.T)])
    return {
        "distance to the wall, RMS, voxels": (error / voxel, VOXEL_BAR),
        "the same of a binary distance transform": (binary / voxel, None),
    }


def _error_near_wall(tree: VesselTree, points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]) -> float:
    ends = [tree.branches[0].centerline.points[0], *(tree.branches[i].centerline.points[-1] for i in tree.leaves())]
    reach = NEAR_WALL_MM + max(float(branch.centerline.radius.max()) for branch in tree.branches)
    chosen = np.random.default_rng(0).permutation(len(points))[:COMPARED_POINTS]
    points, values = points[chosen], values[chosen]
    away = np.min([np.linalg.norm(points - end, axis=1) for end in ends], axis=0) > reach
    exact = analytic.tree_distance(tree, points[away])
    near = np.abs(exact) < NEAR_WALL_MM
    return float(np.sqrt(np.mean((values[away] - exact)[near] ** 2)))


def _found_again(truth: Anatomy, name: str) -> Judged:
    lumen = distance_map_from_spheres(truth.tree, spacing_mm=0.25)
    size = np.array(REBUILT_VOXEL_MM)
    extent = lumen.spacing_mm * (np.array(lumen.values.shape[::-1]) - 1)
    count = np.floor(extent / size).astype(int) + 1
    volume = Volume(np.zeros(count[::-1], dtype=bool), size, lumen.origin_mm, np.eye(3))
    index = np.indices(volume.voxels.shape)[::-1].reshape(3, -1).T
    inside = sample(lumen, volume.index_to_world(index.astype(float))).reshape(volume.voxels.shape) > 0
    mask = LumenMask(Volume(inside, size, lumen.origin_mm, np.eye(3)), truth.insertion)
    found = extract_anatomy(mask, name=name, config=AnatomyConfig(vessel=name))  # pyright: ignore[reportArgumentType]
    agreement = compare_trees(found.tree, truth.tree, smallest_radius_mm=0.0)
    with tempfile.TemporaryDirectory() as folder:
        write_anatomy(found, output=Path(folder) / name)
        stored = (Path(folder) / name / "lumen.nrrd").stat().st_size / 1e6
    return {
        "overlap OV": (agreement.overlap, OVERLAP_BAR),
        "inside accuracy AI, mm": (agreement.inside_accuracy_mm, INSIDE_ACCURACY_BAR_MM),
        "radius error, mm": (agreement.radius_mae_mm, RADIUS_BAR_MM),
        "stored distance map, MB": (stored, STORED_MB_BAR),
    }


def _projection_speed() -> Judged:
    """Return how many points a second are projected, the best of five, and the size of an atlas patient's map."""
    patient = make_patient(AtlasConfig(seed=0, population="textbook"), 0)
    centre, size = sampled(patient.tree)
    random = np.random.default_rng(0)
    chosen = random.integers(0, len(centre), PROJECTED)
    points = centre[chosen] + 0.4 * size[chosen, None] * random.normal(size=(PROJECTED, 3))
    spent = []
    for _ in range(5):
        started = time.process_time()
        project_tip(patient.tree, patient.insertion, points)
        spent.append(time.process_time() - started)
    with tempfile.TemporaryDirectory() as folder:
        write_anatomy(patient, output=Path(folder) / "patient")
        stored = (Path(folder) / "patient" / "lumen.nrrd").stat().st_size / 1e6
    return {
        "points projected a second of processor time": (PROJECTED / min(spent), SPEED_BAR),
        "stored distance map, MB": (stored, STORED_MB_BAR),
    }
