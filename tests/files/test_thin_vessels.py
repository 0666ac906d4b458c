"""A lumen that is thinner somewhere than its voxels can show: followed, or stated with its length and place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from make_vessels import length_of, line, lumen, thinned_at, tubes, with_voxels
from scipy.spatial import KDTree

from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.tree import sampled
from endopilot.vessels.coverage import NOTED_MM
from endopilot.vessels.medial_lines import traced_lines
from endopilot.vessels.surface import Surface

STRAIGHT = line((0, 0, 0), (0, 0, 60))


@pytest.mark.parametrize(
    ("voxel_mm", "length_mm", "across"),
    [((0.35, 0.35, 0.5), 1.0, 1), ((0.7, 0.7, 0.5), 2.0, 2), ((0.35, 0.35, 0.5), 6.0, 1), ((0.7, 0.7, 0.5), 6.0, 1)],
)
def test_a_vessel_goes_on_behind_a_neck(voxel_mm, length_mm, across):
    mask = thinned_at(tubes((STRAIGHT, 1.6), voxel_mm=voxel_mm), (0, 0, 30), length_mm, across)
    anatomy = extract_anatomy(lumen(mask), name="neck")
    assert abs(length_of(anatomy) - 60.0) < 2.0
    if length_mm > 2.0:
        assert any("neck of" in note and "was widened" in note for note in anatomy.provenance["notes"])


@pytest.mark.parametrize(("voxel_mm", "radius_mm", "across"), [(0.35, 1.2, 1), (0.45, 2.0, 1), (0.45, 2.0, 2)])
def test_a_neck_of_few_voxels_between_wide_faces_is_widened_until_the_wall_carries_on(voxel_mm, radius_mm, across):
    mask = thinned_at(tubes((STRAIGHT, radius_mm), voxel_mm=[voxel_mm] * 3), (0.1, 0.1, 30), 1.5, across)
    anatomy = extract_anatomy(lumen(mask), name="neck")
    assert abs(length_of(anatomy) - 60.0) < 2.0
    assert any("neck of" in note and "was widened" in note for note in anatomy.provenance["notes"])


@pytest.mark.parametrize("voxel_mm", [(0.35, 0.35, 0.5), (0.7, 0.7, 0.5)])
def test_a_branch_of_one_voxel_is_followed(voxel_mm):
    trunk = tubes((STRAIGHT, 1.6), (line((0, 0, 30), (22, 0, 45)), 0.01), voxel_mm=voxel_mm)
    anatomy = extract_anatomy(lumen(with_voxels(trunk, (0, 0, 30), (22, 0, 45))), name="twig")
    tips = [anatomy.tree.branches[leaf].centerline.points[-1] for leaf in anatomy.tree.leaves()]
    assert np.linalg.norm(np.array(tips) - [22, 0, 45], axis=1).min() < 2.5
    assert any("thin branch" in note for note in anatomy.provenance["notes"])


def test_what_lies_beyond_a_neck_of_a_surface_is_stated_with_length_and_place():
    height = np.arange(0.0, 60.01, 0.25)
    radius = np.where(np.abs(height - 30) < 1.0, 0.05, 1.6)
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    rings = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), height[:, None] + 0 * angle], -1
    )
    start = np.arange(24) + 24 * np.arange(len(height) - 1)[:, None]
    beside = (np.arange(24) + 1) % 24 + 24 * np.arange(len(height) - 1)[:, None]
    faces = np.concatenate([np.stack([start, beside, beside + 24], -1), np.stack([start, beside + 24, start + 24], -1)])
    anatomy = extract_anatomy(Surface(rings.reshape(-1, 3), faces.reshape(-1, 3)), name="neck")
    balance = anatomy.provenance["coverage"]
    assert abs(balance["reached_mm"] + balance["left_out_mm"] - balance["length_mm"]) < 0.3
    assert any("30 mm of the lumen" in note and "not in the tree" in note for note in anatomy.provenance["notes"])


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.tuples(st.floats(8, 45), st.floats(12, 25), st.floats(0, 6.28), st.floats(0.2, 1.2)), max_size=3),
    st.lists(st.tuples(st.floats(6, 54), st.floats(0.5, 6.0), st.integers(0, 2)), max_size=2),
    st.sampled_from([(0.5, 0.5, 0.5), (0.7, 0.7, 0.5)]),
)
def test_what_is_reached_and_what_is_stated_are_all_of_the_piece(branches, necks, voxel_mm):
    lines = [(STRAIGHT, 1.5)]
    for height, length, angle, radius in branches:
        tip = (length * np.cos(angle), length * np.sin(angle), height + 0.5 * length)
        lines.append((line((0, 0, height), tip), radius))
    mask = tubes(*lines, voxel_mm=voxel_mm)
    for height, length, across in necks:
        mask = thinned_at(mask, (0, 0, height), length, across)
    anatomy = extract_anatomy(lumen(mask), name="random")
    notes = " ".join(anatomy.provenance["notes"])
    balance = anatomy.provenance["coverage"]
    parts = balance["reached_mm"] + balance["widened_mm"] + balance["left_out_mm"]
    assert abs(parts - balance["length_mm"]) < 0.3
    points, radius = sampled(anatomy.tree)
    middle = traced_lines(mask)
    gap, nearest = map(np.asarray, KDTree(points).query(middle.points))
    lost = float(middle.share_mm[gap > radius[nearest] + 2.0 * max(voxel_mm)].sum())
    assert lost < NOTED_MM or "not in the tree" in notes or "left out" in notes
