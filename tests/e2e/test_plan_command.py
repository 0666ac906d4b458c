"""`endopilot plan` as a command: figures and files, and one line for what cannot be planned."""

from __future__ import annotations

import re

import numpy as np
import pytest

from command import refused, run


def test_desired_tips_that_no_drive_can_keep_up_with(vessel, tmp_path, capsys):
    (tmp_path / "tips.csv").write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,10,0.2\n1.0,43,0\n")
    line = refused(capsys, "plan", vessel, "--target", tmp_path / "tips.csv", "-o", tmp_path / "plan")
    assert "1 s are too few for the 41 mm" in line and "40 mm/s" in line
    assert not (tmp_path / "plan").exists()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("--target", "80,0,0"), ("80,0,0", "LPS")),
        (("--target", "nothing.csv"), ("nothing.csv",)),
        (("--target", "0,0,33", "--seconds", "2"), ("seconds: 2", "31 mm", "speed_mm_s")),
        (("--target", "0,0,33", "--force-limit-n", "nan"), ("force_limit_n",)),
        (("--target", "0,0,33", "--force-limit-n", "1e-6"), ("under 1e-06 N", "workhorse-014", "larger force_limit_n")),
    ],
)
def test_what_cannot_be_planned_is_refused_in_one_line(vessel, tmp_path, capsys, arguments, parts):
    line = refused(capsys, "plan", vessel, *arguments, "-o", tmp_path / "plan")
    assert all(part in line for part in parts), line
    assert not (tmp_path / "plan").exists()


def test_a_branch_that_the_wire_does_not_get_into(vessel, tmp_path, capsys):
    """A wire without a bend at its tip."""
    from endopilot.devices.device_files import device_yaml

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
