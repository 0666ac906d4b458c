"""`endopilot run`, killed and begun again, and `endopilot demo` end with a report."""

from __future__ import annotations

import html
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pydicom
import pytest

import command
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device_files import device_yaml
from endopilot.files import input_hash, read_json
from endopilot.imaging.volume import write_volume
from endopilot.models.config import TrainConfig
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.pipeline import study
from endopilot.types import Volume

STAGES = ["read", "segmentation", "anatomy", "dataset", "training", "evaluation", "report"]
SIZE = ("--sequences", "5", "--seconds", "20", "--training-seconds", "0.5")
COARSE = partial(PhantomConfig, in_plane_mm=0.75, slice_mm=0.8, margin_mm=10.0)
"""CT angiograms that are segmented sooner."""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Return a folder with the CT of a patient, a wire's file, and a run on both that was killed on its way."""
    folder = tmp_path_factory.mktemp("case")
    patient = make_patient(AtlasConfig(vessel="rca", count=1, seed=1), 0)
    write_volume(make_phantom(patient, config=COARSE(), seed=4), folder / "ct.nii.gz")
    shutil.copy(device_yaml("workhorse-014")[0], folder / "wire.yaml")
    line = [sys.executable, "-m", "endopilot.cli", *map(str, arguments(folder))]
    with subprocess.Popen(line, stderr=subprocess.DEVNULL) as first:
        deadline = time.monotonic() + 300
        while not masks(folder):
            assert first.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        first.send_signal(signal.SIGKILL)
    return folder


def arguments(folder: Path, volume: Path | None = None) -> tuple[str | Path, ...]:
    return ("run", volume or folder / "ct.nii.gz", "-o", folder / "run", "--device", folder / "wire.yaml", *SIZE)


def masks(folder: Path) -> dict[Path, int]:
    """Return when each finished mask was written."""
    return {path: path.stat().st_mtime_ns for path in (folder / "run" / "masks").glob("[!.]*.nii.gz")}


def test_a_killed_run_goes_on_to_its_report_and_is_then_left_alone(case, capsys, monkeypatch):
    monkeypatch.setattr(study, "TrainConfig", partial(TrainConfig, epochs=3))  # each checks and writes the networks
    before = masks(case)
    assert before and not (case / "run" / "report.html").exists()
    line = (*arguments(case), "--target", "2")  # none was given before
    found = command.run(capsys, *line)
    assert masks(case) == before  # finished work is not done twice

    assert list(found)[:2] == ["outcome", "page"] and found["outcome"].startswith("reached section 2 at ")
    assert found["page"] == str(case / "run" / "navigation" / "2" / "navigation.html")
    assert found["report"] == str(case / "run" / "report.html") and found["rejected"] == {}
    page = (case / "run" / "report.html").read_text(encoding="utf-8")
    for part in ("data:image/png;base64,", "Plotly.newPlot", "One CT angiogram, given by the user", "Kim et al. 2023"):
        assert part in page
    manifest, metrics = read_json(case / "run" / "manifest.json"), read_json(case / "run" / "metrics.json")
    assert list(manifest["stages"]) == STAGES and manifest["inputs"] == input_hash(case / "ct.nii.gz")
    assert list(metrics["splits"]) == ["seen_test"] and metrics["findings"] == found["findings"]
    assert metrics["splits"]["seen_test"]["episodes"] == 1
    assert [path for path in case.rglob("*") if path.name.startswith(".part")] == []

    written = {path: path.stat().st_mtime_ns for path in case.rglob("*")}
    assert command.run(capsys, *line) == found
    assert "has no such section" in command.refused(capsys, *arguments(case), "--target", "LADX")
    assert {path: path.stat().st_mtime_ns for path in case.rglob("*")} == written


def test_another_series_is_refused(tmp_path, capsys):
    study = tmp_path / "study"
    for number in (1, 2):
        write_volume(tiny_ct(number), study / f"series-{number}")
        for file in (study / f"series-{number}").iterdir():
            slice_ = pydicom.dcmread(file)
            slice_.SeriesNumber = number
            slice_.save_as(file)
    line = ("run", study, "-o", tmp_path / "run", *SIZE)
    first = command.refused(capsys, *line, "--series", "1")  # no vessel is in it: the run ends after the first stage
    assert "was begun" not in first and (tmp_path / "run" / "ct" / "patient.nii.gz").exists()
    assert "was begun with volume_sha256 = " in command.refused(capsys, *line, "--series", "2")
    assert command.refused(capsys, *line, "--series", "1") == first


def tiny_ct(seed: int) -> Volume:
    """Return a volume of noise."""
    voxels = np.random.default_rng(seed).integers(-1000, 1000, (8, 8, 8)).astype(np.int16)
    return Volume(voxels, np.ones(3), np.zeros(3), np.eye(3))


OF_DEMO = ("--patients", "3", "--sequences", "1", "--seconds", "20")
DEMO_STAGES = ["atlas", "phantom", "segmentation", "anatomy", "navigation", "dataset", "evaluation", "report"]


def test_a_demo_ends_with_a_report_and_is_then_left_alone(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "demo"
    monkeypatch.setattr(study, "PhantomConfig", COARSE)
    again = command.run(capsys, "demo", "-o", folder, *OF_DEMO)

    report = (folder / "report.html").read_text(encoding="utf-8")
    for part in ("data:image/png;base64,", "Plotly.newPlot", "Kim et al. 2023", "Safety ratio", "patient-3"):
        assert part in report
    manifest = read_json(folder / "manifest.json")
    assert list(manifest["stages"]) == DEMO_STAGES and min(manifest["stages"].values()) > 0
    assert abs(manifest["wall_seconds"] - sum(manifest["stages"].values())) < 1e-6
    metrics = read_json(folder / "metrics.json")
    unseen = metrics["splits"]["test"]
    assert list(metrics["splits"]) == ["test"]
    assert len(unseen["anatomies"]) == 3 and unseen["episodes"] == 3
    assert unseen["tip"]["P1"]["abscissa"]["all"]["skill"]["hold_slack"] > 0.4  # simulated wires
    for series in ("P1", "P3", "P4", "hold_slack"):
        assert unseen["tip"][series]["abscissa"]["all"]["count"] > 0
    assert min(score["dice"] for score in metrics["anatomy_scores"].values()) > 0.85
    assert 'href="navigation/navigation.html"' in report and (folder / "navigation" / "navigation.html").exists()
    assert read_json(folder / "navigation" / "manifest.json")["figures"]["outcome"] in html.unescape(report)
    unfinished = [path for path in folder.rglob("*") if path.name.startswith(".part")]
    assert unfinished == []

    finished = (folder / "report.html").stat().st_mtime_ns
    assert command.run(capsys, "demo", "-o", folder, *OF_DEMO) == again
    assert (folder / "report.html").stat().st_mtime_ns == finished
