"""Extraction on analytic lumens, the real patient's centerlines and vessels not as one draws them; refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks.anatomy.analytic_lumens import BEND_MM, forked_tree, mask_of, torus_distance, tree_distance
from endopilot.anatomy.batch import extract_all
from endopilot.anatomy.distance import CATHETER_RADIUS_MM, distance_map_from_spheres, sample
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.projection import project_tip
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.volume import write_mask
from endopilot.types import Insertion, LumenMask, Volume
from endopilot.vessels.sources import Polylines, read_source
from endopilot.vessels.surface import Surface, surface_from_mask

REAL = Path(__file__).parents[3] / "shared" / "data" / "coronary_centerlines"


SHIFT = np.array([0.0, 0.0, 0.17])


def bent_tube(points, radius=1.5):
    """Five sixths of a torus, cut flat, off the voxels' own symmetry."""
    points = points + SHIFT
    angle = np.arctan2(points[..., 1], points[..., 0])
    return np.where(np.abs(angle) > np.pi / 6, torus_distance(points, radius), -1.0)


FORK_MM = np.array([0.0, 0.0, 20.0])


def fork(points):
    tree = forked_tree()
    return tree_distance(tree, points + FORK_MM)


@pytest.fixture(scope="module")
def fork_mask():
    return mask_of(fork, (22, 4, 24), (0.5, 0.5, 0.5))


def is_sound(anatomy):
    """Every centerline point lies in the lumen, the catheter is open, branches join their parents."""
    for branch in anatomy.tree.branches:
        line = branch.centerline
        assert sample(anatomy.distance_map, line.points).min() > 0
        assert np.all(np.diff(line.abscissa) > 0) and np.all(line.radius > 0)
        assert np.allclose(np.linalg.norm(line.normals, axis=1), 1)
        if branch.parent >= 0:
            parent = anatomy.tree.branches[branch.parent].centerline
            assert np.array_equal(line.points[0], parent.points[-1]) and line.abscissa[0] == parent.abscissa[-1]
    way = anatomy.insertion.position + np.outer(np.linspace(-15, 0, 60), anatomy.insertion.direction)
    assert sample(anatomy.distance_map, way).min() > 0.5 * anatomy.catheter_radius_mm
    return True


def test_bent_tube_axis_and_radius():
    rotation = Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix() @ np.diag([-1, -1, 1])
    mask = mask_of(bent_tube, (22, 22, 22), (0.6, 0.6, 0.6), rotation)
    anatomy = extract_anatomy(mask, name="torus")
    line = anatomy.tree.longest_path()
    assert len(anatomy.tree.branches) == 1 and is_sound(anatomy)
    points = line.points + SHIFT
    off_axis = np.hypot(np.hypot(points[:, 0], points[:, 1]) - BEND_MM, points[:, 2])
    assert off_axis.mean() < 0.1 * 0.6 + 0.02
    assert np.abs(line.radius - 1.5).mean() < 0.1 * 0.6
    assert abs(line.abscissa[-1] - BEND_MM * 2 * np.pi * 5 / 6) < 2.5


def test_fork_is_found_with_its_root(fork_mask):
    anatomy = extract_anatomy(fork_mask, name="fork")
    assert len(anatomy.tree.leaves()) == 2 and is_sound(anatomy)
    tips = np.array([anatomy.tree.branches[i].centerline.points[-1] for i in anatomy.tree.leaves()])
    truth = np.array([b.centerline.points[-1] for b in forked_tree().branches[1:]]) - [0, 0, 20]
    assert KDTree(tips).query(truth)[0].max() < 1.5
    place = anatomy.tree.branches[0].centerline.points[-1]
    assert np.linalg.norm(place) < 1.5


def test_the_tree_begins_at_the_ostium_that_the_segmentation_found(fork_mask):
    ostium = Insertion(np.array([0.5, -0.4, -17.0]), np.array([0.0, 0.0, 1.0]))
    anatomy = extract_anatomy(LumenMask(fork_mask.volume, ostium), name="fork")
    np.testing.assert_allclose(anatomy.insertion.position, ostium.position, atol=1e-9)
    root = anatomy.tree.branches[0].centerline
    far = (root.points[:, 2] > -10.0) & (root.points[:, 2] < -3.0)
    assert np.linalg.norm(root.points[far, :2], axis=1).max() < 0.2


def test_flaws_of_masks_are_repaired(fork_mask):
    rng = np.random.default_rng(1)
    voxels = fork_mask.volume.voxels.copy()
    voxels[20:22] = False  # a gap across the root vessel
    voxels[rng.random(voxels.shape) < 0.0005] = True  # specks
    inside = np.argwhere(fork_mask.volume.voxels)
    voxels[tuple(inside[rng.integers(0, len(inside), 60)].T)] = False  # holes
    volume = fork_mask.volume
    anatomy = extract_anatomy(
        LumenMask(Volume(voxels, volume.spacing_mm, volume.origin_mm, volume.direction)), name="flawed"
    )
    assert len(anatomy.tree.leaves()) == 2 and is_sound(anatomy)
    assert any("bridged" in note for note in anatomy.provenance["notes"])


def test_surface_with_holes_and_inverted_normals(fork_mask, tmp_path):
    wall = surface_from_mask(fork_mask.volume)
    height = wall.vertices[wall.faces].mean(axis=1)[:, 2]
    opened = Surface(wall.vertices, wall.faces[(height > -19.0) & (height < 19.0)].repeat(2, axis=0)[:, ::-1])  # twice
    pyvista.PolyData.from_regular_faces(opened.vertices, opened.faces).save(tmp_path / "open.stl")
    anatomy = extract_anatomy(read_source(tmp_path / "open.stl"), name="mesh")
    assert len(anatomy.tree.leaves()) == 2 and is_sound(anatomy)
    assert any("capped" in note for note in anatomy.provenance["notes"])
    assert len(anatomy.provenance["source"]["sha256"]) == 64


def test_the_guiding_catheter_is_one_of_6_french_or_as_wide_as_a_narrower_ostium(fork_mask):
    anatomy = extract_anatomy(fork_mask, name="fork")
    assert anatomy.catheter_radius_mm == CATHETER_RADIUS_MM == 0.9
    behind = anatomy.insertion.position - 8.0 * anatomy.insertion.direction
    assert abs(float(sample(anatomy.distance_map, behind[None])[0]) - 0.9) < 0.1
    # a tube of 0.9 mm in an ostium of 2 mm leans until 3 mm of it span the gap
    assert abs(anatomy.provenance["catheter_tilt_deg"] - np.degrees(np.arctan(1.1 / 3.0))) < 3.0
    narrow = Polylines((np.outer(np.linspace(0.0, 60.0, 200), [0.0, 0.6, 0.8]),), (np.full(200, 0.5),))
    assert abs(extract_anatomy(narrow, name="narrow").catheter_radius_mm - 0.5) < 1e-6


CUBE = (36, 36, 36)


@pytest.mark.parametrize(
    ("voxels", "message"),
    [
        (np.zeros(CUBE, dtype=bool), "empty"),
        (np.ones(CUBE, dtype=bool), "solid block"),
        (np.linalg.norm(np.indices(CUBE) - 18, axis=0) < 15, "no vessel"),
        (np.random.default_rng(0).random(CUBE) < 0.4, "noise"),
        (np.all(np.indices(CUBE)[:2] == 18, axis=0), "one voxel|nowhere thick"),
    ],
)
def test_what_is_no_vessel_is_refused(voxels, message):
    with pytest.raises(InputError, match=message):
        extract_anatomy(LumenMask(Volume(voxels, np.full(3, 0.5), np.zeros(3), np.eye(3))), name="bad")


def test_mask_away_from_the_ostium_is_refused(fork_mask):
    with pytest.raises(InputError, match="touches nothing near the ostium"):
        extract_anatomy(fork_mask, name="far", config=AnatomyConfig(ostium_mm=(90.0, 0.0, 0.0)))


@pytest.mark.skipif(not REAL.exists(), reason="the real patient's centerlines are not at hand")
def test_real_patient_comes_back_from_the_rebuilt_lumen():
    truth = extract_anatomy(read_source(REAL / "rca_cl.vtp"), name="rca", config=AnatomyConfig(vessel="rca"))
    assert len(truth.tree.leaves()) == 4 and is_sound(truth)
    assert truth.tree.branches[0].centerline.radius.max() < 4  # cut at the ostium, where the aorta ends
    lumen = distance_map_from_spheres(truth.tree, spacing_mm=0.5)
    mask = LumenMask(Volume(lumen.values > 0, np.full(3, 0.5), lumen.origin_mm, np.eye(3)), truth.insertion)
    found = extract_anatomy(mask, name="again", config=AnatomyConfig(vessel="rca"))
    assert is_sound(found)
    one, two = (
        np.concatenate([np.column_stack([b.centerline.points, b.centerline.radius]) for b in anatomy.tree.branches])
        for anatomy in (truth, found)
    )
    gap, nearest = KDTree(two[:, :3]).query(one[:, :3])
    back, nearest_back = KDTree(one[:, :3]).query(two[:, :3])
    hits = (gap < one[:, 3]).sum() + (back < one[nearest_back, 3]).sum()
    assert hits / (len(one) + len(two)) >= 0.98
    inside = gap < one[:, 3]
    assert gap[inside].mean() <= 0.15
    assert np.abs(two[nearest, 3] - one[:, 3])[inside].mean() <= 0.1


VOXEL_MM = (0.6, 0.6, 0.6)


def tube(points, x, low, high, radius=1.5):
    z = np.clip(points[..., 2], low, high)
    return radius - np.linalg.norm(points - np.stack([x + 0 * z, 0 * z, z], axis=-1), axis=-1)


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
    assert anatomy.provenance["ostium_rule"] == "given" and abs(anatomy.insertion.position[2] - 5.0) < 1.0
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


def artery_from_aorta(points):
    """A vessel that leaves a ball of 9 mm radius around (0, 0, 22); a bulge of 4 mm stands 20 mm below its end."""
    aorta = 9.0 - np.linalg.norm(points - [0.0, 0.0, 22.0], axis=-1)
    bulge = 4.0 - np.linalg.norm(points - [0.0, 0.0, -12.0], axis=-1)
    return np.maximum.reduce([tube(points, 0.0, -32.0, 30.0), aorta, bulge])


def test_coronary_ostium_is_where_the_vessel_leaves_the_aorta():
    mask = mask_of(artery_from_aorta, HALF_MM, (0.6, 0.6, 0.6))
    anatomy = extract_anatomy(mask, name="root", config=AnatomyConfig(vessel="rca"))
    assert anatomy.provenance["ostium_rule"] == "where the vessel leaves the aorta"
    assert np.linalg.norm(anatomy.insertion.position - [0.0, 0.0, 13.0]) < 2.0
    assert anatomy.insertion.direction[2] < -0.9
    assert anatomy.tree.longest_path().radius[0] < 2.5
    assert anatomy.tree.longest_path().abscissa[-1] > 40.0  # on through the aneurysm, to the end
