from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from shapes import BLOOD_HU, FAT_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.errors import InputError
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.types import Volume

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
