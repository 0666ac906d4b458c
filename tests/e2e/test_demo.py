"""The demo, small: killed after its first stages, continued to the report, and then left alone."""

from __future__ import annotations

import html
import signal
import subprocess
import sys
import time
from functools import partial

import command

from endopilot import __version__
from endopilot.devices.device import read_wire
from endopilot.files import read_json
from endopilot.phantom.phantom import PhantomConfig
from endopilot.pipeline import study
from endopilot.pipeline.study import DemoConfig
from endopilot.runs import claim

SIZE = ("--patients", "3", "--sequences", "1", "--seconds", "20")
STAGES = ["atlas", "phantom", "segmentation", "anatomy", "navigation", "dataset", "evaluation", "report"]


def test_killed_and_started_again_it_ends_with_a_report(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "demo"
    line = [sys.executable, "-m", "endopilot.cli", "demo", "-o", str(folder), *SIZE]
    with subprocess.Popen(line, stderr=subprocess.DEVNULL) as first:
        deadline = time.monotonic() + 300
        while not (folder / "stages.json").exists():  # written as the first stage ends
            assert first.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        time.sleep(0.5)  # in the midst of the second
        first.send_signal(signal.SIGKILL)
    assert not (folder / "report.html").exists()
    before = {path: path.stat().st_mtime_ns for path in (folder / "truth").rglob("*.json")}

    small = partial(PhantomConfig, in_plane_mm=0.75, slice_mm=0.8, margin_mm=10.0)  # seen sooner
    monkeypatch.setattr(study, "PhantomConfig", small)
    again = command.run(capsys, "demo", "-o", folder, *SIZE)
    assert {path: path.stat().st_mtime_ns for path in before} == before  # finished work is not done twice

    report = (folder / "report.html").read_text(encoding="utf-8")
    for part in ("data:image/png;base64,", "Plotly.newPlot", "Kim et al. 2023", "Safety ratio", "patient-3"):
        assert part in report
    manifest = read_json(folder / "manifest.json")
    assert list(manifest["stages"]) == STAGES and min(manifest["stages"].values()) > 0
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
    assert command.run(capsys, "demo", "-o", folder, *SIZE) == again
    assert (folder / "report.html").stat().st_mtime_ns == finished


def test_another_size_in_the_same_folder_is_refused(tmp_path, capsys):
    claim(
        tmp_path,
        "endopilot demo",
        config=DemoConfig(patients=6),
        device=read_wire("workhorse-014"),
        version=__version__,
    )
    (tmp_path / "stages.json").write_text("{}")
    line = command.refused(capsys, "demo", "-o", tmp_path, *SIZE)
    assert f"was begun with config.sequences = {DemoConfig().sequences}, now it is 1" in line
