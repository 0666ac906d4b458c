"""Vessels that are not as one draws them: odd ends, parents, repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_shapes import forked_tree, mask_of, tree_distance

from endopilot.anatomy.batch import extract_all
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.projection import project_tip
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.volume import write_mask
from endopilot.types import Insertion, LumenMask, Volume
from endopilot.vessels.surface import surface_from_mask

VOXEL_MM = (0.6, 0.6, 0.6)
FORK_MM = np.array([0.0, 0.0, 20.0])


def tube(points, x, low, high, radius=1.5):
    z = np.clip(points[..., 2], low, high)
    return radius - np.linalg.norm(points - np.stack([x + 0 * z, 0 * z, z], axis=-1), axis=-1)


@pytest.fixture(scope="module")
def fork_mask():
    return mask_of(lambda points: tree_distance(forked_tree(), points + FORK_MM), (22, 4, 24), VOXEL_MM)


def test_what_runs_alongside_or_lies_beyond_a_long_gap_is_not_joined_and_said():
    beside = mask_of(lambda p: np.maximum(tube(p, -1.9, -20, 20), tube(p, 1.9, -15, 15)), (8, 5, 24), VOXEL_MM)
    anatomy = extract_anatomy(beside, name="beside")
    assert len(anatomy.tree.branches) == 1 and abs(anatomy.insertion.position[0] + 1.9) < 0.5
    assert any("alongside" in note for note in anatomy.provenance["notes"])
    beyond = mask_of(lambda p: np.maximum(tube(p, 0, -24, 0), tube(p, 0, 8.0, 20.0)), (4, 4, 28), VOXEL_MM)
    (remark,) = [note for note in extract_anatomy(beyond).provenance["notes"] if "left out" in note]
    assert "15 mm long" in remark and "apart from the lumen" in remark and "begins 6.0 mm away" in remark


def test_a_distal_end_that_is_wider_than_others_is_not_the_inlet():
    narrowing = lambda p: tube(p, 0, -30, 30, 1.6 + np.clip(p[..., 2], -30, 30) / 60)  # noqa: E731
    bulb = lambda p: 2.6 - np.linalg.norm(p - np.array([0, 0, -30.0]), axis=-1)  # noqa: E731
    anatomy = extract_anatomy(mask_of(lambda p: np.maximum(narrowing(p), bulb(p)), (5, 5, 36), VOXEL_MM), name="bulb")
    assert anatomy.insertion.position[2] > 25


def test_an_ostium_in_mid_vessel_points_away_from_the_inlet():
    narrowing = lambda p: tube(p, 0, -30, 30, 1.6 + np.clip(p[..., 2], -30, 30) / 60)  # noqa: E731
    mask = mask_of(narrowing, (5, 5, 36), VOXEL_MM)
    anatomy = extract_anatomy(mask, name="mid", config=AnatomyConfig(ostium_mm=(0.0, 0.0, 5.0)))
    assert len(anatomy.tree.branches) == 1 and anatomy.insertion.direction[2] < -0.9
    assert abs(anatomy.tree.longest_path().abscissa[-1] - 35) < 3


def crescent(points, web_mm=0.8):
    """A lumen whose section grows towards z = -20 into two lobes and a web between them, as in a dissection."""
    aside = np.clip(5.0 - points[..., 2], 0.0, 40.0) / 25.0 * 9.0  # of the second lobe's axis, mm
    x = points[..., 0] - np.clip(points[..., 0], 0.0, aside)
    web = web_mm - np.hypot(x, points[..., 1])
    lobe = 2.2 - np.hypot(points[..., 0] - aside, points[..., 1])
    return np.maximum(tube(points, 0.0, -40, 30, 2.0), np.where(points[..., 2] < 5.0, np.maximum(web, lobe), -1.0))


def test_the_other_side_of_a_wide_inlet_is_no_branch_that_leads_back():
    lumen = lambda p: np.minimum(crescent(p), p[..., 2] + 20.0)  # noqa: E731
    mask = mask_of(lumen, (13, 4, 34), VOXEL_MM)
    ostium = Insertion(np.array([0.0, 0.0, -20.0]), np.array([0.0, 0.0, 1.0]))
    anatomy = extract_anatomy(replace(mask, ostium=ostium), name="crescent")
    assert len(anatomy.tree.branches) == 1
    up = np.stack([np.full(20, 4.0), np.zeros(20), np.linspace(-19, -2, 20)], axis=1)
    tip = project_tip(anatomy.tree, anatomy.insertion, up)
    assert np.abs(tip.abscissa - (up[:, 2] + 20)).max() < 1.5  # a wire in the web lies beside the line, not far ahead
    # The radius is the vessel's and not the distance to the cut.
    assert anatomy.tree.branches[0].centerline.radius.min() > 1.2


def test_a_vessel_of_one_voxel_is_refused_with_the_reason():
    mask = mask_of(lambda p: tube(p, 0.125, -9, 9, 0.13), (2, 2, 10), (0.25, 0.25, 0.25))
    with pytest.raises(InputError, match=r"one voxel|nowhere thick"):
        extract_anatomy(mask, name="thin")


def test_a_batch_makes_the_good_and_lists_the_bad(fork_mask, tmp_path):
    volume = fork_mask.volume
    for name, voxels in (("good", volume.voxels), ("bad", np.ones((30, 30, 30), dtype=bool))):
        mask = LumenMask(Volume(voxels, volume.spacing_mm, volume.origin_mm, volume.direction))
        write_mask(mask, tmp_path / f"{name}.nrrd", manifest={})
    (tmp_path / "broken.stl").write_bytes(b"")
    sources = [tmp_path / "bad.nrrd", tmp_path / "good.nrrd", tmp_path / "broken.stl"]
    made, rejected = extract_all(sources, tmp_path / "out", config=AnatomyConfig())
    assert made == [tmp_path / "out" / "good"] and (made[0] / "anatomy.json").exists()
    assert "solid block" in rejected[str(sources[0])] and "empty" in rejected[str(sources[2])]
    assert read_json(tmp_path / "out" / "manifest.json")["rejected"] == rejected
    with pytest.raises(InputError, match="several of the files"):
        extract_all([tmp_path / "a.stl", tmp_path / "a.ply"], tmp_path / "out", config=AnatomyConfig())
    with pytest.raises(InputError, match="none of the 2 files"):
        extract_all([sources[0], sources[2]], tmp_path / "none", config=AnatomyConfig())
    assert not (tmp_path / "none").exists()


def test_a_branch_begins_on_its_parents_axis_at_the_fork():
    mask = mask_of(lambda p: tree_distance(forked_tree(90.0), p + FORK_MM), (22, 4, 24), (0.5, 0.5, 0.5))
    found = extract_anatomy(mask, name="fork", config=AnatomyConfig(ostium_mm=(0.0, 0.0, -20.0)))
    joint = found.tree.branches[0].centerline.points[-1]
    assert len(found.tree.branches) == 3 and np.linalg.norm(joint) < 1.2 and np.hypot(joint[0], joint[1]) < 0.2


HALF_MM = (22.0, 12.0, 34.0)


def two_arteries(points):
    return np.maximum(tube(points, -10.0, -20.0, 30.0), tube(points, 10.0, -30.0, 30.0))


def artery_from_aorta(points):
    """A vessel that leaves a ball of 9 mm radius around (0, 0, 22); a bulge of 4 mm stands 20 mm below its end."""
    aorta = 9.0 - np.linalg.norm(points - [0.0, 0.0, 22.0], axis=-1)
    bulge = 4.0 - np.linalg.norm(points - [0.0, 0.0, -12.0], axis=-1)
    return np.maximum.reduce([tube(points, 0.0, -32.0, 30.0), aorta, bulge])


def test_of_two_vessels_the_larger_is_taken_and_the_other_named():
    mask = mask_of(two_arteries, HALF_MM, (0.6, 0.6, 0.6))
    for source in (mask, surface_from_mask(mask.volume)):
        anatomy = extract_anatomy(source, name="both")
        assert abs(anatomy.insertion.position[0] - 10.0) < 1.0
        assert any("another vessel apart from the lumen" in note for note in anatomy.provenance["notes"])
    with pytest.raises(InputError, match="--ostium-mm"):  # straight tubes are not answered as coronary arteries
        extract_anatomy(mask, config=AnatomyConfig(vessel="rca"))


def test_coronary_ostium_is_where_the_vessel_leaves_the_aorta():
    mask = mask_of(artery_from_aorta, HALF_MM, (0.6, 0.6, 0.6))
    anatomy = extract_anatomy(mask, name="root", config=AnatomyConfig(vessel="rca"))
    assert anatomy.provenance["ostium_rule"] == "where the vessel leaves the aorta"
    assert np.linalg.norm(anatomy.insertion.position - [0.0, 0.0, 13.0]) < 2.0
    assert anatomy.insertion.direction[2] < -0.9
    assert anatomy.tree.longest_path().radius[0] < 2.5
    assert anatomy.tree.longest_path().abscissa[-1] > 40.0  # on through the aneurysm, to the end
