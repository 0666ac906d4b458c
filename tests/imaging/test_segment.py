from __future__ import annotations

import sys

import numpy as np
import pytest
from shapes import BLOOD_HU, empty_grid, positions

from endopilot.errors import InputError
from endopilot.imaging import segment as segmentation
from endopilot.imaging.segment import METHODS, SegmentConfig, segment
from endopilot.types import Volume

_METHOD = """
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

def moved(volume, config):
    return LumenMask(Volume(volume.voxels > 200, volume.spacing_mm, volume.origin_mm + 3.0, volume.direction))

def coarser(volume, config):
    return LumenMask(Volume(volume.voxels > 200, 1.2 * volume.spacing_mm, volume.origin_mm, volume.direction))

def turned(volume, config):
    turn = np.diag([-1.0, -1.0, 1.0])
    return LumenMask(Volume(volume.voxels > 200, volume.spacing_mm, volume.origin_mm, volume.direction @ turn))

def lost(volume, config):
    nowhere = Insertion(np.array([0.0, np.nan, 0.0]), np.array([0.0, 0.0, 1.0]))
    return LumenMask(Volume(volume.voxels > 200, volume.spacing_mm, volume.origin_mm, volume.direction), nowhere)

def flat(volume, config):
    nowhere = Insertion(np.zeros(3), np.zeros(3))
    return LumenMask(Volume(volume.voxels > 200, volume.spacing_mm, volume.origin_mm, volume.direction), nowhere)

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


def test_every_shipped_method_is_found_by_its_name():
    assert METHODS.names() == ("aorta", "coronary", "nnunet", "totalsegmentator")
    assert all(callable(segmentation._method(name).segment_lumen) for name in METHODS.names())


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
    ("options", "expected"),
    [
        (("below=3",), r"'below=3' is no setting of method 'plain_method:plain'; give above=…"),
        (("above",), "'above' is no setting"),
    ],
)
def test_a_setting_that_a_method_does_not_know_is_refused(plain_method, options, expected):
    with pytest.raises(InputError, match=expected):
        SegmentConfig(method=PLAIN, options=options)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"method": "magic"}, "method: 'magic'; choose from aorta, coronary, nnunet, totalsegmentator, or give MODULE"),
        ({"seeds": ((0.0, float("nan"), 0.0),)}, r"seeds\[0\]\[1\]: nan; give a finite number"),
        ({"options": ("device=cpu",)}, "no setting of method 'coronary'; leave --options out"),
    ],
)
def test_a_bad_configuration_is_refused(values, expected):
    with pytest.raises(InputError, match=expected):
        SegmentConfig(**values)


@pytest.mark.parametrize("method", ["aorta", "coronary"])
def test_a_seed_outside_the_volume_is_refused_with_the_volume_s_extent(method):
    grid = empty_grid((10, 20, 30), (1.0, 2.0, 3.0), (-5.0, 0.0, 100.0))
    grid.voxels[:] = -50
    with pytest.raises(InputError, match=r"outside the volume.*x -5…24, y 0…38, z 100…127"):
        segment(grid, config=SegmentConfig(method=method, seeds=((0.0, 50.0, 110.0),)))


def test_a_lost_rescale_is_refused(plain_method):
    ball = _ball()
    raw = Volume(ball.voxels + 1024, ball.spacing_mm, ball.origin_mm, ball.direction)
    with pytest.raises(InputError, match=r"from 934 to 1424, but fat, lung and air are below 0 HU"):
        segment(raw, config=SegmentConfig(method=PLAIN, seeds=((0.0, 0.0, 0.0),)))


def test_contrast_is_found_by_the_histogram(plain_method):
    """Muscle at 50 HU with bone: a shell of 3 mm and noise fill no millilitre of homogeneous bright tissue."""
    grid = empty_grid((50, 60, 60), 1.0, (0.0, 0.0, 0.0))
    radius = np.linalg.norm(positions(grid) - [30.0, 30.0, 25.0], axis=-1)
    hu = np.where(radius < 22.0, 50.0, -90.0)
    hu[(radius > 17.0) & (radius < 20.0)] = 600.0
    noise = np.random.default_rng(0).normal(0.0, 25.0, hu.shape)
    config = SegmentConfig(method=PLAIN)
    unenhanced = Volume(hu + noise, grid.spacing_mm, grid.origin_mm, grid.direction)
    with pytest.raises(InputError, match=r"no contrast: homogeneous soft tissue peaks at (45|55) HU, .*has 0.\d ml"):
        segment(unenhanced, config=config)
    seeded = segment(unenhanced, config=SegmentConfig(method=PLAIN, seeds=((30.0, 30.0, 25.0),)))
    assert seeded.volume.voxels.any()  # a seed says where blood is
    hu[radius < 15.0] = 200.0
    enhanced = Volume(hu + noise, grid.spacing_mm, grid.origin_mm, grid.direction)
    with pytest.raises(InputError, match="begins 0 mm from the volume's edge"):  # the plain method's ostium is a corner
        segment(enhanced, config=config)


def test_importing_the_stage_loads_no_method():
    assert not hasattr(segmentation, "MCP_Geometric")
