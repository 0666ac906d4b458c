"""Segmentation by methods: shipped ones, one's own, and other programs, fakes of which are on the PATH."""

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

_METHOD = """
from dataclasses import replace
import numpy as np
from endopilot.imaging.segment import SegmentationMethod
from endopilot.types import Insertion, LumenMask, Volume

OPTIONS = {"above": "200"}

def above(volume, config):
    inside = volume.voxels > float(config.settings(OPTIONS)["above"])
    ostium = Insertion(np.array(config.seeds[0] if config.seeds else (0.0, 0.0, 0.0)), np.array([0.0, 0.0, 1.0]))
    return LumenMask(Volume(inside, volume.spacing_mm, volume.origin_mm, volume.direction), ostium)

plain = SegmentationMethod(segment_lumen=above, options=OPTIONS)
head = SegmentationMethod(segment_lumen=above, blood_pools=False)

def voxels(volume, config):
    return volume.voxels > 200

def coarse(volume, config):
    return LumenMask(Volume(volume.voxels[::2] > 200, volume.spacing_mm, volume.origin_mm, volume.direction))

def changed(volume, ostium=None, **grid):
    return LumenMask(replace(volume, voxels=volume.voxels > 200, **grid), ostium)

def moved(volume, config):
    return changed(volume, origin_mm=volume.origin_mm + 3.0)

def coarser(volume, config):
    return changed(volume, spacing_mm=1.2 * volume.spacing_mm)

def turned(volume, config):
    return changed(volume, direction=volume.direction @ np.diag([-1.0, -1.0, 1.0]))

def lost(volume, config):
    return changed(volume, Insertion(np.array([0.0, np.nan, 0.0]), np.array([0.0, 0.0, 1.0])))

def flat(volume, config):
    return changed(volume, Insertion(np.zeros(3), np.zeros(3)))

words = "no method"
"""
PLAIN = "plain_method:plain"


@pytest.fixture
def plain_method(tmp_path, monkeypatch):
    """Put a module of methods into the current directory: what is bright is lumen."""
    (tmp_path / "plain_method.py").write_text(_METHOD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("plain_method", None)


def _ball(radius_mm: float = 16.0) -> Volume:
    """Return a ball of blood in fat."""
    grid = empty_grid((30, 30, 30), 2.0, (-29.0, -29.0, -29.0))
    inside = np.linalg.norm(positions(grid), axis=-1) < radius_mm
    return Volume(np.where(inside, BLOOD_HU, -90.0), grid.spacing_mm, grid.origin_mm, grid.direction)


def test_a_method_of_one_s_own_segments_from_a_file_beside_the_user(plain_method):
    mask = segment(_ball(), config=SegmentConfig(method=PLAIN))
    assert mask.method == PLAIN
    np.testing.assert_array_equal(mask.volume.voxels, _ball().voxels > 0)
    with pytest.raises(InputError, match="method: 'plain_method:plain' found no lumen"):
        segment(_ball(), config=SegmentConfig(method=PLAIN, options=("above=500",)))
    function = segment(_ball(), config=SegmentConfig(method="plain_method:above"))
    np.testing.assert_array_equal(function.volume.voxels, mask.volume.voxels)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("voxels", "returned ndarray; return a LumenMask"),
        ("coarse", r"returned bool voxels of shape \(15, 30, 30\); return bool voxels on the volume's grid"),
        ("moved", r"'plain_method:moved' returned a mask on another grid, up to 5.2 mm from the volume's"),
        ("coarser", "returned a mask on another grid"),
        ("turned", "returned a mask on another grid"),
        ("lost", r"'plain_method:lost' returned an ostium of position and direction 0 nan 0 0 0 1"),
        ("flat", "returned an ostium of position and direction 0 0 0 0 0 0"),
        ("words", "is no function and no SegmentationMethod"),
        ("missing", "plain_method.py holds no missing"),
    ],
)
def test_a_method_that_returns_no_mask_of_the_volume_is_refused(plain_method, name, expected):
    with pytest.raises(InputError, match=expected):
        segment(_ball(), config=SegmentConfig(method=f"plain_method:{name}"))


def test_a_method_says_whether_the_volume_must_hold_contrast(plain_method):
    grid = empty_grid((20, 20, 20), 1.0, (0.0, 0.0, 0.0))
    grid.voxels[:] = -90
    grid.voxels[8:12, 8:12, 8:12] = 300  # 0.06 ml
    with pytest.raises(InputError, match="no contrast"):
        segment(grid, config=SegmentConfig(method=PLAIN))
    with pytest.raises(InputError, match="begins 0 mm from the volume's edge"):  # it ran: its ostium is a corner
        segment(grid, config=SegmentConfig(method="plain_method:head"))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"method": "magic"}, "method: 'magic'; choose from aorta, coronary, nnunet, totalsegmentator, or give MODULE"),
        ({"seeds": ((0.0, float("nan"), 0.0),)}, r"seeds\[0\]\[1\]: nan; give a finite number"),
        ({"options": ("device=cpu",)}, "no setting of method 'coronary'; leave --options out"),
        ({"method": PLAIN, "options": ("below=3",)}, r"'below=3' is no setting of method '.*:plain'; give above=…"),
        ({"method": PLAIN, "options": ("above",)}, "'above' is no setting"),
    ],
)
def test_a_bad_configuration_is_refused(plain_method, values, expected):
    with pytest.raises(InputError, match=expected):
        SegmentConfig(**values)


def test_a_seed_outside_the_volume_is_refused_with_the_volume_s_extent():
    grid = empty_grid((10, 20, 30), (1.0, 2.0, 3.0), (-5.0, 0.0, 100.0))
    grid.voxels[:] = -50
    with pytest.raises(InputError, match=r"outside the volume.*x -5…24, y 0…38, z 100…127"):
        segment(grid, config=SegmentConfig(seeds=((0.0, 50.0, 110.0),)))


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
    with pytest.raises(InputError, match=r"not taken: the mask holds 2 labels \(1, 2\); choose one"):
        segment(ct, config=SegmentConfig(method="nnunet", options=(model,)))
    mask = segment(ct, config=SegmentConfig(method="nnunet", options=(model, "label=2")))
    np.testing.assert_array_equal(mask.volume.voxels, ct.voxels > 300)
    with pytest.raises(InputError, match="no voxel has label 3"):
        segment(ct, config=SegmentConfig(method="nnunet", options=(model, "label=3")))


def test_nnunet_without_a_model_is_refused(ct):
    with pytest.raises(InputError, match=r"holds no trained nnU-Net; give --options model=FOLDER"):
        segment(ct, config=SegmentConfig(method="nnunet", options=("model=/nowhere",)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "program TotalSegmentator is not on the PATH; install TotalSegmentator"),
        (
            "raise SystemExit('ERROR: no licence')",
            "exit code 1: ERROR: no licence; install",
        ),
        ("print('done')", r"wrote no coronary_arteries.nii.gz \(it wrote nothing\)"),
        (_TOTALSEGMENTATOR.format(device="gpu", above=3000), "not taken: the mask is empty"),
        (
            "import sys; open(sys.argv[4] + '/coronary_arteries.nii.gz', 'w').write('x')",
            r"is not taken: .*, or install",
        ),
    ],
    ids=["missing", "fails", "writes nothing", "finds nothing", "writes rubbish"],
)
def test_a_program_that_does_not_answer_is_reported_in_one_line(program, ct, text, expected):
    if text is not None:
        program("TotalSegmentator", text)
    with pytest.raises(InputError, match=expected):
        segment(ct, config=SegmentConfig(method="totalsegmentator"))


def test_an_answer_with_other_voxels_of_the_same_number_is_put_where_it_lies(program, ct):
    factor = 1.15
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
