"""Contrast, the aorta, and where arteries leave it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shapes import BLOOD_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.errors import InputError
from endopilot.imaging.aortic_root import find_ostium
from endopilot.imaging.segment import SegmentConfig, refuse_without_contrast, segment
from endopilot.imaging.volume import read_volume
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


@pytest.fixture(scope="module")
def lumen(arch):
    return segment(arch[0], config=SegmentConfig(method="aorta", seeds=(DESCENDING, ASCENDING)))


def test_the_arch_is_found_and_leaks_and_branches_are_cut(arch, lumen):
    (volume, aorta), mask = arch, lumen
    between = positions(volume)[..., 2] > -36.0
    assert dice(mask.volume.voxels & between, aorta & between) > 0.93
    far = np.linalg.norm(positions(volume) - [0.0, -22.0, -25.0], axis=-1) < 18.0
    assert not (mask.volume.voxels & far).any()
    assert not (mask.volume.voxels & (positions(volume)[..., 2] > 48.0)).any()
    assert mask.ostium is not None
    np.testing.assert_allclose(mask.ostium.position, DESCENDING, atol=4.0)
    assert mask.ostium.direction[2] > 0.9
    assert not (mask.volume.voxels & (positions(volume)[..., 2] < -46.0)).any()


def test_the_mask_lies_on_the_grid_of_any_orientation(arch, lumen):
    volume, _ = arch
    turned = Volume(
        np.ascontiguousarray(volume.voxels.transpose(2, 0, 1)[:, ::-1]),
        volume.spacing_mm[[1, 2, 0]],
        volume.index_to_world(np.array([0.0, 0.0, volume.voxels.shape[0] - 1])),
        volume.direction[:, [1, 2, 0]] * [1, -1, 1],
    )
    again = segment(turned, config=SegmentConfig(method="aorta", seeds=(DESCENDING, ASCENDING)))
    back = again.volume.voxels[:, ::-1].transpose(1, 2, 0)
    assert dice(back, lumen.volume.voxels) > 0.99


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


@pytest.fixture(scope="module")
def thorax() -> Volume:
    if not _SAMPLE.exists():
        pytest.skip(f"{_SAMPLE} is absent: the real CT angiogram is not part of the repository")
    return read_volume(_SAMPLE / "cta_thorax_1p5mm.nii.gz")


@pytest.mark.parametrize("noise_hu", [40.0])
def test_blood_is_distinguished_from_bone(thorax, noise_hu):
    """The whole thorax holds contrast; a box around ten vertebrae, in front of which the aorta is cut off, does not."""
    noise = np.random.default_rng(0).normal(0.0, noise_hu, thorax.voxels.shape)
    noisy = Volume(thorax.voxels + noise, thorax.spacing_mm, thorax.origin_mm, thorax.direction)
    refuse_without_contrast(noisy)
    corners = noisy.world_to_index(np.array([[-45.0, -122.0, 560.0], [8.0, -70.0, 760.0]])).round().astype(int)
    box = tuple(slice(a, b) for a, b in zip(corners[0, ::-1], corners[1, ::-1], strict=True))
    spine = Volume(noisy.voxels[box], noisy.spacing_mm, noisy.index_to_world(corners[0].astype(float)), noisy.direction)
    assert (spine.voxels > 130).mean() > 0.15  # bone
    with pytest.raises(InputError, match="no contrast: homogeneous soft tissue peaks at"):
        refuse_without_contrast(spine)


@pytest.mark.parametrize("thickness_mm", [4.0, 16.0])
def test_a_thin_slab_of_an_aorta_holds_contrast(thickness_mm):
    """Its cross-section of 7 cm² is that of any pool; its volume is what the slab leaves of it."""
    shape = (round(thickness_mm / 0.5), 160, 160)
    j, i = np.indices(shape[1:]) * 0.4
    inside = np.hypot(j - 32.0, i - 32.0) < 15.0
    noise = np.random.default_rng(0).normal(0.0, 25.0, shape)
    for blood_hu in (400.0, 45.0):
        voxels = (np.where(inside, blood_hu, -90.0) + noise).astype(np.int16)
        slab = Volume(voxels, np.array([0.4, 0.4, 0.5]), np.zeros(3), np.eye(3))
        if blood_hu > 130.0:
            refuse_without_contrast(slab)
            continue
        with pytest.raises(
            InputError, match=rf"only {thickness_mm:.0f} mm thick.*too little to recognise blood"
        ) as caught:
            refuse_without_contrast(slab)
        assert "no contrast" not in str(caught.value)


AORTA_MM, ARTERY_MM, LENGTH_MM = 14.0, 2.8, 20.0


@pytest.mark.parametrize("slant_deg", [0.0, 60.0])
def test_the_ostium_lies_on_the_aortas_wall_and_on_the_arterys_axis(slant_deg):
    grid = empty_grid((110, 90, 130), (0.5, 0.5, 0.5), (-33.0, -22.0, -25.0))
    place = positions(grid)
    slant = np.deg2rad(slant_deg)
    direction = np.array([np.cos(slant), 0.0, np.sin(slant)])  # the aorta's wall passes through the origin, normal to x
    aorta = np.hypot(place[..., 0] + AORTA_MM, place[..., 1]) < AORTA_MM
    along = np.clip(place @ direction, -AORTA_MM, LENGTH_MM)
    artery = np.linalg.norm(place - along[..., None] * direction, axis=-1) < ARTERY_MM
    # The tracked path begins at the artery's edge, where that comes nearest to the aorta.
    begin = 3.0 * direction + 1.2 * ARTERY_MM * np.array([-np.sin(slant), 0.0, np.cos(slant)])
    share = np.linspace(0.0, 1.0, 60)[:, None]
    path = (1 - share) * (begin + share * 12.0 * direction) + share * LENGTH_MM * direction
    ostium, _ = find_ostium(path, aorta | artery, aorta, grid)
    assert np.linalg.norm(ostium.position) < 0.5
    assert ostium.direction @ direction > 0.97
