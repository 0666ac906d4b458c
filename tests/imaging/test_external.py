"""Adapters to other programs, with fake programs on the PATH that take the real ones' arguments."""

from __future__ import annotations

import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from shapes import BLOOD_HU, empty_grid, positions

from endopilot.errors import InputError
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.types import Volume

_TOTALSEGMENTATOR = """
import argparse, pathlib, SimpleITK as sitk
parser = argparse.ArgumentParser()
parser.add_argument("-i", type=pathlib.Path, required=True)
parser.add_argument("-o", type=pathlib.Path, required=True)
parser.add_argument("-ta", "--task", choices=["total", "coronary_arteries"])
parser.add_argument("-rs", "--roi_subset", nargs="+", default=["coronary_arteries"])
parser.add_argument("-d", "--device", default="gpu")
parser.add_argument("-q", "--quiet", action="store_true")
given = parser.parse_args()
assert given.device == {device!r}
ct = sitk.ReadImage(str(given.i))
sitk.WriteImage(ct > {above}, str(given.o / (given.roi_subset[0] + ".nii.gz")))
"""

_NNUNET = """
import argparse, pathlib, SimpleITK as sitk
parser = argparse.ArgumentParser()
parser.add_argument("-i", type=pathlib.Path, required=True)
parser.add_argument("-o", type=pathlib.Path, required=True)
parser.add_argument("-m", type=pathlib.Path, required=True)
parser.add_argument("-f", nargs="+")
parser.add_argument("-device", default="cuda")
parser.add_argument("--disable_progress_bar", action="store_true")
given = parser.parse_args()
assert given.f == ["0", "1"] and (given.m / "dataset.json").exists()
ct = sitk.ReadImage(str(given.i / "ct_0000.nrrd"))
labels = sitk.Cast(ct > -1000, sitk.sitkUInt8) + sitk.Cast(ct > 300, sitk.sitkUInt8)
sitk.WriteImage(labels, str(given.o / "ct.nrrd"))
"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Return a function that puts a program on the PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))

    def add(name: str, text: str) -> None:
        file = folder / name
        file.write_text(f"#!{sys.executable}\n{text}")
        file.chmod(file.stat().st_mode | stat.S_IXUSR)

    return add


@pytest.fixture(scope="module")
def ct() -> Volume:
    """Return a tube of blood along z from z = -20, in fat, on anisotropic voxels with an oblique axis."""
    grid = empty_grid((40, 30, 30), (1.5, 1.5, 1.0), (-22.0, -22.0, -20.0))
    x, y, _ = np.moveaxis(positions(grid), -1, 0)
    hu = np.where(np.hypot(x, y) < 14.0, BLOOD_HU, -90.0)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Volume(np.round(hu).astype(np.int16), grid.spacing_mm, turn @ grid.origin_mm, turn)


def _model(folder: Path) -> Path:
    for fold in ("fold_0", "fold_1"):
        (folder / fold).mkdir(parents=True)
    (folder / "dataset.json").write_text('{"file_ending": ".nrrd"}')
    return folder


def test_totalsegmentator_is_run_and_its_mask_taken(program, ct):
    program("TotalSegmentator", _TOTALSEGMENTATOR.format(device="gpu", above=200))
    mask = segment(ct, config=SegmentConfig(method="totalsegmentator"))
    np.testing.assert_array_equal(mask.volume.voxels, ct.voxels > 200)
    np.testing.assert_allclose(mask.volume.direction, ct.direction)
    assert mask.ostium is None and mask.method == "totalsegmentator"


def test_another_task_and_device_are_passed_on_and_the_first_seed_is_the_ostium(program, ct):
    program("TotalSegmentator", _TOTALSEGMENTATOR.format(device="cpu", above=200))
    options = ("task=total", "structure=aorta", "device=cpu")
    end = ((0.0, 0.0, -20.0), (0.0, 0.0, 15.0))
    mask = segment(ct, config=SegmentConfig(method="totalsegmentator", options=options, seeds=end))
    assert mask.ostium is not None
    np.testing.assert_allclose(mask.ostium.position, end[0])
    assert mask.ostium.direction[2] > 0.95
    away = SegmentConfig(method="totalsegmentator", options=options, seeds=((20.0, 0.0, 0.0),))
    with pytest.raises(InputError, match=r"seeds: the lumen found is 7 mm from \(20.0, 0.0, 0.0\)"):
        segment(ct, config=away)


def test_nnunet_is_run_with_all_folds_in_the_model_s_own_format(program, ct, tmp_path):
    program("nnUNetv2_predict_from_modelfolder", _NNUNET)
    model = f"model={_model(tmp_path / 'model')}"
    with pytest.raises(InputError, match=r"marked 2 labels \(1, 2\); choose one"):
        segment(ct, config=SegmentConfig(method="nnunet", options=(model,)))
    mask = segment(ct, config=SegmentConfig(method="nnunet", options=(model, "label=2")))
    np.testing.assert_array_equal(mask.volume.voxels, ct.voxels > 300)
    with pytest.raises(InputError, match="no voxel with label 3"):
        segment(ct, config=SegmentConfig(method="nnunet", options=(model, "label=3")))


@pytest.mark.parametrize("options", [(), ("model=/nowhere",)])
def test_nnunet_without_a_model_is_refused(ct, options):
    with pytest.raises(InputError, match=r"holds no trained nnU-Net; give --options model=FOLDER"):
        segment(ct, config=SegmentConfig(method="nnunet", options=options))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "program TotalSegmentator is not on the PATH; install TotalSegmentator"),
        (
            "raise SystemExit('ERROR: no licence')",
            "exit code 1: ERROR: no licence; install",
        ),
        ("print('done')", r"wrote no coronary_arteries.nii.gz \(it wrote nothing\)"),
        (_TOTALSEGMENTATOR.format(device="gpu", above=3000), "found no lumen in this CT"),
        (
            "import sys; open(sys.argv[4] + '/coronary_arteries.nii.gz', 'w').write('x')",
            "is no volume; install",
        ),
    ],
    ids=["missing", "fails", "writes nothing", "finds nothing", "writes rubbish"],
)
def test_a_program_that_does_not_answer_is_reported_in_one_line(program, ct, text, expected):
    if text is not None:
        program("TotalSegmentator", text)
    with pytest.raises(InputError, match=expected) as caught:
        segment(ct, config=SegmentConfig(method="totalsegmentator"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("factor", [1.15, 0.9])
def test_an_answer_with_other_voxels_of_the_same_number_is_put_where_it_lies(program, ct, factor):
    change = f"(1, mask.GetOrigin(), [{factor} * step for step in mask.GetSpacing()], mask.GetDirection())"
    text = _TOTALSEGMENTATOR.format(device="gpu", above=200)
    text = text.replace(
        "sitk.WriteImage(ct > 200",
        f"mask = ct > 200\nsitk.WriteImage(sitk.Resample(mask, mask.GetSize(), sitk.Transform(), *{change})",
    )
    program("TotalSegmentator", text)
    found = segment(ct, config=SegmentConfig(method="totalsegmentator")).volume.voxels
    k, j, i = np.indices(found.shape)
    held = (np.stack([i, j, k]) < factor * (np.array([29, 29, 39])[:, None, None, None] - 1)).all(axis=0)
    overlap = 2 * (found & (ct.voxels > 200) & held).sum() / ((found & held).sum() + (ct.voxels > 200)[held].sum())
    assert overlap > 0.95


def test_an_answer_beside_the_ct_is_refused(program, ct):
    text = _TOTALSEGMENTATOR.format(device="gpu", above=200)
    text = text.replace("sitk.WriteImage(ct >", "ct.SetOrigin([900.0, 0.0, 0.0])\nsitk.WriteImage(ct >")
    program("TotalSegmentator", text)
    with pytest.raises(InputError, match="TotalSegmentator wrote a mask that lies outside the CT"):
        segment(ct, config=SegmentConfig(method="totalsegmentator"))


def test_the_program_gets_nothing_but_geometry_and_hu(program, ct, tmp_path):
    program("TotalSegmentator", f"import shutil, sys; shutil.copy(sys.argv[2], {str(tmp_path / 'got.nii.gz')!r})")
    with pytest.raises(InputError, match="wrote nothing"):
        segment(ct, config=SegmentConfig(method="totalsegmentator"))
    from endopilot.imaging.volume import read_volume

    np.testing.assert_array_equal(read_volume(tmp_path / "got.nii.gz").voxels, ct.voxels)
