"""Bad input at the command line: one line, exit code 2, nothing half-written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from command import refused, run

import endopilot
from dicom_by_itk import write_dicom
from endopilot.cli import main
from endopilot.devices.device_files import device_yaml
from endopilot.files import read_json
from endopilot.imaging.volume import write_mask
from endopilot.types import Insertion, LumenMask, Volume


def write_image(array: np.ndarray, path: Path, *, vector: bool = False) -> Path:
    sitk.WriteImage(sitk.GetImageFromArray(array, isVector=vector), str(path))
    return path


def write_slices(folder: Path, series: str, first: int) -> None:
    image = sitk.GetImageFromArray(np.zeros((4, 8, 8), dtype=np.int16))
    for k in range(4):
        cut = image[:, :, k]
        tags = {"0008|0060": "CT", "0020|000e": series, "0020|0013": str(k), "0008|0018": f"{series}.{k}"}
        tags |= {"0020|0032": f"0\\0\\{k}", "0020|0037": "1\\0\\0\\0\\1\\0", "0028|1052": "-1024", "0028|1053": "1"}
        for tag, value in tags.items():
            cut.SetMetaData(tag, value)
        write_dicom(cut, folder / f"{first + k}.dcm")


def test_volumes(tmp_path, capsys):
    series = tmp_path / "dicom"
    series.mkdir()
    write_slices(series, "1.2.3.1", 0)
    write_slices(series, "1.2.3.2", 4)
    four = write_image(np.zeros((3, 6, 6, 6), dtype=np.int16), tmp_path / "four.nii.gz")
    colour = write_image(np.zeros((6, 6, 6, 3), dtype=np.uint8), tmp_path / "colour.nrrd", vector=True)
    whole = write_image(np.arange(8000, dtype=np.int16).reshape(20, 20, 20), tmp_path / "whole.nii")
    truncated = tmp_path / "truncated.nii"
    truncated.write_bytes(whole.read_bytes()[:9000])
    for volume, fragment in ((series, "series"), (four, "4"), (colour, "colour"), (truncated, "truncated")):
        line = refused(capsys, "segment", volume, "-o", tmp_path / "mask.nii.gz")
        assert volume.name in line and fragment in line.lower(), line
        assert not list(tmp_path.glob("*mask*"))


def test_masks(tmp_path, capsys):
    grid = (np.ones(3), np.zeros(3), np.eye(3))
    voxels = np.zeros((30, 30, 30), dtype=bool)
    write_mask(LumenMask(Volume(voxels, *grid), None), tmp_path / "empty.nrrd", manifest={})
    voxels[5:25, 10:14, 10:14] = voxels[5:9, 10:25, 10:14] = True
    ostium = Insertion(np.array([200.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    write_mask(LumenMask(Volume(voxels, *grid), ostium), tmp_path / "far.nrrd", manifest={})
    assert "empty" in refused(capsys, "anatomy", tmp_path / "empty.nrrd", "-o", tmp_path / "anatomy")
    line = refused(capsys, "anatomy", tmp_path / "far.nrrd", "-o", tmp_path / "anatomy")
    assert "ostium" in line and "mm" in line
    assert not (tmp_path / "anatomy").exists()


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


def test_devices(right_artery, tmp_path, capsys):
    """A wire of one's own needs no code: it is read by its path; a bad one is refused by every command alike."""
    main_line = "bend_stiffness_n_mm2.value[1]: -0.3; give a number from 0.0001 to 1000000 N·mm²"
    text = device_yaml("workhorse-014")[1]
    bad = tmp_path / "bad.yaml"
    bad.write_text(text.replace("[0.30, 0.30", "[0.30, -0.30"))
    for command in (("simulate", right_artery), ("dataset", right_artery), ("devices", bad)):
        chosen = () if command[0] == "devices" else ("--device", bad, "-o", tmp_path / "out")
        line = refused(capsys, *command, *chosen)
        assert str(bad) in line and main_line in line, line
        assert list(tmp_path.iterdir()) == [bad]


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
        ("simulate {patient} --seed abc", "--seed: 'abc'; give a whole number"),
        ("simulate {patient} --sequences 2.5", "--sequences: '2.5'; give a whole number"),
        ("phantom {patient} --slice-mm thin", "--slice-mm: 'thin'; give a number"),
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
