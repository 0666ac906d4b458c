from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shapes import BLOOD_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.errors import InputError
from endopilot.imaging.grid import interpolate_like
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.types import Volume

_SAMPLE = Path(__file__).parents[2].parent / "shared" / "data" / "cta_thorax"

DESCENDING, ASCENDING = (30.0, 0.0, -38.0), (-30.0, 0.0, -38.0)


@pytest.fixture(scope="module")
def arch():
    """Return a scan of an arch of radius 30 mm and lumen radius 10 mm with legs, a chamber beside it and a branch."""
    grid = empty_grid((56, 44, 60), (2.0, 2.0, 2.0), (-59.0, -43.0, -50.0))
    turn = np.linspace(0, np.pi, 200)
    bow = np.stack([30 * np.cos(turn), 0 * turn, 30 * np.sin(turn)], axis=1)
    leg = np.linspace(-60.0, 0.0, 120)[:, None] * [0.0, 0.0, 1.0]
    line = np.concatenate([leg + np.array([30.0, 0.0, 0.0]), bow, leg[::-1] - np.array([30.0, 0.0, 0.0])])
    aorta = inside_tube(grid, line, 10.0)
    wall = inside_tube(grid, line, 12.0) & ~aorta
    chamber = np.linalg.norm(positions(grid) - [0.0, -22.0, -25.0], axis=-1) < 26.0
    branch = inside_tube(grid, np.linspace(0, 1, 60)[:, None] * [0.0, 0.0, 40.0] + [0.0, 0.0, 30.0], 3.0)
    hu = np.full(grid.voxels.shape, 40.0)
    hu[chamber | branch] = BLOOD_HU
    hu[wall] = 50.0
    # A leak: the wall between the chamber and the descending leg is missing over a few voxels.
    leak = np.linalg.norm(positions(grid) - [20.0, -6.0, -20.0], axis=-1) < 4.0
    hu[aorta | leak] = BLOOD_HU
    return scan(grid, hu, blur_mm=0.7), aorta


def test_the_arch_is_found_and_leaks_and_branches_are_cut(arch):
    volume, aorta = arch
    mask = segment(volume, config=SegmentConfig(method="aorta", seeds=(DESCENDING, ASCENDING)))
    between = positions(volume)[..., 2] > -36.0
    assert dice(mask.volume.voxels & between, aorta & between) > 0.93
    far = np.linalg.norm(positions(volume) - [0.0, -22.0, -25.0], axis=-1) < 18.0
    assert not (mask.volume.voxels & far).any()
    assert not (mask.volume.voxels & (positions(volume)[..., 2] > 48.0)).any()
    assert mask.ostium is not None
    np.testing.assert_allclose(mask.ostium.position, DESCENDING, atol=4.0)
    assert mask.ostium.direction[2] > 0.9
    assert not (mask.volume.voxels & (positions(volume)[..., 2] < -46.0)).any()


def test_the_mask_lies_on_the_grid_of_any_orientation(arch):
    volume, _ = arch
    turned = Volume(
        np.ascontiguousarray(volume.voxels.transpose(2, 0, 1)[:, ::-1]),
        volume.spacing_mm[[1, 2, 0]],
        volume.index_to_world(np.array([0.0, 0.0, volume.voxels.shape[0] - 1])),
        volume.direction[:, [1, 2, 0]] * [1, -1, 1],
    )
    straight = segment(volume, config=SegmentConfig(method="aorta", seeds=(DESCENDING, ASCENDING)))
    again = segment(turned, config=SegmentConfig(method="aorta", seeds=(DESCENDING, ASCENDING)))
    back = again.volume.voxels[:, ::-1].transpose(1, 2, 0)
    assert dice(back, straight.volume.voxels) > 0.99


def test_seeds_that_cannot_be_used_are_refused(arch):
    volume, _ = arch
    for seeds, expected in {
        (): "needs one or two points",
        ((40.0, 30.0, 30.0),): r"\d+ HU around \(40.0, 30.0, 30.0\).*130 or more",
        (DESCENDING, DESCENDING): "lie at one place; put them farther apart",
        (DESCENDING,): "joined to one of radius 2[0-9] mm.*second seed",
    }.items():
        with pytest.raises(InputError, match=expected):
            segment(volume, config=SegmentConfig(method="aorta", seeds=seeds))


def test_seeds_in_separate_vessels_are_refused():
    grid = empty_grid((30, 30, 40), 2.0, (0.0, 0.0, 0.0))
    along = np.linspace(-10, 80, 200)[:, None] * [0.0, 0.0, 1.0]
    hu = np.full(grid.voxels.shape, 40.0)
    for x in (20.0, 60.0):
        hu[inside_tube(grid, along + np.array([x, 30.0, 0.0]), 8.0)] = BLOOD_HU
    with pytest.raises(InputError, match="no contrast-filled path"):
        segment(scan(grid, hu), config=SegmentConfig(method="aorta", seeds=((20.0, 30.0, 10.0), (60.0, 30.0, 10.0))))


def test_one_seed_follows_a_plain_vessel_to_its_far_end():
    grid = empty_grid((40, 30, 30), 2.0, (0.0, 0.0, 0.0))
    line = np.linspace(6, 70, 200)[:, None] * [0.0, 0.0, 1.0] + [30.0, 28.0, 0.0]
    tube = inside_tube(grid, line, 9.0)
    volume = scan(grid, np.where(tube, BLOOD_HU, 40.0))
    mask = segment(volume, config=SegmentConfig(method="aorta", seeds=((30.0, 28.0, 8.0),)))
    between = (positions(volume)[..., 2] > 14.0) & (positions(volume)[..., 2] < 68.0)
    assert dice(mask.volume.voxels & between, tube & between) > 0.93


@pytest.mark.skipif(not _SAMPLE.exists(), reason="the real thoracic CTA is not here (endopilot sample cta-thorax)")
def test_the_real_aorta_agrees_with_the_network_s_mask():
    """The network also marks the false lumen where no contrast reaches it, which is cut off here."""
    volume = read_volume(_SAMPLE / "cta_thorax_1p5mm.nii.gz")
    given = read_mask(_SAMPLE / "seg_aorta.nii.gz").volume
    given = Volume(given.voxels.astype(np.float32), given.spacing_mm, given.origin_mm, given.direction)
    reference = interpolate_like(given, volume, outside=0.0) > 0.5
    mask = segment(volume, config=SegmentConfig(method="aorta", seeds=((2.0, -143.0, 543.0), (2.0, -184.0, 657.0))))
    found = mask.volume.voxels
    assert dice(found, reference) > 0.84
    assert (found & reference).sum() > 0.92 * found.sum()
