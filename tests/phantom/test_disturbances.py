"""What real scans show and clean phantoms do not: each is there when asked for, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.phantom import chest, metal
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.phantom.scanner import scan

QUIET = PhantomConfig(
    in_plane_mm=0.9,
    slice_mm=1.2,
    lumen_hu=(400.0, 400.0),
    noise_hu=(0.0, 0.0),
    psf_mm=(0.5, 0.5),
    calcium=0.0,
    margin_mm=12.0,
)


@pytest.fixture(scope="module")
def anatomy():
    return make_patient(AtlasConfig(seed=1003, stenosis_share=0.0), 0)


@pytest.fixture(scope="module")
def quiet(anatomy):
    return make_phantom(anatomy, config=QUIET, seed=2)


def at(volume, points):
    """CT numbers at LPS positions, by trilinear interpolation."""
    index = volume.world_to_index(points).T[::-1]
    return map_coordinates(volume.voxels.astype(float), index, order=1, cval=np.nan)


def test_the_heart_jumps_by_the_step_between_slabs_and_the_chest_stays(anatomy, quiet):
    moved = make_phantom(anatomy, config=replace(QUIET, step_mm=6.0, slab_mm=24.0), seed=2)
    change = np.abs(moved.voxels.astype(int) - quiet.voxels)
    lung = maximum_filter(quiet.voxels, 9) < -700
    assert lung.sum() > 1000 and change[lung].max() == 0
    # Where slabs meet, the image changes more from slice to slice.
    jump = np.abs(np.diff(moved.voxels.astype(float), axis=0)).mean(axis=(1, 2))
    usual = np.abs(np.diff(quiet.voxels.astype(float), axis=0)).mean(axis=(1, 2))
    steps = np.flatnonzero(jump > usual + 0.5 * (jump - usual).max())
    apart = np.diff(steps[np.append(True, np.diff(steps) > 1)])
    assert len(apart) >= 2 and np.abs(apart - 24.0 / QUIET.slice_mm).max() <= 1


def test_grain_is_coarser_at_equal_standard_deviation():
    noise = []
    for grain_mm in (0.0, 1.2):
        image = np.zeros((40, 60, 60), dtype=np.float32)
        scan(image, (0.5, 0.4, 0.4), 0.6, 30.0, grain_mm, np.random.default_rng(0))
        noise.append(image[6:-6, 8:-8, 8:-8])
    for image in noise:
        assert image.std() == pytest.approx(30.0, rel=0.04)
    neighbours = [np.corrcoef(image[:, :, 2:].ravel(), image[:, :, :-2].ravel())[0, 1] for image in noise]
    # Two voxels of 0.4 mm apart, noise of width w at half height correlates as exp(-2 ln 2 (0.8 / w)²).
    for found, width in zip(neighbours, (0.6, np.hypot(0.6, 1.2)), strict=True):
        assert found == pytest.approx(np.exp(-2 * np.log(2) * (0.8 / width) ** 2), abs=0.03)


def test_calcium_blooms_over_the_lumen(anatomy):
    ill = replace(QUIET, calcium=6.0)
    plain, bloomed = (make_phantom(anatomy, config=replace(ill, blooming_mm=b), seed=7).voxels for b in (0.0, 0.8))
    bright = [np.count_nonzero(voxels > 520) for voxels in (plain, bloomed)]
    assert bright[1] > 1.5 * bright[0] > 0
    assert bloomed.max() <= 1250


def test_a_stent_is_a_bright_tube_around_the_lumen(anatomy, quiet):
    stented = make_phantom(anatomy, config=replace(QUIET, stents=1), seed=2)
    change = stented.voxels.astype(int) - quiet.voxels
    places = quiet.index_to_world(np.argwhere(change > 250)[:, ::-1].astype(float))
    path = anatomy.tree.longest_path()
    distance = np.linalg.norm(places[:, None] - path.points, axis=2)
    nearest = distance.argmin(axis=1)
    assert len(places) > 50
    assert 13.0 < np.ptp(path.abscissa[nearest]) < 29.0
    assert np.abs(distance.min(axis=1) - path.radius[nearest]).max() < 1.5


def test_a_lead_runs_through_the_right_heart_and_draws_streaks(anatomy, quiet):
    wired = make_phantom(anatomy, config=replace(QUIET, leads=1), seed=2)
    heart = chest.place(anatomy.tree)
    (lead,) = metal.leads(heart, 1)
    index = quiet.world_to_index(lead.points)
    inside = np.all((index > 0) & (index < np.array(quiet.voxels.shape[::-1]) - 1), axis=1)
    assert np.quantile(at(wired, lead.points[inside]), 0.2) > 1000
    change = np.abs(wired.voxels.astype(float) - quiet.voxels)
    k, j, i = np.nonzero(change > 60)
    far = np.stack([i, j, k], axis=1)[::7] * quiet.spacing_mm
    distance = np.array([np.linalg.norm(index[inside][::200] * quiet.spacing_mm - p, axis=1).min() for p in far])
    # Streaks: dark and bright, a few centimetres long.
    assert np.quantile(distance, 0.95) > 8.0
    signed = wired.voxels.astype(int) - quiet.voxels
    assert np.count_nonzero(signed < -100) > 200


def test_bright_veins_touch_the_artery(anatomy, quiet):
    bright = make_phantom(anatomy, config=replace(QUIET, veins=0.9), seed=2)
    change = bright.voxels.astype(int) - quiet.voxels
    places = quiet.index_to_world(np.argwhere(change > 120)[:, ::-1].astype(float))
    path = anatomy.tree.longest_path()
    gap = np.array([(np.linalg.norm(path.points - p, axis=1) - path.radius).min() for p in places])
    assert np.count_nonzero(gap < 1.5) > 30


@pytest.fixture(scope="module")
def left():
    return make_patient(AtlasConfig(vessel="lca", seed=1000), 1)


def test_a_larger_appendage_comes_to_the_left_artery(left):
    usual, larger = (make_phantom(left, config=replace(QUIET, appendage_mm=a), seed=0) for a in (0.0, 5.0))
    more = (larger.voxels.astype(int) - usual.voxels) > 150
    assert np.count_nonzero(more) * usual.spacing_mm.prod() > 1500.0
    lumen = np.concatenate([b.centerline.points for b in left.tree.branches])
    index = np.round(usual.world_to_index(lumen)).astype(int).T[::-1]
    assert not more[tuple(index)].any()


def test_a_graft_joins_the_aorta_to_the_artery(left):
    volume = make_phantom(left, config=replace(QUIET, graft=True), seed=0)
    graft = chest.bypass_graft(chest.place(left.tree), left.tree)
    assert np.quantile(at(volume, graft.points[5:-5]), 0.1) > 330
    path = chest.main_paths(left.tree)[0]
    assert np.linalg.norm(path.points - graft.points[-1], axis=1).min() < 0.1
    assert graft.points[0, 2] > left.insertion.position[2] + 12.0
    middle = graft.points[len(graft.points) // 2]
    assert np.linalg.norm(path.points - middle, axis=1).min() > 8.0


def test_what_disturbs_leaves_the_scanner_and_the_noise_as_they_are(anatomy):
    noisy = replace(QUIET, noise_hu=(20.0, 40.0), lumen_hu=(300.0, 500.0), calcium=3.0)
    plain = make_phantom(anatomy, config=noisy, seed=4).voxels.astype(int)
    change = make_phantom(anatomy, config=replace(noisy, stents=1, veins=0.8), seed=4).voxels - plain
    assert np.mean(change == 0) > 0.9 and np.abs(change).max() > 100
