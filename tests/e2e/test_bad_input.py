"""Bad input at the command line: one line, exit code 2, nothing half-written; and what a plan needs instead."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from command import refused, run
from endopilot.devices.device_files import device_yaml


def test_the_cockpits_catheters(patient, tmp_path, capsys):
    recordings = ("--output", tmp_path / "recordings")
    narrow = refused(capsys, "cockpit", patient, "--device", "j-035", "--catheter", "microcatheter-1.7f", *recordings)
    assert "is too wide for the bore of catheter microcatheter-1.7f" in narrow
    assert "no such catheter" in refused(capsys, "cockpit", patient, "--catheter", "nonesuch", *recordings)
    brought = refused(capsys, "cockpit", "--task", "follow", "--catheter", "microcatheter-1.7f", *recordings)
    assert brought.endswith("catheter: a replay, a task and a session have theirs; leave it out")
    assert "follow" in refused(capsys, "cockpit", "--task", "nonesuch", *recordings)
    assert not (tmp_path / "recordings").exists()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "plan mask.nrrd --target 4",
            ["mask.nrrd: is a file; make an anatomy of it first: `", "`endopilot anatomy mask.nrrd"],
        ),
        ("anatomy {patient}", ["{patient}: is an anatomy already; give it to the next command"]),
        ("simulate {patient} --seed abc", ["seed: 'abc'; give a whole number"]),
        ("phantom {patient} --slice-mm thin", ["slice_mm: 'thin'; give a number"]),
        ("segment mask.nrrd --picture slices.jpeg2", ["slices.jpeg2: is written as .png; end the name so"]),
        ("segment missing.nii.gz", ["missing"]),
        ("anatomy missing.stl", ["missing"]),
        ("phantom missing", ["missing"]),
        ("simulate missing", ["missing"]),
        ("dataset missing", ["missing"]),
        ("train missing", ["missing"]),
        ("evaluate missing", ["missing"]),
        ("replay missing.csv --anatomy missing", ["missing"]),
        ("plan {vessel} --target 80,0,0", ["80,0,0", "LPS"]),
        ("plan {vessel} --target nothing.csv", ["nothing.csv"]),
        ("plan {vessel} --target tips.csv", ["1 s are too few for the 41 mm", "40 mm/s"]),  # faster than any drive
        ("plan {vessel} --target 0,0,33 --seconds 2", ["seconds: 2", "31 mm", "speed_mm_s"]),
        ("plan {vessel} --target 0,0,33 --force-limit-n nan", ["force_limit_n"]),
        (
            "plan {vessel} --target 0,0,33 --force-limit-n 1e-6",
            ["under 1e-06 N", "workhorse-014", "larger force_limit_n"],
        ),
    ],
)
def test_what_is_wrong_is_told_in_one_line(patient, vessel, tmp_path, capsys, monkeypatch, command, said):
    monkeypatch.chdir(tmp_path)
    Path("mask.nrrd").write_bytes(b"")
    Path("tips.csv").write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,10,0.2\n1.0,43,0\n")
    before, folders = sorted(tmp_path.iterdir()), {"patient": patient, "vessel": vessel}
    written = {"segment": "out.nii.gz", "phantom": "out.nii.gz", "simulate": "out.csv"}.get(command.split()[0], "out")
    line = refused(capsys, *command.format(**folders).split(), "-o", written)
    assert all(part.format(**folders) in line for part in said), line
    assert sorted(tmp_path.iterdir()) == before


def test_a_branch_that_the_wire_does_not_get_into(vessel, tmp_path, capsys):
    """A wire without a bend at its tip."""
    text = device_yaml("workhorse-014")[1].replace("angle_deg: 45", "angle_deg: 0")
    (tmp_path / "straight.yaml").write_text(text)
    out = 20.0 * np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)]) * 0.8 + [0.0, 0.0, 20.0]
    target = ",".join(f"{x:.2f}" for x in out)
    plan = ("plan", vessel, "--target", target, "-o", tmp_path / "plan", "--device", tmp_path / "straight.yaml")
    line = refused(capsys, *plan, "--tip", "own")
    assert "no path found to branch 2" in line
    assert "at the fork into section vessel (branch 2) at 20.0 mm, which its tip of 0/3 does not enter" in line
    assert "--tip" in line and "--catheter-tilt-deg" in line
    assert not (tmp_path / "plan").exists()
    shaped = run(capsys, *plan)  # a hand bends it
    assert shaped["reached"] and shaped["tip"] != "0/3"
    assert re.search(r"enters vessel from \d+ of 24 rotations; as delivered from none", shaped["why"])
    assert run(capsys, "simulate", vessel, "--controls", tmp_path / "plan", "-o", tmp_path / "again.csv", *plan[-2:])
