"""`python -m benchmarks imaging`: its cases, its figures, and that it goes on where it stopped."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from benchmarks.imaging import segmentation as imaging_bench
from benchmarks.imaging.cases import DIFFICULTIES, draw_case
from benchmarks.imaging.segmentation import BARS, ImagingBenchConfig, bench_imaging
from endopilot.atlas.atlas import make_patient
from endopilot.imaging.grid import mask_like
from endopilot.runs import claim
from endopilot.types import LumenMask, Volume

GOOD = {
    "dice": 0.93,
    "cldice": 0.97,
    "overlap": 0.99,
    "inside_accuracy_mm": 0.1,
    "radius_mae_mm": 0.05,
    "ostium_error_mm": 0.4,
    "false_length_mm": 0.0,
}
DISTURBANCES = {
    "slices": ["slice_mm"],
    "motion": ["motion_mm"],
    "steps": ["step_mm", "slab_mm"],
    "grain": ["grain_mm"],
    "blooming": ["blooming_mm"],
    "stents": ["stents"],
    "leads": ["leads"],
    "veins": ["veins"],
    "appendage": ["appendage_mm"],
    "graft": ["graft"],
}


def write(base, rows) -> None:
    folder = base / "clean"
    claim(folder, "python -m benchmarks imaging", **imaging_bench._identity(7))
    for index, row in enumerate(rows):
        whole = {"case": index, "failed": None, "warnings": [], "seconds": 2, "processor_seconds": 3}
        (folder / f"{index:04d}.json").write_text(json.dumps(whole | row))


def figures(folder, rows):
    write(folder, rows)
    return bench_imaging(ImagingBenchConfig(cases=len(rows), seed=7, folder=folder))


def test_means_spreads_and_bars(tmp_path):
    found = figures(tmp_path, [GOOD, GOOD | {"dice": 0.83, "ostium_error_mm": 1.2}])
    assert found["dice"] == {
        "mean": 0.88, "sd": 0.0707, "worst": 0.83, "mean_found": 0.88, "worst_found": 0.83,
        "bar": 0.85, "counts": "mean", "passed": True
    }  # fmt: skip
    assert found["ostium_error_mm"]["worst"] == 1.2 and not found["ostium_error_mm"]["passed"]
    assert all(found[name]["passed"] for name in BARS if name != "ostium_error_mm")
    assert found["seconds"] == {"mean": 2.0, "worst": 2.0}


def test_a_failed_case_counts_against_every_figure(tmp_path):
    found = figures(tmp_path, [GOOD] * 9 + [{"failed": "no aorta"}])
    assert found["failed"] == {"9": "no aorta"}
    assert found["dice"]["worst"] == 0.0 and found["dice"]["worst_found"] == 0.93
    assert found["dice"]["mean_found"] == pytest.approx(0.93)
    assert found["dice"]["mean"] == pytest.approx(0.837)
    assert not any(found[name]["passed"] for name in BARS if name.endswith("_mm"))


def test_a_difficulty_changes_the_scan_and_nothing_else():
    patients, clean = draw_case(3, 5)
    for difficulty in DIFFICULTIES[1:]:
        others, scan = draw_case(3, 5, difficulty)
        assert others == patients and scan != clean
        changed = {name for name, value in asdict(scan).items() if value != asdict(clean)[name]}
        assert changed <= {"calcium", *DISTURBANCES[difficulty]}, difficulty
    assert set(DISTURBANCES) == set(DIFFICULTIES[1:])


def test_wrong_results_are_counted_and_those_that_are_reported(tmp_path):
    few, far, unsure = {"overlap": 0.79}, {"ostium_error_mm": 5.1}, {"warnings": ["a vessel ends"]}
    rows = [GOOD, GOOD | few, GOOD | far, GOOD | far | unsure, GOOD | unsure, {"failed": "no aorta"}]
    found = figures(tmp_path, rows)
    assert [found[name] for name in ("wrong", "reported", "silent", "false_alarms")] == [4, 2, 2, 1]


def test_one_case_from_the_volume_to_its_scores(tmp_path, monkeypatch):
    patients, scan = draw_case(1000, 0)
    coarse = replace(scan, in_plane_mm=0.9, slice_mm=0.9)
    truth = make_patient(patients, 0)

    def whole_lumen(volume, config):
        inside = mask_like(LumenMask(as_volume(truth.distance_map)), volume)
        return LumenMask(replace(volume, voxels=inside), truth.insertion, warnings=("a vessel ends",))

    monkeypatch.setattr(imaging_bench, "draw_case", lambda seed, index, difficulty: (patients, coarse))
    monkeypatch.setattr(imaging_bench, "segment", whole_lumen)
    monkeypatch.setattr(imaging_bench, "extract_anatomy", lambda mask, name, config: truth)
    found = bench_imaging(ImagingBenchConfig(cases=1, seed=1000, folder=tmp_path))
    assert found["failed"] == {}
    assert found["dice"]["mean"] > 0.9 and found["overlap"]["mean"] == 1.0
    row = json.loads((tmp_path / "clean" / "0000.json").read_text())
    assert row["warnings"] == ["a vessel ends"] and found["false_alarms"] == 1
    assert row["scan"]["in_plane_mm"] == 0.9 and row["manifest"]["seed"] == 1000


def as_volume(distance_map):
    inside = distance_map.values > 0
    return Volume(inside, np.full(3, distance_map.spacing_mm), distance_map.origin_mm, np.eye(3))
