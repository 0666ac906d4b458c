"""Sections against the atlas's truth."""

from __future__ import annotations

from dataclasses import replace

from analytic_shapes import forked_tree

from endopilot.anatomy.labels import label_tree
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree


def test_generic_names_count_generations():
    assert label_tree(forked_tree(), "generic").section_names == ("G0", "G1.1", "G1.2")


def test_a_tree_names_only_the_sections_that_it_has():
    tree, _ = make_patient_tree(AtlasConfig(vessel="rca", count=1, seed=7), 0)
    root = replace(tree, branches=tree.branches[:1])
    assert len(tree.sections_present) > 1 and root.sections_present == ("1",)
