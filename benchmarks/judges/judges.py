"""`python -m benchmarks judges`: what other programs make of the same input, beside what endopilot makes of it."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from benchmarks.anatomy import analytic_lumens as analytic
from benchmarks.anatomy.extraction import moved_shapes
from benchmarks.judges.environment import CannotInstall, environment
from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.surface import Surface, surface_from_mask
from endopilot.anatomy.tree import sampled
from endopilot.progress import progress
from endopilot.types import VesselTree

VOXEL_MM = (0.35, 0.35, 0.5)
"""Voxels of the masks, mm: a coronary CTA's."""

Lines = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]
"""Points and radii of centerlines, mm."""


def bench_judges(*, environments: Path = Path("runs/judges")) -> dict[str, Any]:
    """Give the same lumens to other programs, and print their errors beside ours.

    VMTK (Antiga et al. 2008) makes centerlines of the same walls, with the ends given; endopilot finds the ends itself.

    Args:
        environments: folder that keeps an environment for each program, of up to a gigabyte.

    Returns:
        Rows for each judge; `skipped` says of those that cannot be installed why.
    """
    judges: dict[str, Callable[[Path], list[dict[str, Any]]]] = {"vmtk": beside_vmtk}
    figures: dict[str, Any] = {}
    for name, judge in judges.items():
        try:
            figures[name] = judge(environments.resolve())
        except CannotInstall as reason:
            figures.setdefault("skipped", []).append({"judge": name, "why": str(reason)})
    return figures


def beside_vmtk(environments: Path) -> list[dict[str, Any]]:
    """Return errors of both centerlines of tubes whose axis and radius are known, and what they took.

    Errors are means over the points, in mm, without the last radius before an end, where VMTK's lines leave the axis.
    """
    python = environment("vmtk", ("vmtk",), environments, newest=True)
    rows, shapes = [], moved_shapes()
    with progress("VMTK", len(shapes)) as advance:
        for name, tree in shapes.items():
            mask = analytic.mask_of(analytic.cut_flat(tree), analytic.half_extent(tree, 3.0), VOXEL_MM)
            started = time.process_time()
            found = extract_anatomy(mask, name="judged").tree
            ours, theirs = time.process_time() - started, _vmtk(python, surface_from_mask(mask.volume), tree)
            for program, lines, seconds in (("endopilot", sampled(found), ours), ("VMTK", *theirs)):
                rows.append({"lumen": name, "program": program} | errors(tree, lines) | {"seconds": round(seconds, 2)})
            advance()
    return rows


def _vmtk(python: Path, wall: Surface, tree: VesselTree) -> tuple[Lines, float]:
    """Return VMTK's centerlines of a wall, and its processor time, s."""
    from vtkmodules.vtkIOGeometry import vtkSTLWriter

    ends = [
        tree.branches[0].centerline.points[0],
        *(tree.branches[leaf].centerline.points[-1] for leaf in tree.leaves()),
    ]
    with tempfile.TemporaryDirectory() as folder:
        stl, asked, answer = (Path(folder) / name for name in ("wall.stl", "ends.json", "lines.json"))
        writer = vtkSTLWriter()
        writer.SetFileName(str(stl))
        writer.SetInputData(wall.to_polydata())
        writer.SetFileTypeToBinary()
        writer.Write()
        asked.write_text(json.dumps({"source": ends[0].tolist(), "targets": [end.tolist() for end in ends[1:]]}))
        program = [str(python), str(Path(__file__).with_name("vmtk_lines.py")), str(stl), str(asked), str(answer)]
        subprocess.run(program, check=True, capture_output=True)
        made = json.loads(answer.read_text(encoding="utf-8"))
    points = np.concatenate([line["points"] for line in made["lines"]])
    return (points, np.concatenate([line["radius"] for line in made["lines"]])), made["seconds"]


def errors(tree: VesselTree, lines: Lines) -> dict[str, float]:
    """Return how far centerlines lie off the true axes, and radii off the true ones, mm."""
    points, radius = lines
    ends = [
        tree.branches[0].centerline.points[0],
        *(tree.branches[leaf].centerline.points[-1] for leaf in tree.leaves()),
    ]
    widest = max(float(branch.centerline.radius.max()) for branch in tree.branches)
    inner = np.asarray(KDTree(ends).query(points)[0]) > widest
    points, radius = points[inner], radius[inner]
    gap = np.min([analytic.distance_to_line(branch.centerline.points, points) for branch in tree.branches], axis=0)
    axis, _ = sampled(tree)
    true = analytic.tree_distance(tree, axis)[np.asarray(KDTree(axis).query(points)[1])]
    return {
        "axis error, mm": round(float(gap.mean()), 4),
        "axis error at most, mm": round(float(gap.max()), 4),
        "radius error, mm": round(float(np.abs(radius - true).mean()), 4),
    }
