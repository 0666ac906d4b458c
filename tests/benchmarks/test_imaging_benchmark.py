"""The benchmarks of segmentation and of X-ray detection: their cases, and how their figures are counted."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from benchmarks.imaging import segmentation as imaging_bench
from benchmarks.imaging.cases import DIFFICULTIES, draw_case
from benchmarks.imaging.scenes import SceneConfig, draw_scenes
from benchmarks.imaging.segmentation import BARS, ImagingBenchConfig, bench_imaging
from benchmarks.imaging.wires import Search, figures_of
from benchmarks.imaging.xray import BARS as XRAY_BARS
from benchmarks.imaging.xray import Exposure, _figures
from endopilot.atlas.atlas import make_patient
from endopilot.errors import InputError
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


def exposure(**changes) -> Exposure:
    usual = {"views": 2, "dose": 1.0, "contrast": 0.0, "angle": "RAO 30", "wire": True, "found": True}
    errors = {"along_px": 1.0, "across_px": 0.2, "along_mm": 0.3, "space_mm": 0.4, "deviations": 1.0}
    return Exposure(**(usual | errors | changes))


def test_a_tip_found_elsewhere_is_missed_and_one_found_without_a_wire_is_a_false_alarm():
    rows = [
        exposure(),
        exposure(along_px=3.0),
        exposure(along_px=8.0, across_px=7.0, deviations=9.0),
        exposure(found=False, along_px=np.nan),
        exposure(dose=4.0, along_px=99.0),
        exposure(views=1, along_px=5.0),
        exposure(wire=False),
        exposure(wire=False, found=False),
    ]
    motions = [{"mean": 1.0, "measured": None}, {"mean": 0.5, "measured": 0.1}]
    registrations = [
        {"two_views_mm": value, "one_view_mm": [1.0, 3.0], "motion_mm": motion}
        for value, motion in zip((0.2, 0.9), motions, strict=True)
    ]
    figures = _figures(rows, registrations, [20.0, 30.0, 10.0])
    assert figures["missed_share"] == 0.5 and figures["images"] == 4
    assert figures["tip_along_median_px"] == 3.0
    assert figures["inside_own_95_share"] == pytest.approx(2 / 3)
    assert figures["one_view"]["tip_along_median_px"] == 5.0
    assert figures["by"]["dose 4, contrast 0"]["missed_share"] == 1.0
    assert figures["false_alarms_share"] == 0.5
    assert figures["registration_error_mm"] == pytest.approx(0.55)
    assert figures["motion_error_mm"] == 0.1 and figures["motions_not_measured"] == 1
    assert figures["motion_error_of_published_mean_mm"] == 0.75
    assert figures["passed"] == {
        name: name
        not in ("tip_along_median_px", "missed_share", "registration_error_mm", "registration_error_one_view_mm")
        for name in XRAY_BARS
    }
    assert figures["images_per_second"] == 20.0


def test_anatomies_of_ones_own_lie_on_the_table(fork, vessel, tmp_path):
    (scene,) = draw_scenes(SceneConfig(given=(vessel,)))
    assert scene.anatomy.identity == fork.identity
    with pytest.raises(InputError, match="no such folder"):
        next(draw_scenes(SceneConfig(given=(tmp_path / "absent",))))


def test_what_is_wrong_counts_as_said_unless_it_is_called_found():
    def search(status: str, **changes) -> Search:
        return Search(**vars(exposure(found=status != "not found", **changes)), said=status, patient="rca")

    far = {"along_px": 50.0, "deviations": 9.0}
    rows = [
        search("found"),
        search("found", **far),
        search("ambiguous"),
        search("ambiguous", **far),
        search("not found", views=1),
        search("found", views=1, along_px=2.0, deviations=5.0),
        search("ambiguous", wire=False),
        search("not found", wire=False),
    ]
    figures = figures_of(rows)
    assert figures["missed_share"] == 0.5 and figures["missed_share_one_view"] == 0.5
    assert figures["wrong"] == 4 and figures["said_share"] == 0.75
    assert figures["doubted_share"] == pytest.approx(1 / 3)
    assert figures["surely_wrong_share"] == pytest.approx(1 / 6)
    assert figures["inside_own_95_share"] == pytest.approx(1 / 3)
    assert figures["false_alarms_share"] == 0.5
    assert figures["by"]["rca"]["wires"] == 4
