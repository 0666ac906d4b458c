"""Synthetic CT angiograms: what a voxel holds, where the coronary runs, noise, determinism."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter

from endopilot.anatomy.tree import tangents
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.atlas.curves import curve_through
from endopilot.atlas.heart_reference import TO_CRUX, chamber, fit_heart
from endopilot.errors import InputError
from endopilot.lines import length_along
from endopilot.phantom import chest, metal
from endopilot.phantom.painter import Grid, Painter
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.phantom.scanner import scan
from endopilot.types import Branch, VesselTree

CLEAN = PhantomConfig(
    in_plane_mm=0.6,
    slice_mm=0.8,
    lumen_hu=(400.0, 400.0),
    noise_hu=(0.0, 0.0),
    psf_mm=(0.5, 0.5),
    calcium=0.0,
    margin_mm=12.0,
)
COARSE = PhantomConfig(in_plane_mm=1.0, slice_mm=1.2, margin_mm=10.0, calcium=5.0)


@pytest.fixture(scope="module")
def anatomy():
    return make_patient(AtlasConfig(seed=3, stenosis_share=0.0), 0)


@pytest.fixture(scope="module")
def clean(anatomy):
    return make_phantom(anatomy, config=CLEAN, seed=0)


def at(volume, points):
    """CT numbers at LPS positions, by trilinear interpolation."""
    index = volume.world_to_index(points).T[::-1]
    return map_coordinates(volume.voxels.astype(float), index, order=1, cval=np.nan)


def test_volume_is_int16_hu_around_the_tree(anatomy, clean):
    assert clean.voxels.dtype == np.int16
    np.testing.assert_array_equal(clean.direction, np.eye(3))
    points = np.concatenate([branch.centerline.points for branch in anatomy.tree.branches])
    index = clean.world_to_index(points)
    room = np.array(clean.voxels.shape[::-1]) - 1 - index
    margin = 0.98 * CLEAN.margin_mm / clean.spacing_mm
    assert np.all(index.min(axis=0) > margin) and np.all(room.min(axis=0) > margin - 1)


def test_lumen_has_its_ct_number_from_the_aorta_on_and_every_tissue_is_there(anatomy, clean):
    path = anatomy.tree.longest_path()
    found = at(clean, path.points[path.radius > 1.2])
    assert np.quantile(found, 0.05) > 370 and found.max() < 402
    # Along the vessel: a catheter that meets it at an angle points at its wall.
    (ahead, *_) = tangents(anatomy.tree.branches[0].centerline.points)
    assert at(clean, anatomy.insertion.position + np.linspace(-12.0, 4.0, 40)[:, None] * ahead).min() > 370
    for low, high, share in ((-1025, -700, 0.05), (-100, -75, 0.05), (85, 115, 0.03), (380, 3072, 0.03)):
        assert np.mean((clean.voxels > low) & (clean.voxels < high)) > share


def test_artery_runs_in_fat(anatomy, clean):
    path = anatomy.tree.longest_path()
    away = (path.abscissa > 8) & (path.radius > 0.8)
    origins = np.array([branch.centerline.points[-1] for branch in anatomy.tree.branches])
    near = np.linalg.norm(path.points[:, None] - origins, axis=2).min(axis=1) < 9
    chosen = np.flatnonzero(away & ~near)[::4]
    tangent = np.gradient(path.points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    shell = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        out = np.cos(angle) * path.normals + np.sin(angle) * np.cross(tangent, path.normals)
        shell.append(at(clean, (path.points + (path.radius + 1.6)[:, None] * out)[chosen]))
    shell = np.array(shell)
    assert np.median(shell) < -40
    # No blood pool or vein touches the lumen: the contrasted ones have 120 HU or more.
    assert np.mean(shell > 120) < 0.02


def test_partial_volume_of_a_sphere():
    axis = np.arange(-5.0, 5.0, 0.4)
    grid = Grid(axis + 0.13, axis - 0.07, axis + 0.02)
    painter = Painter(grid, grid, in_plane_mm=0.4, slice_mm=0.4)
    distance = np.sqrt(grid.z[:, None, None] ** 2 + grid.y[:, None] ** 2 + grid.x**2)
    image = np.zeros(grid.shape, dtype=np.float32)
    painter.paint(image, (1.5 - distance).astype(np.float32), 1.0)
    assert image.sum() * 0.4**3 == pytest.approx(4 / 3 * np.pi * 1.5**3, rel=0.02)
    assert np.mean((image > 0.05) & (image < 0.95)) * grid.x.size**3 / np.sum(image) > 0.1


def test_a_seed_and_a_configuration_decide_every_voxel(anatomy):
    usual, same, other, asked, full = (
        make_phantom(anatomy, config=replace(COARSE, **change), seed=seed)
        for seed, change in ((1, {}), (1, {}), (2, {}), (1, {"voxels": (90, 80, 70)}), (1, {"right_heart": (0.9, 0.9)}))
    )
    np.testing.assert_array_equal(usual.voxels, same.voxels)
    assert np.quantile(usual.voxels, 0.99) != np.quantile(other.voxels, 0.99)
    assert asked.voxels.shape == (70, 80, 90)
    middles = [v.index_to_world((np.array(v.voxels.shape[::-1]) - 1) / 2) for v in (usual, asked)]
    np.testing.assert_allclose(*middles, atol=1.2)
    assert np.mean(full.voxels > 250) > 1.15 * np.mean(usual.voxels > 250)


def test_soft_plaque_lies_around_a_stenosis():
    ill = make_patient(AtlasConfig(seed=3, stenosis_share=1.0), 1)
    (stenosis,) = ill.provenance["stenoses"]
    path = ill.tree.longest_path()
    here = int(np.searchsorted(path.abscissa, stenosis["abscissa_mm"]))
    thick = replace(CLEAN, in_plane_mm=0.6, slice_mm=1.0)
    volume = make_phantom(ill, config=thick, seed=0)
    bare = make_phantom(replace(ill, provenance={}), config=thick, seed=0)
    tangent = path.points[here + 1] - path.points[here - 1]
    side = np.cross(tangent / np.linalg.norm(tangent), path.normals[here])
    ring = path.points[here] + (path.radius[here] + 0.8) * np.array(
        [path.normals[here], -path.normals[here], side, -side]
    )
    assert np.mean(at(volume, ring)) > np.mean(at(bare, ring)) + 30


def test_a_tree_without_section_labels_is_accepted(anatomy):
    branches = tuple(Branch(b.centerline, b.parent, np.zeros_like(b.section)) for b in anatomy.tree.branches)
    bare = replace(anatomy, tree=VesselTree(branches, ("vessel",)), provenance={})
    volume = make_phantom(bare, config=COARSE, seed=0)
    assert np.mean(at(volume, anatomy.tree.branches[0].centerline.points)) > 200


def test_a_moving_heart_is_smeared_and_the_chest_is_not(anatomy):
    quiet = replace(CLEAN, in_plane_mm=1.0, slice_mm=1.0)
    still, moved = (make_phantom(anatomy, config=replace(quiet, motion_mm=way), seed=4) for way in (0.0, 4.0))
    change = np.abs(moved.voxels.astype(int) - still.voxels)
    lung = maximum_filter(still.voxels, 9) < -700  # farther from the heart than the point-spread function reaches
    assert lung.sum() > 1000 and change[lung].max() == 0
    path = anatomy.tree.longest_path()
    before, after = at(still, path.points), at(moved, path.points)
    assert np.nanmedian(after) < np.nanmedian(before) - 15
    # The truth is the mean place: the artery is still the brightest near its axis.
    beside = at(moved, path.points + (path.radius + 3.0)[:, None] * path.normals)
    assert np.mean(after > beside + 50) > 0.9


@pytest.fixture(scope="module")
def left():
    return make_patient(AtlasConfig(vessel="lca", seed=1000), 1)


def test_a_left_tree_leaves_the_aorta_and_runs_on_its_own_heart(left):
    volume = make_phantom(left, config=replace(CLEAN, in_plane_mm=0.7, slice_mm=1.0), seed=0)
    steps = np.linspace(-10.0, 2.0, 40)
    assert at(volume, left.insertion.position + steps[:, None] * left.insertion.direction).min() > 350
    for path in chest.main_paths(left.tree):
        wide = path.radius > 1.2
        assert np.quantile(at(volume, path.points[wide]), 0.1) > 320
    heart = chest.place(left.tree)
    assert abs(chamber(heart.to_reference(left.insertion.position[None]), "aorta")[0]) < 0.3
    (right,) = chest.other_coronary(heart, left.tree)
    inside = np.all((volume.world_to_index(right.points) > 0), axis=1)
    assert np.median(at(volume, right.points[inside][:40])) > 300


def test_fit_recovers_a_moved_heart():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    course = curve_through(TO_CRUX)
    moved = np.array([10.0, -20, 30]) + 1.2 * course @ turn.T
    heart = fit_heart(moved, float(length_along(moved)[-1]), "3")
    np.testing.assert_allclose(heart.to_reference(moved), course, atol=0.2)
    np.testing.assert_allclose(heart.from_reference(course), moved, atol=0.3)
    assert heart.scale == pytest.approx(1.2, rel=1e-2)
    assert abs(chamber(heart.to_reference(moved[:1]), "aorta")[0]) < 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise_hu": (50.0, 20.0)}, "noise_hu"),
        ({"voxels": (512, 512, 3)}, "voxels"),
    ],
)
def test_a_bad_configuration_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        PhantomConfig(**options)


QUIET = replace(CLEAN, in_plane_mm=0.9, slice_mm=1.2)  # what real scans show and clean phantoms do not, when asked for


@pytest.fixture(scope="module")
def other():
    return make_patient(AtlasConfig(seed=1003, stenosis_share=0.0), 0)


@pytest.fixture(scope="module")
def quiet(other):
    return make_phantom(other, config=QUIET, seed=2)


def test_the_heart_jumps_by_the_step_between_slabs_and_the_chest_stays(other, quiet):
    moved = make_phantom(other, config=replace(QUIET, step_mm=6.0, slab_mm=24.0), seed=2)
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


def test_calcium_blooms_over_the_lumen(other):
    ill = replace(QUIET, calcium=6.0)
    plain, bloomed = (make_phantom(other, config=replace(ill, blooming_mm=b), seed=7).voxels for b in (0.0, 0.8))
    bright = [np.count_nonzero(voxels > 520) for voxels in (plain, bloomed)]
    assert bright[1] > 1.5 * bright[0] > 0
    assert bloomed.max() <= 1250


def test_a_stent_is_a_bright_tube_around_the_lumen(other, quiet):
    stented = make_phantom(other, config=replace(QUIET, stents=1), seed=2)
    change = stented.voxels.astype(int) - quiet.voxels
    places = quiet.index_to_world(np.argwhere(change > 250)[:, ::-1].astype(float))
    path = other.tree.longest_path()
    distance = np.linalg.norm(places[:, None] - path.points, axis=2)
    nearest = distance.argmin(axis=1)
    assert len(places) > 50
    assert 13.0 < np.ptp(path.abscissa[nearest]) < 29.0
    assert np.abs(distance.min(axis=1) - path.radius[nearest]).max() < 1.5


def test_a_lead_runs_through_the_right_heart_and_draws_streaks(other, quiet):
    wired = make_phantom(other, config=replace(QUIET, leads=1), seed=2)
    heart = chest.place(other.tree)
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


def test_bright_veins_touch_the_artery(other, quiet):
    bright = make_phantom(other, config=replace(QUIET, veins=0.9), seed=2)
    change = bright.voxels.astype(int) - quiet.voxels
    places = quiet.index_to_world(np.argwhere(change > 120)[:, ::-1].astype(float))
    path = other.tree.longest_path()
    gap = np.array([(np.linalg.norm(path.points - p, axis=1) - path.radius).min() for p in places])
    assert np.count_nonzero(gap < 1.5) > 30


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


def test_what_disturbs_leaves_the_scanner_and_the_noise_as_they_are(other):
    noisy = replace(QUIET, noise_hu=(20.0, 40.0), lumen_hu=(300.0, 500.0), calcium=3.0)
    plain = make_phantom(other, config=noisy, seed=4).voxels.astype(int)
    change = make_phantom(other, config=replace(noisy, stents=1, veins=0.8), seed=4).voxels - plain
    assert np.mean(change == 0) > 0.9 and np.abs(change).max() > 100
