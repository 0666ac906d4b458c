"""Sections against the atlas's truth."""

from __future__ import annotations

from dataclasses import replace

from analytic_shapes import forked_tree

from endopilot.anatomy.labels import dominance, label_tree
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree


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


def test_a_tree_names_only_the_sections_that_it_has():
    tree, _ = make_patient_tree(AtlasConfig(vessel="rca", count=1, seed=7), 0)
    root = replace(tree, branches=tree.branches[:1])
    assert len(tree.sections_present) > 1 and root.sections_present == ("1",)
