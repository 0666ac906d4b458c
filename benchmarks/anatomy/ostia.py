"""Ostia of real coronary arteries found in masks that hold no aorta, beside where they are known to be."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.figures import Bar
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.tree import sampled
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.grid import connected_components
from endopilot.imaging.volume import read_volume
from endopilot.progress import progress
from endopilot.runs import existing
from endopilot.types import Anatomy, LumenMask, Volume
from endopilot.vessels.sources import MASK_SUFFIXES

TRUTH_FILE = "ostia.json"

OSTIUM_BAR_MM, FOUND_BAR = 5.0, 23 / 24
COVERAGE_BAR, SECONDS_BAR = Bar(0.99, at_least=True), Bar(15.0)

COVERED_RADII = 1.5
"""A voxel belongs to the tree if it lies within this many inscribed radii and a voxel's diagonal of its centerline:
lumens are not round."""


def bench_ostia(folder: Path, /) -> dict[str, Any]:
    """Find the coronary ostia of real patients' masks without an aorta, and compare with where they are known to be.

    Args:
        folder: masks (NIfTI, NRRD, MHA) named after patients, every label but 0 a coronary lumen, and ostia.json:
            {"PATIENT": {"rca": {"near_aorta_mm": [x, y, z]}, "lca": …}}, LPS mm.

    Returns:
        `arteries`, a row for each: distance of the ostium from where it is known to be (mm), confidence, share of the
        artery's voxels that the tree covers, longest path (mm), seconds, and the `refusal`, if it was refused; and
        `figures`, those of `judged`.

    Raises:
        InputError: the folder holds no truth, or no mask that it names.
    """
    if not (existing(folder) / TRUTH_FILE).is_file():
        raise InputError(f"{folder / TRUTH_FILE}: is missing; it gives each artery's ostium as near_aorta_mm")
    truth = read_json(folder / TRUTH_FILE)
    masks = {patient: _mask_file(folder, patient) for patient in sorted(truth)}
    cases = [(patient, vessel) for patient in masks for vessel in ("rca", "lca") if vessel in truth[patient]]
    rows = []
    with progress("Ostia", len(cases)) as advance:
        for patient, vessel in cases:
            known = np.array(truth[patient][vessel]["near_aorta_mm"], dtype=float)
            rows.append({"patient": patient, "vessel": vessel} | _measured(masks[patient], vessel, known))
            advance()
    return {"arteries": rows, "figures": judged(rows)}


def judged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return figures beside their bars: found, wrong without a word, least covered, slowest."""
    made = [row for row in rows if row["refusal"] is None]
    right = int(sum(row["ostium_error_mm"] <= OSTIUM_BAR_MM for row in made))
    coverage = min((row["coverage"] for row in made), default=0.0)
    slowest = max((row["seconds"] for row in rows), default=0.0)
    enough = int(np.floor(FOUND_BAR * len(rows)))
    return [
        Bar(enough, at_least=True).row(
            f"arteries of {len(rows)} whose ostium lies within {OSTIUM_BAR_MM:g} mm, at least", right
        ),
        Bar(0).row("wrong and not refused", len(made) - right),
        COVERAGE_BAR.row("covered, at least", coverage),
        SECONDS_BAR.row("slowest, s", slowest),
    ]


def _mask_file(folder: Path, patient: str) -> Path:
    files = [folder / f"{patient}{suffix}" for suffix in MASK_SUFFIXES]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        raise InputError(f"{files[0]}: is missing, though {TRUTH_FILE} names the patient")
    return found


def _measured(file: Path, vessel: str, known: np.ndarray) -> dict[str, Any]:
    content = read_volume(file)
    volume = Volume(content.voxels > 0, content.spacing_mm, content.origin_mm, content.direction)
    config, started = AnatomyConfig(vessel=vessel), time.perf_counter()  # pyright: ignore[reportArgumentType]
    row: dict[str, Any] = dict.fromkeys(("ostium_error_mm", "confidence", "coverage", "longest_mm"))
    try:
        anatomy = extract_anatomy(LumenMask(volume), name=file.name, config=config)
    except InputError as error:
        return row | {"seconds": round(time.perf_counter() - started, 1), "refusal": str(error)}
    return {
        "ostium_error_mm": round(float(np.linalg.norm(anatomy.insertion.position - known)), 1),
        "confidence": anatomy.provenance.get("ostium_confidence"),
        "coverage": round(_coverage(anatomy, volume), 4),
        "longest_mm": round(float(anatomy.tree.longest_path().abscissa[-1]), 1),
        "seconds": round(time.perf_counter() - started, 1),
        "refusal": None,
    }


def _coverage(anatomy: Anatomy, mask: Volume) -> float:
    """Return the share of the voxels of an artery's piece of the mask that its tree covers."""
    labels = connected_components(mask.voxels, corners=True)
    points, radius = sampled(anatomy.tree)
    index = np.argwhere(labels > 0)
    place = mask.index_to_world(index[:, ::-1].astype(float))
    number = labels[tuple(index.T)]
    own = number == number[KDTree(place).query(points[len(points) // 2])[1]]
    gap, nearest = map(np.asarray, KDTree(points).query(place[own]))
    return float(np.mean(gap <= COVERED_RADII * radius[nearest] + np.linalg.norm(mask.spacing_mm)))
