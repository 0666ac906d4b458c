"""The methods of segmentation: the aorta between seeds, and the coronary arteries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from shapes import BLOOD_HU, FAT_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.errors import InputError
from endopilot.imaging.aortic_root import find_ostium
from endopilot.imaging.segment import SegmentConfig, refuse_without_contrast, segment
from endopilot.imaging.volume import read_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom
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


AORTA_RADIUS_MM, ARC_MM = 13.0, 18.0


def _axis() -> np.ndarray:
    """Return a right coronary: from the ostium at 0 to the front and right, then down by a quarter turn."""
    turn = np.linspace(0, np.pi / 2, 120)
    outward = np.array([-0.6, -0.8, 0.0])
    bend = ARC_MM * (np.sin(turn)[:, None] * outward + (np.cos(turn) - 1)[:, None] * [0.0, 0.0, 1.0])
    down = np.linspace(0.0, 22.0, 80)[1:, None] * [0.0, 0.0, -1.0]
    return np.concatenate([bend, bend[-1] + down])


def _branch() -> np.ndarray:
    start = _axis()[100]
    return start + np.linspace(0, 20, 80)[:, None] * np.array([0.8, -0.6, -0.1])


@pytest.fixture(scope="module")
def heart():
    """Return the scan of an aorta with two coronary arteries, a dim vein and a chamber close by, and the right tree."""
    grid = empty_grid((103, 84, 125), (0.6, 0.6, 0.7), (-25.0, -28.0, -46.0))
    x = positions(grid)
    centre = np.array([0.6, 0.8]) * AORTA_RADIUS_MM
    aorta = np.hypot(x[..., 0] - centre[0], x[..., 1] - centre[1]) < AORTA_RADIUS_MM
    axis, branch = _axis(), _branch()
    tree = inside_tube(grid, axis, np.linspace(1.9, 1.2, len(axis))) | inside_tube(grid, branch, 1.0)
    across = np.array([centre[0], centre[1], 4.0]) + np.linspace(AORTA_RADIUS_MM - 2, 42, 90)[:, None] * [0.97, 0.24, 0]
    vein = inside_tube(grid, _axis()[110:] + np.array([-0.6, -3.8, 0.0]), 1.0)
    chamber = np.linalg.norm(x - [10.0, -16.0, -32.0], axis=-1) < 13.0
    hu = np.full(grid.voxels.shape, FAT_HU)
    hu[np.linalg.norm(x - [10.0, -16.0, -32.0], axis=-1) < 15.0] = 100.0
    hu[chamber] = 300.0
    hu[vein] = 150.0
    hu[inside_tube(grid, np.concatenate([axis, branch]), 1.9 + 0.9)] = FAT_HU
    hu[(np.hypot(x[..., 0] - centre[0], x[..., 1] - centre[1]) < AORTA_RADIUS_MM + 1.2)] = 50.0
    hu[inside_tube(grid, across, 1.8) | tree | aorta] = BLOOD_HU
    return scan(grid, hu, blur_mm=0.26, noise_hu=60.0), tree & ~aorta


@pytest.fixture(scope="module")
def right_tree(heart):
    return segment(heart[0], config=SegmentConfig(vessel="rca"))


def test_the_right_coronary_tree_is_found(heart, right_tree):
    volume, tree = heart
    found = right_tree.volume.voxels
    assert dice(found, tree) > 0.88
    points = positions(volume)[found]
    reached, _ = KDTree(points).query(np.concatenate([_axis()[4:-3], _branch()[4:-3]]))
    assert np.mean(reached < 1.0) > 0.98
    stray, _ = KDTree(np.concatenate([_axis(), _branch()])).query(points)
    assert stray.max() < 3.5


def test_the_ostium_is_within_a_millimetre_and_the_mask_ends_there(heart, right_tree):
    ostium = right_tree.ostium
    assert np.linalg.norm(ostium.position) < 1.0
    assert ostium.direction @ [-0.6, -0.8, 0.0] > 0.95
    behind = (positions(heart[0])[right_tree.volume.voxels] - ostium.position) @ ostium.direction
    assert behind.min() > -0.5


def test_the_left_tree_is_another_one(heart):
    left = segment(heart[0], config=SegmentConfig(vessel="lca"))
    assert left.ostium is not None
    assert left.ostium.position[0] > 15.0
    assert positions(heart[0])[left.volume.voxels][:, 0].min() > 14.0


def test_an_artery_beside_a_chamber_is_not_taken_for_a_part_of_it():
    """A Gaussian of 1 mm closes the fat between them, and another vessel, 36 mm away, is taken for the right artery."""
    patient = make_patient(AtlasConfig(vessel="rca", seed=0, population="textbook"), 0)
    whole = make_phantom(patient, config=PhantomConfig(in_plane_mm=1.0, slice_mm=1.0), seed=0)
    index = whole.world_to_index(patient.tree.line.points)
    low = np.maximum(index.min(axis=0) - 40, 0).astype(int)
    high = index.max(axis=0).astype(int) + 40
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    ct = replace(whole, voxels=whole.voxels[box], origin_mm=whole.index_to_world(low.astype(float)))
    found = segment(ct, config=SegmentConfig(method="coronary", vessel="rca"))
    assert np.linalg.norm(found.ostium.position - patient.insertion.position) < 0.5


def test_a_volume_cut_off_at_zero_is_segmented_with_seeds_and_one_that_lost_its_rescale_is_not(heart, right_tree):
    cut = replace(heart[0], voxels=np.maximum(heart[0].voxels, 0))
    with pytest.raises(InputError, match="give seeds if it was cut off at 0"):
        segment(cut, config=SegmentConfig())
    seeds = (tuple(_axis()[20]), tuple(_branch()[-4]))
    found = segment(cut, config=SegmentConfig(vessel="lca", seeds=seeds)).volume.voxels  # seeds choose the vessel
    assert dice(found, right_tree.volume.voxels) > 0.85
    lost = replace(heart[0], voxels=heart[0].voxels + 1024 - min(int(heart[0].voxels.min()), 0))
    with pytest.raises(InputError, match="as at the seeds: the rescale is lost"):
        segment(lost, config=SegmentConfig(seeds=seeds))


def test_a_seed_serves_where_the_aorta_is_not_in_the_volume(heart, right_tree):
    volume, _ = heart
    bottom = Volume(volume.voxels[:60], volume.spacing_mm, volume.origin_mm, volume.direction)
    lower = segment(bottom, config=SegmentConfig(seeds=(tuple(_axis()[70]),)))
    assert lower.ostium is not None
    assert np.linalg.norm(lower.ostium.position - _axis()[70]) < 2.5
    inside = (positions(bottom) - lower.ostium.position) @ lower.ostium.direction > 1.0
    assert dice(lower.volume.voxels & inside, right_tree.volume.voxels[:60] & inside) > 0.85


def test_voxels_too_coarse_for_coronary_arteries_are_refused_with_their_size(heart):
    thick = Volume(heart[0].voxels[::3], heart[0].spacing_mm * [1.0, 1.0, 3.0], heart[0].origin_mm, heart[0].direction)
    with pytest.raises(InputError, match=r"too coarse for coronary arteries \(2.1 mm; 1.25 mm at most\)"):
        segment(thick, config=SegmentConfig(seeds=((0.0, 0.0, 0.0),)))


def test_a_volume_without_aorta_is_refused():
    grid = empty_grid((60, 60, 60), 1.0, (0.0, 0.0, 0.0))
    ball = np.linalg.norm(positions(grid) - 30.0, axis=-1) < 28.0
    with pytest.raises(InputError, match="ascending aorta was not found"):
        segment(scan(grid, np.where(ball, BLOOD_HU, FAT_HU)), config=SegmentConfig())


def test_an_aorta_without_artery_is_refused():
    grid = empty_grid((50, 60, 60), 1.0, (0.0, 0.0, 0.0))
    x = positions(grid)
    tube = np.hypot(x[..., 0] - 30, x[..., 1] - 30) < AORTA_RADIUS_MM
    volume = scan(grid, np.where(tube, BLOOD_HU, FAT_HU))
    with pytest.raises(InputError, match="vessel='rca': no such artery"):
        segment(volume, config=SegmentConfig())
    with pytest.raises(InputError, match="no vessel"):
        segment(volume, config=SegmentConfig(seeds=((10.0, 10.0, 10.0),)))


def changed(volume, where, hu):
    voxels = volume.voxels.copy()
    voxels[where] = hu
    return Volume(voxels, volume.spacing_mm, volume.origin_mm, volume.direction)


def test_what_comes_to_a_chamber_below_the_aorta_is_no_coronary_tree(heart):
    x = positions(heart[0])
    along, across = x[..., 0] * 0.6 + x[..., 1] * 0.8, x[..., 0] * 0.8 - x[..., 1] * 0.6
    below = (along > 0.5) & (along < 40.0) & (x[..., 2] < 8.0)
    flat = changed(heart[0], below & (np.abs(across) < 16.0), 50.0)
    flat = changed(flat, below & (np.abs(across) < 5.0), BLOOD_HU)
    with pytest.raises(InputError, match=r"no such artery .* holds the aortic root"):
        segment(flat, config=SegmentConfig(vessel="rca"))


def test_a_stump_is_no_coronary_tree(heart):
    with pytest.raises(InputError, match="no such artery"):
        segment(changed(heart[0], positions(heart[0])[..., 0] > 36.0, FAT_HU), config=SegmentConfig(vessel="lca"))


@pytest.fixture(scope="module")
def two_trunks():
    """Return an aorta with an artery, and a pulmonary trunk: as bright, wider, and the artery passes 2 mm in front."""
    grid = empty_grid((72, 104, 87), 0.75, (-20.0, -50.0, -36.0))
    x = positions(grid)
    aorta, trunk = (
        np.hypot(x[..., 0] - middle[0], x[..., 1] - middle[1]) - radius
        for middle, radius in (((7.8, 10.4), AORTA_RADIUS_MM), ((22.0, -26.0), 16.0))
    )
    corners = [[0, 0, 0], [-7, -10, -2], [-5, -26, -6], [2, -38, -12], [9.3, -41.2, -20], [22, -46, -34]]
    hu = np.where(np.minimum(aorta, trunk) < 1.2, 50.0, FAT_HU)
    hu[(aorta < 0) | (trunk < 0) | _through(grid, corners)] = BLOOD_HU
    return grid, hu


def _through(grid, corners):
    """Return where voxels lie in an artery through the corners."""
    places = np.linspace(0, len(corners) - 1, 300)
    axis = [np.interp(places, np.arange(len(corners)), column) for column in np.array(corners, dtype=float).T]
    return inside_tube(grid, np.stack(axis, axis=1), 1.6)


RIVAL = "two vessels may be the ascending aorta"


def test_a_pulmonary_trunk_as_bright_as_the_aorta_is_not_taken_for_it(two_trunks):
    grid, hu = two_trunks
    found = segment(scan(grid, hu, blur_mm=0.4, noise_hu=20.0), config=SegmentConfig(vessel="rca"))
    assert found.ostium is not None
    assert np.linalg.norm(found.ostium.position) < 1.5
    assert not any(RIVAL in told for told in found.warnings)


def test_a_second_trunk_that_an_artery_opens_into_is_told(two_trunks):
    grid, hu = two_trunks
    both = np.where(_through(grid, [[12.5, -37, 8], [4, -45, 9], [-12, -40, 10], [-17, -15, 10]]), BLOOD_HU, hu)
    found = segment(scan(grid, both, blur_mm=0.4, noise_hu=20.0), config=SegmentConfig(vessel="rca"))
    assert sum(RIVAL in told for told in found.warnings) == 1
