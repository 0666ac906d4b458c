"""Centerlines: joined, bridged or cut, and what a tree does not reach is said."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.tree import tree_from_lines
from endopilot.errors import InputError
from endopilot.vessels.line_graph import found_lines
from endopilot.vessels.sources import Polylines


class Made:
    """The tree that lines become, with the notes and the balance."""

    def __init__(self, lines, radii=None, vessel="generic"):
        sizes = tuple(np.full(len(line), size) for line, size in zip(lines, radii or [1.5] * len(lines), strict=True))
        found = found_lines(Polylines(tuple(lines), sizes), None, "lines.vtp", vessel)
        self.tree, self.notes, self.coverage = tree_from_lines(found.lines), found.notes, found.coverage


def helix(count=240):
    turn = np.linspace(0.0, 2 * np.pi, count)
    return np.column_stack([15 * np.cos(turn), 15 * np.sin(turn), 6 * turn])


def straight(first, last, count=100):
    return np.linspace(first, last, count)


@pytest.mark.parametrize("line", [helix(), helix()[::-1], np.concatenate([helix(), helix()[::-1]])])
def test_points_in_order_are_left_as_they_are(line):
    assert Made([line]).notes == []


def test_one_line_through_a_whole_tree_is_that_tree():
    trunk, branch = straight([0, 0, 0], [0, 0, 60], 121), straight([0, 0, 30], [20, 0, 60])
    found = Made([np.concatenate([trunk, trunk[60:][::-1], branch])])
    assert len(found.tree.leaves()) == 2 and found.notes == []
    assert len(Made([np.concatenate([trunk, trunk[::-1]])]).tree.branches) == 1  # there and back


@pytest.mark.parametrize("step_mm", [4.0, 9.0, 20.0])
def test_coarse_lines_are_joined_by_straight_pieces_and_noted(step_mm):
    line = np.outer(np.arange(0, 100.1, step_mm), [0.0, 0.6, 0.8])
    found = Made([line])
    length = np.linalg.norm(line[-1] - line[0])
    assert abs(found.tree.longest_path().abscissa[-1] - length) < 1e-6
    assert len(found.notes) == 1 and f"the longest step, {step_mm:.1f} mm" in found.notes[0]


TURN = np.linspace(0.0, 2 * np.pi, 300)
RING = np.column_stack([20 * np.cos(TURN), 20 * np.sin(TURN), 0 * TURN])


@given(
    pieces=st.lists(
        st.tuples(
            st.tuples(*[st.floats(-40, 40)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(3, 60),
            st.floats(0.5, 4.0),
        ),
        min_size=1, max_size=5,
    )
)  # fmt: skip
@settings(max_examples=30, deadline=None, derandomize=True)
def test_covered_left_out_and_bridged_are_all_of_the_lines(pieces):
    lines, radii = [], []
    for start, heading, length, radius in pieces:
        unit = np.array(heading) + np.array([0, 0, 1.5])
        end = np.array(start) + length * unit / np.linalg.norm(unit)
        lines.append(straight(start, end, max(2, int(length / radius))))
        radii.append(radius)
    found = Made(lines, radii)
    lengths = found.coverage
    total = sum(length for _, _, length, _ in pieces)
    assert abs(lengths["length_mm"] - total) < 0.3
    assert abs(lengths["reached_mm"] + lengths["left_out_mm"] - lengths["length_mm"]) < 0.3
    # Lines that run together are said once, so what is said is at most what is left out.
    said = sum(float(m[1]) for note in found.notes if (m := re.search(r"([\d.]+) mm of line .*left out", note)))
    assert lengths["left_out_mm"] / len(pieces) - 5.0 <= said <= lengths["left_out_mm"] + 0.5
    bridged = sum(float(m[1]) for note in found.notes if (m := re.match(r"a gap of ([\d.]+) mm", note)))
    assert abs(bridged - lengths["bridged_mm"]) < 0.3


@pytest.mark.parametrize(
    ("other", "left_out_mm", "bridged_mm", "said"),
    [
        (straight([30, 0, 0], [30, 0, 40]), 40.0, 0.0, r"40\.0 mm of line at \(30\.0, .*\) mm is left out"),
        (straight([0, 0, 64], [0, 0, 90]), 0.0, 4.0, r"a gap of 4\.0 mm between lines at \(0\.0, 0\.0, 60\.0\) mm"),
    ],
)
def test_a_second_line_is_bridged_to_if_near_and_else_left_out(other, left_out_mm, bridged_mm, said):
    found = Made([straight([0, 0, 0], [0, 0, 60]), other])
    assert len(found.tree.branches) == 1
    assert found.coverage["left_out_mm"] == left_out_mm and found.coverage["bridged_mm"] == bridged_mm
    assert any(re.match(said, note) for note in found.notes)


def test_a_loop_is_open_in_the_tree_and_nothing_of_it_is_left_out():
    found = Made([RING, straight([20, 0, 0], [60, 0, 0])])
    assert found.coverage["left_out_mm"] < 1.0 and len(found.tree.leaves()) == 2


def test_the_longer_of_two_pieces_is_taken_though_the_other_is_wider():
    found = Made([straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 30])], [1.0, 2.0])
    assert abs(found.tree.longest_path().abscissa[-1] - 90) < 0.5


def test_lines_of_two_coronary_arteries_are_refused_with_both_places():
    both = [straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 80])]
    with pytest.raises(InputError, match=r"two trees that are not connected.*--ostium-mm"):
        Made(both, vessel="rca")


def test_the_root_is_an_end_and_no_place_that_a_vessel_passes():
    lines = [straight([0, 0, 0], [0, 0, 40]), straight([0, 0, 40], [0, 0, 80]), straight([0, 0, 40], [30, 0, 60])]
    assert np.abs(Made(lines).tree.branches[0].centerline.points[0, 2] - 40) > 15


DATA = Path(__file__).parents[3] / "shared" / "data"
PARENT = "lies in the parent vessel that the lines start in"


@pytest.mark.skipif(not DATA.exists(), reason="the real patients' centerlines are not at hand")
@pytest.mark.parametrize(
    ("file", "vessel", "leaves", "said"),
    [
        ("coronary_centerlines/rca_cl.vtp", "rca", 3, PARENT),
        ("coronary_centerlines/lca_cl.vtp", "lca", 3, PARENT),
        ("liver_tace/tace-lps-0.75mm.vtp", "generic", 40, PARENT),
        ("steve_bench/dualdevicenav", "generic", 10, "do not touch"),
    ],
)
def test_real_lines_are_covered_but_for_their_parent_vessel(file, vessel, leaves, said):
    anatomy = extract_anatomy(DATA / file, config=AnatomyConfig(vessel=vessel, spacing_mm=3.0))
    assert len(anatomy.tree.leaves()) >= leaves
    assert any(said in note for note in anatomy.provenance["notes"])
    assert not any("no line leads there" in note for note in anatomy.provenance["notes"])
    if said != PARENT:
        assert anatomy.provenance["coverage"]["left_out_mm"] < 1.0
        # The ascending aorta, which no vessel passes.
        assert np.linalg.norm(anatomy.insertion.position - [-367.5, 3.9, -10.2]) < 1.0
