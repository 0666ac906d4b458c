"""Sections against the atlas's truth, and the geometry of lines against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_shapes import forked_tree

from endopilot.anatomy.labels import dominance, label_tree
from endopilot.anatomy.tree import curvature_torsion, make_centerline
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.errors import InputError


def test_right_coronary_sections_agree_with_the_atlas():
    right = total = 0
    for index in range(6):
        truth, _ = make_patient_tree(AtlasConfig(vessel="rca", count=6, seed=7), index)
        found = label_tree(truth, "rca")
        for one, two in zip(truth.branches, found.branches, strict=True):
            names = [truth.section_names[i] for i in one.section]
            right += sum(a == found.section_names[b] for a, b in zip(names, two.section, strict=True))
            total += len(names)
        assert dominance(found) in ("right", "balanced", "left")
    assert right / total > 0.9


def test_generic_names_count_generations():
    assert label_tree(forked_tree(), "generic").section_names == ("G0", "G1.1", "G1.2")


def test_a_naming_map_renames_sections():
    named = label_tree(forked_tree(), "generic", naming={"G0": "common iliac", "G1.2": "internal iliac"})
    assert named.section_names == ("common iliac", "G1.1", "internal iliac")
    with pytest.raises(InputError, match="no section 'G7'; this tree has G0"):
        label_tree(forked_tree(), "generic", naming={"G7": "femoral"})


def test_helix_has_its_curvature_and_torsion_and_untwisted_normals():
    radius, pitch = 10.0, 3.0
    angle = np.linspace(0, 12, 400)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch * angle], axis=1)
    line = make_centerline(points, np.ones(400))
    curvature, torsion = curvature_torsion(line)
    square = radius**2 + pitch**2
    assert np.allclose(curvature, radius / square, rtol=1e-3)
    assert np.allclose(torsion[5:-5], pitch / square, rtol=1e-2)
    # A parallel-transported normal turns against the Frenet frame by ∫τ ds.
    frenet = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turned = np.arccos(np.clip([line.normals[5] @ frenet[5], line.normals[105] @ frenet[105]], -1, 1))
    expected = pitch / square * (line.abscissa[105] - line.abscissa[5])
    assert min(abs(turned[1] - turned[0] - expected), abs(turned[0] - turned[1] - expected)) < 0.02


def test_a_tree_names_only_the_sections_that_it_has():
    tree, _ = make_patient_tree(AtlasConfig(vessel="rca", count=1, seed=7), 0)
    root = replace(tree, branches=tree.branches[:1])
    assert len(tree.sections_present) > 1 and root.sections_present == ("1",)
