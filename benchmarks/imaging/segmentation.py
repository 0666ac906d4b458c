"""Errors of the automatic coronary method on synthetic CT angiograms, whose truth is known: `bench_imaging`."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import endopilot.anatomy
import endopilot.atlas
import endopilot.evaluation
import endopilot.imaging
import endopilot.phantom
from benchmarks.figures import Bar
from benchmarks.imaging.cases import Difficulty, draw_case
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.atlas.atlas import make_patient
from endopilot.errors import InputError
from endopilot.evaluation.anatomy_score import score_anatomy
from endopilot.files import manifest, read_json, write_json
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.phantom.phantom import make_phantom
from endopilot.runs import claim, make_missing
from endopilot.settings import Within, settings

LEAST_OVERLAP, LARGEST_OSTIUM_ERROR_MM = 0.8, 5.0
"""A result is wrong where its centerline overlap is smaller, or its ostium error larger."""


BARS = {
    "dice": Bar(0.85, at_least=True),
    "cldice": Bar(0.90, at_least=True),
    "overlap": Bar(0.95, at_least=True),
    "inside_accuracy_mm": Bar(0.25),
    "radius_mae_mm": Bar(0.15),
    "ostium_error_mm": Bar(1.0),
    "false_length_mm": Bar(5.0),
}
"""Bars of the figures; `AnatomyScore` says what each is."""
OF_THE_WORST = ("ostium_error_mm", "false_length_mm")
"""An ostium error above 1 mm or a false tree longer than 5 mm may not happen in any case; the other bars hold for the
mean."""


@settings
class ImagingBenchConfig:
    """Number, seed and difficulty of the cases, and the folder of their results."""

    cases: Annotated[int, Within(1, 10000)] = 50
    """Number of synthetic CT angiograms."""
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0
    """Seed of patients, scanners and noise: case i is the same however many there are."""
    difficulty: Difficulty = "clean"
    """What the scans have in common; `draw_case` says how much of it. Patients, scanners and noise stay the same."""
    folder: Path = Path("runs/bench-imaging")
    """Folder of the results, with a folder for each difficulty; an interrupted run goes on where it stopped."""


def bench_imaging(config: ImagingBenchConfig = ImagingBenchConfig()) -> dict[str, Any]:
    """Segment synthetic CT angiograms from the volume alone and compare with the truth.

    Centerlines and radii are those that `extract_anatomy` finds in the mask; its tree begins at the mask's ostium.

    Returns:
        For each of `BARS` its `mean`, `sd`, `worst` of all cases, `mean_found` and `worst_found` of those with a
        result, `bar`, `counts` (mean or worst) and whether it `passed`; `seconds`
        and `processor_seconds` of the segmentation a case; `cases`, and `failed`: cases without any result, each with
        the reason. A failed case counts 0 in the shares, and no bar in mm is met then. `wrong` counts results that
        are wrong or absent, `reported` those of them that were refused or come with warnings, `silent` the others;
        `false_alarms` counts right results with warnings.

    Raises:
        InputError: the folder belongs to another run, such as one of another seed or by other source code.
    """
    folder = config.folder / config.difficulty
    claim(folder, "python -m benchmarks imaging", **_identity(config.seed))
    paths = [folder / f"{index:04d}.json" for index in range(config.cases)]
    make_missing("Synthetic CT angiograms", paths, partial(_measure, seed=config.seed, difficulty=config.difficulty))
    rows = [read_json(path) for path in paths]
    failed = {str(row["case"]): row["failed"] for row in rows if row["failed"]}
    figures: dict[str, Any] = {name: _figure(name, rows) for name in BARS}
    for name in ("seconds", "processor_seconds"):
        values = np.array([row[name] for row in rows])
        figures[name] = {"mean": round(float(values.mean()), 2), "worst": round(float(values.max()), 2)}
    wrong = [row for row in rows if is_wrong(row)]
    reported = sum(1 for row in wrong if row["failed"] or row["warnings"])
    alarms = sum(1 for row in rows if not is_wrong(row) and row["warnings"])
    counts = {"wrong": len(wrong), "reported": reported, "silent": len(wrong) - reported, "false_alarms": alarms}
    return figures | {"cases": len(rows)} | counts | {"failed": failed}


def is_wrong(row: dict[str, Any]) -> bool:
    """Return whether a case has no result or a wrong one."""
    return bool(row["failed"] or row["overlap"] < LEAST_OVERLAP or row["ostium_error_mm"] > LARGEST_OSTIUM_ERROR_MM)


def _measure(path: Path, *, seed: int, difficulty: Difficulty) -> None:
    """Make, segment and score one case, and write its row."""
    index = int(path.stem)
    patients, scan = draw_case(seed, index, difficulty)
    truth = make_patient(patients, index)
    volume = make_phantom(truth, config=scan, seed=seed * 1_000_003 + index)
    vessel = "lca" if patients.vessel == "lca" else "rca"
    row: dict[str, Any] = {"case": index, "failed": None, "warnings": []}
    wall, processor = time.perf_counter(), time.process_time()
    mask = None
    try:
        mask = segment(volume, config=SegmentConfig(method="coronary", vessel=vessel))
    except InputError as error:
        row["failed"] = str(error)
    row |= {"seconds": time.perf_counter() - wall, "processor_seconds": time.process_time() - processor}
    if mask is not None:
        row["warnings"] = list(mask.warnings)
        try:
            extracted = extract_anatomy(mask, name=truth.name, config=AnatomyConfig(vessel=vessel))
            row |= asdict(score_anatomy(mask, extracted, truth))
        except InputError as error:
            row["failed"] = str(error)
    drawn = {name: truth.provenance.get(name) for name in ("vessel", "dominance", "stenoses")}
    write_json(path, row | {"patient": drawn, "scan": scan, "manifest": manifest(config=patients, seed=seed)})


def _figure(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    bar = BARS[name]
    lost = 0.0 if bar.at_least else float("inf")
    values = np.array([lost if row["failed"] else row[name] for row in rows], dtype=float)
    counted = values[np.isfinite(values)]
    found = np.array([row[name] for row in rows if not row["failed"]], dtype=float)
    worst = float(values.min() if bar.at_least else values.max())
    mean = float(counted.mean()) if len(counted) else float("nan")
    decisive = worst if name in OF_THE_WORST or len(counted) < len(values) else mean
    return {
        "mean": _rounded(mean),
        "sd": _rounded(float(counted.std(ddof=1)) if len(counted) > 1 else 0.0),
        "worst": _rounded(worst),
        "mean_found": _rounded(float(found.mean()) if len(found) else np.nan),
        "worst_found": _rounded(float((found.min() if bar.at_least else found.max()) if len(found) else np.nan)),
        "bar": bar.limit,
        "counts": "worst" if name in OF_THE_WORST else "mean",
        "passed": bar.met(decisive),
    }


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def _identity(seed: int) -> dict[str, Any]:
    """Return what the results follow from: the seed, and the source of every package that the cases need."""
    sources = {}
    for package in (endopilot.imaging, endopilot.anatomy, endopilot.atlas, endopilot.phantom, endopilot.evaluation):
        folder, digest = Path(next(iter(package.__path__))), hashlib.sha256()
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
        sources[package.__name__] = digest.hexdigest()
    return {"seed": seed, "sources": sources}
