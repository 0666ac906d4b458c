"""What touches in lumens made at random, as masks and as surfaces: whether a word is said, and what it costs."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.figures import Bar
from endopilot.anatomy.extract import extract_anatomy
from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume, write_mask
from endopilot.progress import progress
from endopilot.runs import existing
from endopilot.types import LumenMask, Volume
from endopilot.vessels.surface import Surface, surface_from_mask

VOXEL_MM = 0.35
"""Edge that real masks are resampled to, mm: a coronary CTA's."""

SECONDS_BAR, MEMORY_BAR, SILENT_BAR = Bar(10.0), Bar(1.0), Bar(0)
SAID = ("touch", "loop", "flap", "many places")
Tube = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]
"""Axis and radius of a tube, mm."""


def bench_touching(*, masks: tuple[Path, ...] = (), cases: int = 60, seed: int = 0) -> dict[str, Any]:
    """Make lumens that touch themselves or fork, extract them, and say of how many a word is said; time large ones.

    Args:
        masks: coronary masks (every label but 0 is lumen), resampled to 0.35 mm and timed.
        cases: contacts of two vessels, hairpins, loops and forks, a fourth each.
        seed: of the shapes, sizes and voxels.

    Returns:
        `touching`, a row for each kind and source; `cost`, processor time (s) and memory (GB) in a fresh process.
    """
    rng = np.random.default_rng(seed)
    kinds: dict[str, Callable[[np.random.Generator], list[Tube]]] = {
        "contact": _contact, "hairpin": _hairpin, "loop": _loop, "fork": _fork,
    }  # fmt: skip
    told: dict[tuple[str, str], list[bool]] = {}
    with progress("Touching", cases) as advance:
        for number in range(cases):
            kind = list(kinds)[number % len(kinds)]
            mask = _mask(kinds[kind](rng), float(rng.choice([0.3, 0.4, 0.5, 0.7])), rng)
            for source, content in (("mask", LumenMask(mask)), ("surface", surface_from_mask(mask))):
                told.setdefault((kind, source), []).append(_is_told(content))
            advance()
    rows = []
    for (kind, source), said in told.items():
        wrong = sum(said) if kind == "fork" else len(said) - sum(said)
        what = "called a contact or loop" if kind == "fork" else "nothing is said"
        rows.append({"kind": kind, "source": source, "cases": len(said)} | SILENT_BAR.row(what, wrong))
    return {"touching": rows, "cost": _costs([existing(mask) for mask in masks], rng)}


def _is_told(content: LumenMask | Surface) -> bool:
    try:
        notes = extract_anatomy(content, name="made").provenance["notes"][1:]
    except InputError as error:
        notes = [str(error)]
    return any(word in note for note in notes for word in SAID)


def _costs(masks: Sequence[Path], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return what the largest inputs cost: aortas with a coronary artery as surfaces, and masks on fine voxels."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        wall, fine = Path(folder) / "wall.stl", Path(folder) / "fine.nii.gz"
        for radius, length, narrow in ((12.0, 60.0, 0.6), (14.0, 250.0, 0.7), (10.0, 100.0, 0.4)):
            along = np.linspace(0.0, 1.0, 60)[:, None]
            aorta = (np.hstack([0 * along, 0 * along, length * along]), np.full(60, radius))
            bent = np.hstack([radius - 2 + 50 * np.sin(1.5 * along), -25 * along, 25 - 45 * along**2])
            _write_stl(surface_from_mask(_mask([aorta, (bent, np.linspace(1.5, narrow, 60))], 0.5, rng)), wall)
            rows += _cost(wall, f"surface: aorta of {length:g} mm with a coronary artery")
        for mask in masks:
            write_mask(LumenMask(_resampled(read_volume(mask))), fine, manifest={})
            rows += _cost(fine, f"{mask.name} at {VOXEL_MM:g} mm")
    return rows


def _cost(file: Path, name: str) -> list[dict[str, Any]]:
    """Return processor time, s, and peak memory, GB, of `endopilot anatomy`, start-up and writing with it."""
    out = tempfile.mkdtemp(dir=file.parent)
    program = [sys.executable, "-m", "endopilot.cli", "anatomy", str(file), "-o", out]
    child = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise InputError(f"{name}: `endopilot anatomy` left with {os.waitstatus_to_exitcode(status)}")
    return [
        {"case": name} | SECONDS_BAR.row("processor time, s", round(usage.ru_utime + usage.ru_stime, 1)),
        {"case": name} | MEMORY_BAR.row("peak memory, GB", round(usage.ru_maxrss / 1e6, 2)),
    ]


def _resampled(volume: Volume) -> Volume:
    """Return all labels of a mask on voxels of `VOXEL_MM`, between which it is linear."""
    from scipy.ndimage import zoom

    shares = zoom((volume.voxels != 0).astype(np.float32), volume.spacing_mm[::-1] / VOXEL_MM, order=1)
    return Volume(np.asarray(shares > 0.5), np.full(3, VOXEL_MM), volume.origin_mm, volume.direction)


def _write_stl(surface: Surface, file: Path) -> None:
    from vtkmodules.vtkIOGeometry import vtkSTLWriter

    writer = vtkSTLWriter()
    writer.SetFileName(str(file))
    writer.SetInputData(surface.to_polydata())
    writer.SetFileTypeToBinary()
    writer.Write()


def _mask(tubes: list[Tube], voxel_mm: float, rng: np.random.Generator) -> Volume:
    """Return the voxels inside tubes that are turned and shifted at random."""
    turn = Rotation.random(rng=rng).as_matrix()
    tubes = [(points @ turn.T, radius) for points, radius in tubes]
    low = np.min([points.min(axis=0) - radius.max() for points, radius in tubes], axis=0) - 3 * voxel_mm
    high = np.max([points.max(axis=0) + radius.max() for points, radius in tubes], axis=0) + 3 * voxel_mm
    low = low - voxel_mm * rng.uniform(0, 1, 3)
    voxels = np.zeros(np.ceil((high - low) / voxel_mm).astype(int)[::-1] + 1, dtype=bool)
    for points, radius in tubes:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        at = np.arange(0.0, along[-1], 0.3 * voxel_mm)
        for centre, size in zip(
            np.stack([np.interp(at, along, axis) for axis in points.T], axis=1),
            np.interp(at, along, radius),
            strict=True,
        ):
            first = np.floor((centre - size - low) / voxel_mm).astype(int)
            axes = [np.arange(f, f + int(2 * size / voxel_mm) + 3) for f in first]
            x, y, z = (low[i] + voxel_mm * axes[i] - centre[i] for i in range(3))
            ball = z[:, None, None] ** 2 + y[:, None] ** 2 + x**2 < size**2
            voxels[axes[2][0] : axes[2][-1] + 1, axes[1][0] : axes[1][-1] + 1, axes[0][0] : axes[0][-1] + 1] |= ball
    return Volume(voxels, np.full(3, voxel_mm), low, np.eye(3))


def _contact(rng: np.random.Generator) -> list[Tube]:
    """Return two vessels that touch in passing, at any angle, by a tenth of a voxel to two."""
    wide = rng.uniform(1.4, 2.5)
    narrow, angle, along = wide * rng.uniform(0.6, 1.0), rng.uniform(0.0, np.pi / 2), np.linspace(-25.0, 25.0, 80)
    aside = wide + narrow - rng.uniform(0.05, 0.6)
    one = np.stack([-0.004 * along**2, 0 * along, along], axis=1)
    other = np.stack([aside + 0.01 * along**2, along * np.sin(angle), along * np.cos(angle)], axis=1)
    return [(one, np.linspace(1.1, 0.9, 80) * wide), (other, np.linspace(1.1, 0.9, 80) * narrow)]


def _hairpin(rng: np.random.Generator) -> list[Tube]:
    """Return a vessel whose limbs touch half way."""
    radius, limb = rng.uniform(1.4, 2.4), rng.uniform(35.0, 60.0)
    near, far = radius - rng.uniform(0.05, 0.4), radius + rng.uniform(2.5, 4.0)
    at, along, turn = rng.uniform(0.3, 0.7) * limb, np.linspace(0.0, limb, 80), np.linspace(np.pi, 0.0, 40)[1:-1]
    aside = near + (far - near) * np.clip(np.abs(along - at) / min(at, limb - at), 0.0, 1.0) ** 1.5
    bend = np.stack([far * np.cos(turn), 0 * turn, limb + far * np.sin(turn)], axis=1)
    down, up = (np.stack([side * aside, 0 * along, along], axis=1) for side in (-1.0, 1.0))
    points = np.concatenate([down, bend, up[::-1]])
    return [(points, np.linspace(1.15, 0.85, len(points)) * radius)]


def _loop(rng: np.random.Generator) -> list[Tube]:
    """Return a vessel with a bypass."""
    radius, aside = rng.uniform(1.4, 2.4), rng.uniform(9.0, 14.0)
    along = np.linspace(0.0, 60.0, 80)
    way = np.stack(
        [aside * np.sin(np.pi * np.linspace(0, 1, 60)) ** 0.7, np.zeros(60), np.linspace(10, 50, 60)], axis=1
    )
    straight = np.stack([0 * along, 0 * along, along], axis=1)
    return [(straight, np.full(80, radius)), (way, np.full(60, radius * rng.uniform(0.6, 1.0)))]


def _fork(rng: np.random.Generator) -> list[Tube]:
    """Return a vessel that forks in two or three, at any angle up to 140°."""
    radius, along = rng.uniform(1.8, 2.5), np.linspace(0.0, 30.0, 60)
    trunk = np.stack([0 * along, 0 * along, along - 30.0], axis=1)
    tubes, first = [(trunk, np.full(60, radius))], rng.uniform(0.0, 0.35)
    for angle, around in ((first, 0.0), (first + rng.uniform(0.3, 2.0), np.pi), (rng.uniform(0.5, 1.2), 1.6))[
        : rng.integers(2, 4)
    ]:
        way = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
        tubes.append((along[:, None] * way, np.linspace(0.8, 0.6, 60) * radius))
    return tubes
