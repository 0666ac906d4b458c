"""Images at the command line: synthetic CT as DICOM, and bad ones, each refused in one line with nothing written."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pydicom
import pytest
from command import refused, run

from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.imaging.volume import read_mask, read_volume, write_mask, write_volume
from endopilot.types import Insertion, LumenMask, Volume

_COARSE = ("--in-plane-mm", "1.0", "--slice-mm", "1.2", "--margin-mm", "8")


@pytest.fixture(scope="module")
def patient(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("patient") / "rca"
    write_anatomy(make_patient(AtlasConfig(seed=7), 0), output=folder)
    return folder


@pytest.fixture(scope="module")
def enhanced(tmp_path_factory, patient) -> Path:
    """Return a folder of DICOM slices of a synthetic CT angiogram."""
    from endopilot.cli import main

    folder = tmp_path_factory.mktemp("phantom") / "ct"
    with pytest.raises(SystemExit) as leaving:
        main(["phantom", str(patient), "-o", f"{folder}/", *_COARSE])
    assert leaving.value.code == 0
    return folder


def test_a_phantom_as_dicom_is_that_as_nifti(enhanced, patient, tmp_path, capsys):
    """Bit for bit in HU, and within 1e-4 mm in place."""
    run(capsys, "phantom", patient, "-o", tmp_path / "ct.nrrd", *_COARSE)
    dicom, other = read_volume(enhanced), read_volume(tmp_path / "ct.nrrd")
    assert dicom.voxels.dtype == other.voxels.dtype == np.int16
    np.testing.assert_array_equal(dicom.voxels, other.voxels)
    corner = np.array(other.voxels.shape[::-1], dtype=float)
    for index in (np.zeros(3), corner, corner * [1, 0, 0]):
        np.testing.assert_allclose(dicom.index_to_world(index), other.index_to_world(index), atol=1e-4)
    line = refused(capsys, "phantom", patient, "-o", enhanced, *_COARSE)
    assert "there already" in line
    assert "unknown format" in refused(capsys, "phantom", patient, "-o", tmp_path / "ct.png", *_COARSE)


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


def test_bad_series(few, tmp_path, capsys):
    def copy(name: str, **values) -> Path:
        return _changed(few, tmp_path / name, **values)

    truncated, missing, phases = copy("truncated"), copy("missing"), copy("phases")
    slices = sorted(truncated.iterdir())
    slices[3].write_bytes(slices[3].read_bytes()[:-1000])
    sorted(missing.iterdir())[3].unlink()
    shutil.copy(sorted(phases.iterdir())[2], phases / "again.dcm")
    two = copy("two")
    for file in copy("other", SeriesInstanceUID="1.2.3", SeriesNumber=4).iterdir():
        shutil.copy(file, two / f"other-{file.name}")
    compressed = copy("compressed")
    for file in compressed.iterdir():
        slice_ = pydicom.dcmread(file)
        slice_.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.4.201"
        slice_.PixelData = pydicom.encaps.encapsulate([b"nonsense"])
        slice_["PixelData"].is_undefined_length = True
        slice_.save_as(file)
    tilted = copy("tilted")
    for k, file in enumerate(sorted(tilted.iterdir())):
        slice_ = pydicom.dcmread(file)
        slice_.ImagePositionPatient[1] = float(slice_.ImagePositionPatient[1]) + k / 5
        slice_.save_as(file)
    for volume, fragments in {
        truncated: ("truncated", slices[3].name),
        missing: ("slices are missing", "after slice 3"),
        phases: ("several images at one slice position",),
        two: ("2 DICOM series (1: CT, 6 slices", "4: CT, 6 slices", "--series"),
        compressed: ("compressed as High-Throughput JPEG 2000", "gdcmconv"),
        tilted: ("off by 9.5°", "gantry tilt"),
        copy("magnet", Modality="MR"): ("modality MR", "give a CT"),
        copy("mixed", every=2, PixelSpacing=["2", "2"]): ("PixelSpacing differ", "one volume alone"),
        copy("raw", RescaleSlope=None): ("no RescaleSlope",),
    }.items():
        line = _refused(capsys, volume)
        assert volume.name in line and all(fragment in line for fragment in fragments), line
    assert "contrast" in _refused(capsys, two, "--series", "4")  # six slices of aorta are read, and too few to go on


def test_a_straightened_ct_is_told_by_every_command(patient, tmp_path, capsys, monkeypatch):
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
    image = run(capsys, "xray", patient, "-o", tmp_path / "image.png", "--ct", skewed, "--inserted-length-mm", "10")
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


def test_a_segment_is_chosen_by_name(tmp_path, capsys):
    tubes = np.zeros((2, 40, 30, 30), dtype=np.uint8)
    tubes[0, 2:38, 7:13, 7:13], tubes[1, 2:30, 10:16, 10:16] = 1, 1
    stored = np.moveaxis(tubes, 0, -1).tobytes()
    head = (
        *("NRRD0004", "type: uint8", "dimension: 4", "space: left-posterior-superior", "sizes: 2 30 30 40"),
        *("space directions: none (0.5,0,0) (0,0.5,0) (0,0,1)", "kinds: list domain domain domain", "encoding: raw"),
        *("space origin: (0,0,0)", "Segment0_ID:=S1", "Segment0_Name:=RCA", "Segment0_Layer:=0"),
        *("Segment0_LabelValue:=1", "Segment1_ID:=S2", "Segment1_Name:=vein", "Segment1_Layer:=1"),
        "Segment1_LabelValue:=1",
    )
    path = tmp_path / "heart.seg.nrrd"
    path.write_bytes("\n".join(head).encode() + b"\n\n" + stored)
    assert "2 labels (1 (RCA), 2 (vein))" in refused(capsys, "anatomy", path, "-o", tmp_path / "none")
    for label, z_mm in (("RCA", 37), ("1", 37), ("vein", 29), ("2", 29)):
        start = ("--ostium-mm", "5", "5", str(z_mm), "--label", label)
        figures = run(capsys, "anatomy", path, "-o", tmp_path / label, *start)
        assert abs(figures["longest_path_mm"] - z_mm) < 6


def test_a_ct_without_contrast(enhanced, tmp_path, capsys):
    bright = read_volume(enhanced)
    voxels = np.where(bright.voxels > 90, 45 + bright.voxels // 16, bright.voxels).astype(np.int16)
    write_volume(Volume(voxels, bright.spacing_mm, bright.origin_mm, bright.direction), tmp_path / "ct.nii.gz")
    line = _refused(capsys, tmp_path / "ct.nii.gz")
    assert "no contrast: homogeneous soft tissue peaks at" in line and "arterial phase" in line
    plain = read_volume(tmp_path / "ct.nii.gz")
    raw = Volume(plain.voxels + np.int16(1100), plain.spacing_mm, plain.origin_mm, plain.direction)
    write_volume(raw, tmp_path / "raw.nii.gz")
    assert "below 0 HU" in _refused(capsys, tmp_path / "raw.nii.gz")


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
