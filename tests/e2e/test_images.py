"""Images at the command line: synthetic CT as DICOM, and bad ones, each refused in one line with nothing written."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
import pytest
from command import refused, run

from endopilot.anatomy.io import read_anatomy
from endopilot.imaging.volume import read_mask, read_volume, write_mask, write_volume
from endopilot.types import Insertion, LumenMask, Volume

_COARSE = ("--in-plane-mm", "1.0", "--slice-mm", "1.2", "--margin-mm", "8")


@pytest.fixture(scope="module")
def enhanced(tmp_path_factory, right_artery) -> Path:
    """Return a folder of DICOM slices of a synthetic CT angiogram."""
    from endopilot.cli import main

    folder = tmp_path_factory.mktemp("phantom") / "ct"
    with pytest.raises(SystemExit) as leaving:
        main(["phantom", str(right_artery), "-o", f"{folder}/", *_COARSE])
    assert leaving.value.code == 0
    return folder


def test_a_phantom_as_dicom_is_that_as_nifti(enhanced, right_artery, tmp_path, capsys):
    """Bit for bit in HU, and within 1e-4 mm in place."""
    run(capsys, "phantom", right_artery, "-o", tmp_path / "ct.nrrd", *_COARSE)
    dicom, other = read_volume(enhanced), read_volume(tmp_path / "ct.nrrd")
    assert dicom.voxels.dtype == other.voxels.dtype == np.int16
    np.testing.assert_array_equal(dicom.voxels, other.voxels)
    corner = np.array(other.voxels.shape[::-1], dtype=float)
    for index in (np.zeros(3), corner, corner * [1, 0, 0]):
        np.testing.assert_allclose(dicom.index_to_world(index), other.index_to_world(index), atol=1e-4)
    line = refused(capsys, "phantom", right_artery, "-o", enhanced, *_COARSE)
    assert "there already" in line
    assert "unknown format" in refused(capsys, "phantom", right_artery, "-o", tmp_path / "ct.png", *_COARSE)


def _refused(capsys, volume: Path, *options: str) -> str:
    """Run `segment` on a bad volume; nothing may be left."""
    mask = volume.parent / "mask.nii.gz"
    line = refused(capsys, "segment", volume, "-o", mask, *options)
    assert not [path for path in volume.parent.iterdir() if "mask" in path.name]
    return line


def _changed(source: Path, target: Path, every: int = 1, **values) -> Path:
    shutil.copytree(source, target)
    for file in sorted(target.iterdir())[::every]:
        slice_ = pydicom.dcmread(file)
        for name, value in values.items():
            setattr(slice_, name, value)
        slice_.save_as(file)
    return target


@pytest.fixture
def few(enhanced, tmp_path) -> Path:
    """Return a folder of the first six slices."""
    folder = tmp_path / "few"
    folder.mkdir()
    for file in sorted(enhanced.iterdir())[:6]:
        shutil.copy(file, folder)
    return folder


def test_a_straightened_ct_is_told_by_every_command(right_artery, tmp_path, capsys, monkeypatch):
    """The mask lies on straightened axes: its anatomy tells it too, from the file beside the mask."""
    from endopilot.pipeline import study

    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    _, j, i = np.indices((40, 40, 40))
    hu = np.where(np.hypot(j - 20, i - 20) < 7, 350, -90).astype(np.int16)
    write_volume(Volume(hu, np.full(3, 2.0), np.array([-25.0, -45.0, -72.0]), np.eye(3)), tmp_path / "straight")
    turned = ["1", "0", "0", "0.002", "0.999998", "0"]
    skewed = _changed(tmp_path / "straight", tmp_path / "ct", ImageOrientationPatient=turned)
    seed = ("15", "-5", "0")
    method = ("--method", "my_segmentation:threshold", "--options", "above=200", "--seeds", *seed)
    note = "ct: the axes in ImageOrientationPatient and ImagePositionPatient are off unit vectors"
    figures = run(capsys, "segment", skewed, "-o", tmp_path / "mask.nii.gz", *method)
    assert figures["warnings"][0].startswith(note)
    assert read_mask(tmp_path / "mask.nii.gz").warnings[0].startswith(note)
    image = run(
        capsys, "xray", right_artery, "-o", tmp_path / "image.png", "--ct", skewed, "--inserted-length-mm", "10"
    )
    assert image["ct_notes"][0].startswith(note)
    monkeypatch.setattr(study, "_study", lambda run, anatomies: {"notes": list(run.notes)})
    figures = run(capsys, "run", skewed, "-o", tmp_path / "run", *method)
    assert figures["notes"][0].startswith(note)
    assert read_mask(tmp_path / "run" / "masks" / "patient.nii.gz").warnings[0].startswith(note)
    assert read_anatomy(tmp_path / "run" / "anatomies" / "patient").provenance["notes"][1].startswith(note)


def test_a_phase_is_chosen(few, tmp_path, capsys):
    phases = _changed(few, tmp_path / "phases", NominalPercentageOfCardiacPhase=40.0)
    for file in _changed(few, tmp_path / "late", NominalPercentageOfCardiacPhase=75.0).iterdir():
        shutil.copy(file, phases / f"late-{file.name}")
    line = _refused(capsys, phases)
    assert "2 phases by NominalPercentageOfCardiacPhase (40%: 6 slices; 75%: 6 slices)" in line and "--phase 40" in line
    assert "no phase '60'" in _refused(capsys, phases, "--phase", "60")
    assert "phase" not in _refused(capsys, phases, "--phase", "75")  # read, and too thin for what follows
    refused(capsys, "run", phases, "-o", tmp_path / "run")


def test_volumes_that_miss_the_ostium(enhanced, tmp_path, capsys):
    """The ostium is at the origin: one volume begins above it, one ends below the whole aorta."""
    whole = read_volume(enhanced)
    height = whole.index_to_world(np.stack([np.zeros(len(whole.voxels))] * 2 + [np.arange(len(whole.voxels))], -1))[
        :, 2
    ]
    for name, kept in {"above": height > 4.0, "below": height < -45.0}.items():
        first = whole.index_to_world(np.array([0.0, 0.0, float(kept.argmax())]))
        write_volume(Volume(whole.voxels[kept], whole.spacing_mm, first, whole.direction), tmp_path / f"{name}.nii.gz")
        line = _refused(capsys, tmp_path / f"{name}.nii.gz")
        assert "seeds: the ostium first" in line or "the ostium is probably outside; give a CT" in line, line


def test_methods_and_outputs_that_do_not_fit(few, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    for file in few.iterdir():  # deep enough for what comes before the method: the slices are 9 mm in all
        slice_ = pydicom.dcmread(file)
        slice_.ImagePositionPatient[2] = 10.0 * float(slice_.ImagePositionPatient[2])
        slice_.save_as(file)
    for options, fragment in {
        ("--method", "magic"): "choose from aorta, coronary, nnunet, totalsegmentator",
        ("--method", "totalsegmentator"): "the program TotalSegmentator is not on the PATH",
        ("--method", "nnunet"): "--options model=FOLDER",
        ("--options", "model=x"): "no setting of method 'coronary'",
        ("--method", "aorta"): "--seeds x y z",
        ("--seeds", "0", "0", "900"): "lies outside the volume",
        ("--series", "9"): "no series '9'",
        ("--picture", "slices.jpeg2"): "slices.jpeg2: a picture is written as PNG",
    }.items():
        assert fragment in _refused(capsys, few, *options)
    assert "unknown format" in refused(capsys, "segment", few, "-o", tmp_path / "mask.png")


def test_a_mask_made_elsewhere_becomes_an_anatomy(tmp_path, capsys):
    """Without sidecar, in any format, DICOM-SEG among them; a first seed given later is the ostium."""
    pytest.importorskip("highdicom", reason="DICOM-SEG needs highdicom (the extra dicom-seg)")
    voxels = np.zeros((40, 20, 20), dtype=bool)
    voxels[2:38, 7:13, 7:13] = True
    mask = LumenMask(Volume(voxels, np.array([0.5, 0.5, 1.0]), np.array([5.0, -9.0, 700.0]), np.eye(3)))
    for name in ("a.nii.gz", "b.nrrd", "c.dcm"):
        write_mask(mask, tmp_path / name, manifest={})
        (tmp_path / f"{name.split('.')[0]}.json").unlink()
        assert read_mask(tmp_path / name).ostium is None
    start = ("--ostium-mm", "10", "-4", "702")
    figures = run(capsys, "anatomy", tmp_path / "c.dcm", "-o", tmp_path / "c-anatomy", *start)
    assert 28 < figures["longest_path_mm"] < 40
    np.testing.assert_allclose(figures["ostium_lps_mm"], [10.0, -4.0, 702.5], atol=1.5)
    ostium = Insertion(np.array([10.0, -4.0, 737.0]), np.array([0.0, 0.0, -1.0]))
    write_mask(LumenMask(mask.volume, ostium), tmp_path / "d.dcm", manifest={})
    figures = run(capsys, "anatomy", tmp_path / "d.dcm", "-o", tmp_path / "d-anatomy")
    assert figures["ostium_lps_mm"][2] > 734
    labels = 3 * voxels.astype(np.uint8)
    labels[:, 15:] = 1
    write_volume(replace(mask.volume, voxels=labels), tmp_path / "e.nrrd")
    assert "2 labels (1, 3)" in refused(capsys, "anatomy", tmp_path / "e.nrrd", "-o", tmp_path / "none")
    figures = run(capsys, "anatomy", tmp_path / "e.nrrd", "-o", tmp_path / "e-anatomy", "--label", "3", *start)
    assert 28 < figures["longest_path_mm"] < 40
