"""Doubts about a coronary tree: each is told where it should be, and a clean tree raises none."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from shapes import BLOOD_HU, FAT_HU, empty_grid, inside_tube, positions, scan

from endopilot.imaging.coronary_doubts import FoundTree, _steps, coronary_doubts
from endopilot.types import Volume

STEP = 0.5


def taper(begin_mm, end_mm, points):
    return np.linspace(begin_mm, end_mm, len(points))


def line(start, end):
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    count = int(np.linalg.norm(end - start) / STEP) + 1
    return np.linspace(start, end, count)


@pytest.fixture(scope="module")
def found():
    """Return a right artery of 70 mm that leaves an aorta at x = 13 mm, and tapers from 2 to 0.7 mm."""
    grid = empty_grid((66, 58, 200), 0.6, (-16.2, -17.4, -5.4))
    x = positions(grid)
    aorta = np.hypot(x[..., 0], x[..., 1]) < 13.0
    path = line((13.0, 0.0, 6.0), (82.9, 0.0, 6.0))
    tree = inside_tube(grid, path, taper(2.0, 0.7, path)) & ~aorta
    hu = np.full(grid.voxels.shape, FAT_HU)
    hu[aorta | tree] = BLOOD_HU
    volume = scan(grid, hu)
    return FoundTree(
        volume=scan(grid, np.where(aorta, BLOOD_HU, FAT_HU)),
        grid=volume,
        hu=volume.voxels.astype(np.float32),
        lumen_hu=BLOOD_HU,
        pools=aorta,
        response=np.zeros(grid.voxels.shape, dtype=np.float32),
        vessels=tree,
        aorta=aorta,
        tree=tree,
        ostium=path[0],
        paths=[path],
        radius=[taper(2.0, 0.7, path)],
        lumen=tree,
    )


def with_vessel(found, path, radius_mm, hu=BLOOD_HU, *, in_tree=False):
    """Add a vessel to the volume and to the vessels; its paths stay as they are."""
    inside = inside_tube(found.volume, path, radius_mm)
    voxels = found.grid.voxels.copy()
    voxels[inside & ~found.tree] = hu
    return replace(
        found,
        grid=replace(found.grid, voxels=voxels),
        hu=voxels.astype(np.float32),
        vessels=found.vessels | (inside & ~found.aorta),
        tree=found.tree | (inside & ~found.aorta) if in_tree else found.tree,
    )


def test_ends_that_are_wide_are_told_but_neither_a_clean_tree_a_stub_nor_a_vessel_beside_the_ostium(found):
    (told,) = coronary_doubts(replace(found, radius=[taper(2.0, 1.6, found.paths[0])]), "rca")
    assert "ends at (82.9, 0.0, 6.0) mm while it is still 3.2 mm wide" in told
    stub = line((14.0, 0.0, 6.0), (14.0, 6.0, 6.0))
    bumpy = replace(found, paths=[*found.paths, stub], radius=[*found.radius, np.full(len(stub), 1.9)])
    conus = line((12.0, 0.0, 14.0), (60.0, 0.0, 14.0))
    assert coronary_doubts(with_vessel(bumpy, conus, 1.2), "rca") == ()


def test_a_vessel_that_goes_on_behind_a_gap_is_told_and_one_that_passes_by_is_not(found):
    beside = line((50.0, 6.0, 6.0), (81.0, 6.0, 6.0))
    assert coronary_doubts(with_vessel(found, beside, 0.8), "rca") == ()
    path = found.paths[0][:-12]
    cut = replace(
        found, paths=[path], radius=[taper(2.0, 0.8, path)], tree=found.tree & (positions(found.volume)[..., 0] < 77)
    )
    ahead = line((80.0, 1.0, 6.0), (98.0, 4.0, 6.0))
    (told,) = coronary_doubts(with_vessel(replace(cut, vessels=cut.tree), ahead, 0.8), "rca")
    assert told.startswith("a vessel ends at (76.9, 0.0, 6.0) mm and seems to go on behind a gap")
    assert coronary_doubts(with_vessel(replace(cut, vessels=cut.tree), ahead, 0.8, 0.5 * BLOOD_HU), "rca") == ()


def test_a_short_tree_and_a_left_tree_of_one_vessel_are_told(found):
    short = replace(found, paths=[found.paths[0][:100]], radius=[taper(2.0, 0.7, found.paths[0][:100])])
    (told,) = coronary_doubts(short, "rca")
    assert "the tree ends 50 mm from its ostium" in told or "the tree ends 49 mm" in told
    (told,) = coronary_doubts(found, "lca")
    assert "the LAD or the LCx is missing" in told
    second = found.paths[0][40:]
    both = replace(found, paths=[found.paths[0], second], radius=[*found.radius, taper(1.0, 0.7, second)])
    assert coronary_doubts(both, "lca") == ()


@pytest.mark.parametrize(("joined", "ending"), [(True, "is part of the mask"), (False, "is not part of the mask")])
def test_a_bypass_graft_is_told(found, joined, ending):
    graft = line((12.0, 0.0, 24.0), (60.0, 0.0, 24.0))
    if joined:
        graft = np.concatenate([graft, line((60.0, 0.0, 24.0), (60.0, 0.0, 6.0))])
    (told,) = coronary_doubts(with_vessel(found, graft, 1.8, in_tree=joined), "rca")
    assert re.search(r"1[789] mm above the ostium: probably a bypass graft", told) and told.endswith(ending)


def test_calcium_at_which_the_mask_ends_is_told_once(found):
    x = positions(found.volume)[..., 0]
    plaque = inside_tube(found.volume, line((49.0, 0.0, 6.0), (52.0, 0.0, 6.0)), 1.5)
    ill = replace(found, volume=replace(found.volume, voxels=np.where(plaque, 3.0 * BLOOD_HU, found.volume.voxels)))
    branch = line((47.0, 0.0, 6.0), (47.0, 30.0, 6.0))
    both = replace(ill, paths=[*ill.paths, branch], radius=[*ill.radius, taper(1.0, 0.7, branch)])
    (told,) = coronary_doubts(replace(both, lumen=found.tree & (x < 50)), "rca")
    assert told.startswith("calcium or metal fills a vessel at (49.7, 0.0, 6.0) mm: the mask ends there, and 33 mm of")
    assert coronary_doubts(ill, "rca") == ()  # the mask goes on behind it
    assert coronary_doubts(replace(found, lumen=found.tree & (x < 50)), "rca") == ()  # nothing fills it
    end = replace(found.volume, voxels=np.where(x > 74, 3.0 * BLOOD_HU, found.volume.voxels))
    assert coronary_doubts(replace(found, volume=end, lumen=found.tree & (x < 76)), "rca") == ()  # a thin end's mask


@pytest.mark.parametrize(("vessel", "told"), [("rca", 0), ("lca", 1)])
def test_the_left_artery_leaves_the_aorta_above_the_right_one(found, vessel, told):
    other = line((-12.0, 0.0, 26.0), (-15.0, 0.0, 26.0))
    other = np.concatenate([other, line((-15.0, 0.0, 26.0), (-14.0, 16.0, 26.0))])
    doubts = coronary_doubts(with_vessel(found, other, 1.8), vessel)
    assert sum("bypass graft" in doubt for doubt in doubts) == told


def test_a_vein_in_the_tree_is_told(found):
    vein = line((60.0, 0.0, 6.0), (60.0, 16.0, 20.0))
    dim = with_vessel(found, vein, 1.6, 0.6 * BLOOD_HU, in_tree=True)
    dim = replace(dim, paths=[*dim.paths, vein], radius=[*dim.radius, taper(1.6, 1.2, vein)])
    (told,) = coronary_doubts(dim, "rca")
    assert f"has {0.6 * BLOOD_HU:.0f} HU where the lumen has {BLOOD_HU:.0f}" in told


def test_metal_beside_the_tree_is_told_and_calcium_is_not(found):
    spot = line((40.0, 3.5, 6.0), (46.0, 3.5, 6.0))
    assert coronary_doubts(with_vessel(found, spot, 1.0, 1200.0, in_tree=True), "rca") == ()
    (told,) = coronary_doubts(with_vessel(found, spot, 1.0, 3000.0, in_tree=True), "rca")
    assert told.startswith("metal 0 mm from the vessel")


@pytest.mark.parametrize("spacing", [(0.4, 0.4, 0.5), (0.5, 0.5, 1.2)])
def test_steps_are_told_with_their_place(spacing):
    grid = empty_grid((60, 120, 120), spacing, (0.0, 0.0, 100.0))
    x = positions(grid)
    middle = np.array([24.0, 24.0]) + 0.15 * (x[..., 2:] - 110.0)
    jump = np.where(x[..., 2:] > 115.0, 2.0, 0.0)
    for moved, expected in ((middle, 0), (middle + jump, 1)):
        hu = np.where(np.linalg.norm(x[..., :2] - moved, axis=-1) < 14.0, BLOOD_HU, FAT_HU)
        told = _steps(scan(grid, hu, blur_mm=0.4, noise_hu=40.0))
        assert len(told) == expected
        if told:
            assert "step artefacts at z 115 mm" in told[0]


def test_a_flat_surface_between_slices_is_no_step():
    grid = empty_grid((60, 120, 120), (0.4, 0.4, 0.5), (0.0, 0.0, 100.0))
    x = positions(grid)
    places = [(8.0, 8.0), (24.0, 8.0), (40.0, 8.0), (8.0, 24.0), (24.0, 24.0), (40.0, 24.0)]
    slant = 0.3 * (x[..., 2:] - 110.0)
    tube = np.min([np.linalg.norm(x[..., :2] - place - slant, axis=-1) for place in places], axis=0) < 6.0
    roof = (x[..., 2] > 115.0) & (x[..., 1] > 38.0)
    hu = np.where(tube | roof, BLOOD_HU, FAT_HU)
    assert _steps(scan(grid, hu, blur_mm=0.4, noise_hu=40.0)) == []


def test_a_volume_of_few_slices_is_taken():
    grid = Volume(np.zeros((16, 16, 16), dtype=np.int16), np.full(3, 0.5), np.zeros(3), np.eye(3))
    assert _steps(grid) == []
