"""Bad input at the command line: one line, exit code 2, nothing half-written."""

from __future__ import annotations

from pathlib import Path

import pytest

from command import refused


def test_the_cockpits_catheters(right_artery, tmp_path, capsys):
    recordings = ("--output", tmp_path / "recordings")
    narrow = refused(
        capsys, "cockpit", right_artery, "--device", "j-035", "--catheter", "microcatheter-1.7f", *recordings
    )
    assert "is too wide for the bore of catheter microcatheter-1.7f" in narrow
    assert "no such catheter" in refused(capsys, "cockpit", right_artery, "--catheter", "nonesuch", *recordings)
    brought = refused(capsys, "cockpit", "--task", "follow", "--catheter", "microcatheter-1.7f", *recordings)
    assert brought.endswith("catheter: a replay, a task and a session have theirs; leave it out")
    assert "follow" in refused(capsys, "cockpit", "--task", "nonesuch", *recordings)
    assert not (tmp_path / "recordings").exists()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "plan mask.nrrd --target 4",
            "mask.nrrd: is a file; make an anatomy of it first: `endopilot anatomy mask.nrrd",
        ),
        ("anatomy {patient}", "{patient}: is an anatomy already; give it to the next command"),
        ("simulate {patient} --seed abc", "seed: 'abc'; give a whole number"),
        ("phantom {patient} --slice-mm thin", "slice_mm: 'thin'; give a number"),
        ("segment mask.nrrd --picture slices.jpeg2", "slices.jpeg2: is written as .png; end the name so"),
    ],
)
def test_what_is_given_in_the_wrong_place_is_told(right_artery, tmp_path, capsys, monkeypatch, command, said):
    monkeypatch.chdir(tmp_path)
    Path("mask.nrrd").write_bytes(b"")
    words = [word.format(patient=right_artery) for word in command.split()]
    assert said.format(patient=right_artery) in refused(capsys, *words, "-o", tmp_path / "out.csv")
