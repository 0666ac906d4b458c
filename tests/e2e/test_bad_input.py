"""Bad input at the command line: one line, exit code 2, nothing half-written."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import refused, run

import endopilot
from endopilot.cli import main
from endopilot.files import read_json


def test_wire_and_controls(tmp_path, capsys, right_artery):
    device = (Path(endopilot.__file__).parent / "devices/wires/j-035.yaml").read_text(encoding="utf-8")
    assert "value: 0.89" in device
    (tmp_path / "thick.yaml").write_text(device.replace("value: 0.89", "value: 5.5", 1), encoding="utf-8")
    header = "time_s,translation_mm_s,rotation_rad_s\n"
    (tmp_path / "nan.csv").write_text(header + "0.5,5,0\n1.0,nan,0\n")
    (tmp_path / "fast.csv").write_text(header + "0.5,5000,0\n")
    output = ("-o", tmp_path / "rollout.parquet")
    assert "lumen" in refused(capsys, "simulate", right_artery, *output, "--device", tmp_path / "thick.yaml")
    line = refused(capsys, "simulate", right_artery, *output, "--controls", tmp_path / "nan.csv")
    assert "nan.csv" in line and "row 3" in line and "translation_mm_s" in line
    assert "limit" in refused(capsys, "simulate", right_artery, *output, "--controls", tmp_path / "fast.csv")
    assert "sequences: 0; give" in refused(capsys, "simulate", right_artery, *output, "--sequences", "0")
    assert not (tmp_path / "rollout.parquet").exists()


def test_a_device_of_ones_own(right_artery, tmp_path, capsys):
    with pytest.raises(SystemExit) as leaving:
        main(["devices", "workhorse-014", "--yaml"])
    assert leaving.value.code == 0
    own = tmp_path / "my-wire.yaml"
    own.write_text(capsys.readouterr().out.replace("name: workhorse-014", "name: my-wire").replace("0.36", "0.40"))
    assert run(capsys, "devices", own)[0]["diameter_mm"] == 0.40
    out = tmp_path / "rollout.csv"
    figures = run(capsys, "simulate", right_artery, "--device", own, "-o", out, "--sequences", "1", "--seconds", "1")
    assert figures["valid_worlds"] == 1 and out.exists()
    made = tmp_path / "data"
    run(capsys, "dataset", right_artery, "--device", own, "-o", made, "--sequences", "2", "--seconds", "1")
    assert read_json(made / "meta" / "manifest.json")["device"]["diameter_mm"] == 0.40


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
        ("navigate mask.nrrd --target 4", "mask.nrrd: is a file; make an anatomy of it first"),
        ("simulate mask.nrrd", "mask.nrrd: is a file; make an anatomy of it first"),
        ("anatomy {patient}", "{patient}: is an anatomy already; give it to the next command"),
        ("simulate {patient} --seed abc", "seed: 'abc'; give a whole number"),
        ("simulate {patient} --sequences 2.5", "sequences: '2.5'; give a whole number"),
        ("phantom {patient} --slice-mm thin", "slice_mm: 'thin'; give a number"),
        ("segment mask.nrrd --picture slices.jpeg2", "slices.jpeg2: is written as .png; end the name so"),
        (
            "simulate {patient} --controls aside.csv",
            "aside.csv: row 1 holds one name and then numbers; exchange rows",
        ),
    ],
)
def test_what_is_given_in_the_wrong_place_is_told(right_artery, tmp_path, capsys, monkeypatch, command, said):
    monkeypatch.chdir(tmp_path)
    Path("mask.nrrd").write_bytes(b"")
    Path("aside.csv").write_text("time_s,0.5,1.0\ntranslation_mm_s,1,2\nrotation_rad_s,0,0\n")
    words = [word.format(patient=right_artery) for word in command.split()]
    assert said.format(patient=right_artery) in refused(capsys, *words, "-o", tmp_path / "out.csv")
