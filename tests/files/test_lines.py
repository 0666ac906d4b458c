"""Centerlines: sorted or refused, joined or cut; what a tree does not reach is said; so are loops and inlets."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endopilot.anatomy.tree import tree_from_polylines
from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines


def made(lines, radii=None, vessel="generic"):
    sizes = tuple(np.full(len(line), size) for line, size in zip(lines, radii or [1.5] * len(lines), strict=True))
    return tree_from_polylines(Polylines(tuple(lines), sizes), None, "lines.vtp", vessel)


def helix(count=240):
    turn = np.linspace(0.0, 2 * np.pi, count)
    return np.column_stack([15 * np.cos(turn), 15 * np.sin(turn), 6 * turn])


def straight(first, last, count=100):
    return np.linspace(first, last, count)


def test_points_in_another_order_than_along_the_vessel_are_sorted():
    line = straight([0, 0, 0], [0, 0, 60], 121)
    swapped = line.copy()
    swapped[[40, 41]] = line[[41, 40]]
    for mixed, said in (
        (swapped, "sorted (61 mm became 60 mm)"),
        (line[np.random.default_rng(3).permutation(121)], "sorted"),
    ):
        found = made([mixed])
        assert abs(found.tree.longest_path().abscissa[-1] - 60) < 0.5
        assert any(said in note for note in found.notes)


def test_points_in_no_order_are_refused_as_such_and_not_as_coarse():
    cloud = 50 * np.random.default_rng(0).random((60, 3))
    with pytest.raises(InputError, match=r"line 0: its points are not in order along a vessel .*; sort them") as error:
        made([cloud])
    assert "resample" not in str(error.value)


@pytest.mark.parametrize("line", [helix(), helix()[::-1], np.concatenate([helix(), helix()[::-1]])])
def test_points_in_order_are_left_as_they_are(line):
    assert made([line]).notes == []


def test_one_line_through_a_whole_tree_is_that_tree():
    trunk, branch = straight([0, 0, 0], [0, 0, 60], 121), straight([0, 0, 30], [20, 0, 60])
    found = made([np.concatenate([trunk, trunk[60:][::-1], branch])])
    assert len(found.tree.leaves()) == 2 and found.notes == []
    assert len(made([np.concatenate([trunk, trunk[::-1]])]).tree.branches) == 1  # there and back


@pytest.mark.parametrize("step_mm", [4.0, 9.0, 20.0])
def test_coarse_lines_are_joined_by_straight_pieces_and_noted(step_mm):
    line = np.outer(np.arange(0, 100.1, step_mm), [0.0, 0.6, 0.8])
    found = made([line])
    length = np.linalg.norm(line[-1] - line[0])
    assert abs(found.tree.longest_path().abscissa[-1] - length) < 1e-6
    assert len(found.notes) == 1 and f"the longest step, {step_mm:.1f} mm" in found.notes[0]


def test_a_jump_to_another_vessel_is_cut_and_noted():
    trunk = straight([0, 0, 0], [0, 0, 60], 121)
    found = made([np.concatenate([trunk, straight([0, 0, 30], [20, 0, 60])])])
    assert len(found.tree.leaves()) == 2
    assert any("line 0 jumps by 30.0 mm at (0.0, 0.0, 60.0) mm: cut there" in note for note in found.notes)


TURN = np.linspace(0.0, 2 * np.pi, 300)
RING = np.column_stack([20 * np.cos(TURN), 20 * np.sin(TURN), 0 * TURN])
LOOP = r"(two lines meet|two vessels touch) at \((.*?)\) mm and close a loop of (\d+) mm"


def loops(found):
    matches = [re.match(LOOP, note) for note in found.notes]
    return [(np.array(m[2].split(","), dtype=float), float(m[3])) for m in matches if m]


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
    found = made(lines, radii)
    lengths = found.coverage
    total = sum(length for _, _, length, _ in pieces)
    assert abs(lengths["length_mm"] - total) < 0.3
    assert abs(lengths["reached_mm"] + lengths["left_out_mm"] - lengths["length_mm"]) < 0.3
    # Lines that run together are said once, so what is said is at most what is left out.
    said = sum(float(m[1]) for note in found.notes if (m := re.match(r"([\d.]+) mm of line .*left out", note)))
    assert said <= lengths["left_out_mm"] + 0.5
    assert said >= lengths["left_out_mm"] / len(pieces) - 0.5
    bridged = sum(float(m[1]) for note in found.notes if (m := re.match(r"a gap of ([\d.]+) mm", note)))
    assert abs(bridged - lengths["bridged_mm"]) < 0.3
    # By another way: what lies outside the tree's own spheres is no longer than what is said to be left out.
    points = np.concatenate([branch.centerline.points for branch in found.tree.branches])
    radius = np.concatenate([branch.centerline.radius for branch in found.tree.branches])
    outside = 0.0
    for line in lines:
        dense = straight(line[0], line[-1], 200)
        gap = np.linalg.norm(dense[:, None] - points, axis=2)
        outside += (gap.min(axis=1) > radius[gap.argmin(axis=1)] + 0.5).mean() * np.linalg.norm(line[-1] - line[0])
    assert outside <= lengths["left_out_mm"] + 1.0


def test_a_second_line_apart_is_said_with_its_length_and_place():
    found = made([straight([0, 0, 0], [0, 0, 60]), straight([30, 0, 0], [30, 0, 40])])
    assert found.coverage == {"length_mm": 100.0, "reached_mm": 60.0, "left_out_mm": 40.0, "bridged_mm": 0.0}
    assert any(re.match(r"40\.0 mm of line at \(30\.0, .*\) mm is left out", note) for note in found.notes)


def test_a_small_gap_between_lines_is_bridged_and_noted():
    found = made([straight([0, 0, 0], [0, 0, 30]), straight([0, 0, 34], [0, 0, 60])])
    assert len(found.tree.branches) == 1 and found.coverage["bridged_mm"] == 4.0
    assert any("a gap of 4.0 mm between lines at (0.0, 0.0, 30.0) mm is bridged" in note for note in found.notes)


def test_the_longer_of_two_pieces_is_taken_though_the_other_is_wider():
    found = made([straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 30])], [1.0, 2.0])
    assert abs(found.tree.longest_path().abscissa[-1] - 90) < 0.5


def test_lines_of_two_coronary_arteries_are_refused_with_both_places():
    both = [straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 80])]
    with pytest.raises(InputError, match=r"two trees that are not connected.*--ostium-mm"):
        made(both, vessel="rca")


ARCH = np.column_stack([10 * np.sin(TURN / 2), 0 * TURN, 20 + 40 * TURN / TURN[-1]])
DIAMOND = [
    *(straight([0, 0, 0], [x, 0, 40]) for x in (25, -25)),
    *(straight([x, 0, 40], [0, 0, 80]) for x in (25, -25)),
    straight([0, 0, 80], [0, 0, 100]),
    straight([0, 0, -40], [0, 0, 0]),
]


@pytest.mark.parametrize(
    ("lines", "length"),
    [
        ([RING], 126),
        ([RING, straight([20, 0, 0], [60, 0, 0])], 126),
        ([straight([0, 0, 0], [0, 0, 80]), ARCH], 86),
        (DIAMOND, 189),
    ],
)
def test_loops_are_cut_with_their_place_and_length(lines, length):
    found = made(lines)
    assert found.coverage["left_out_mm"] < 1.0
    (place, size), *more = loops(found)
    assert not more and abs(size - length) < 8
    assert min(np.linalg.norm(line - place, axis=1).min() for line in lines) < 2.0


def test_vessels_that_touch_are_said_and_bends_without_a_hole_are_not():
    bend = np.column_stack([8 - 8 * np.cos(TURN[:150]), 0 * TURN[:150], 40 + 8 * np.sin(TURN[:150])])
    leg = straight([0, 0, 0], [0, 0, 40])
    kiss = np.concatenate([leg, bend, straight([16, 0, 40], [2, 0, 20]), straight([2, 0, 20], [16, 0, 0])])
    ((place, size),) = loops(made([kiss]))
    assert np.linalg.norm(place - [1, 0, 20]) < 1.0 and abs(size - 70) < 3
    narrow = np.column_stack([1.3 - 1.3 * np.cos(TURN[:150]), 0 * TURN[:150], 40 + 1.3 * np.sin(TURN[:150])])
    assert loops(made([np.concatenate([leg, narrow, straight([2.6, 0, 40], [2.6, 0, 0])])])) == []
    assert loops(made([straight([0, 0, 0], [0, 0, 80]), straight([0, 0, 30], [12, 0, 80])])) == []


def test_a_second_inlet_is_said_with_its_place():
    first = np.concatenate([straight([-15, 0, 0], [0, 0, 40]), straight([0, 0, 40.4], [0, 0, 80])])
    found = made([first, straight([15, 0, 0], [0, 0, 40])])
    assert any("the end at (15.0, 0.0, 0.0) mm" in note and "could be an inlet too" in note for note in found.notes)
    assert made([straight([0, 0, 0], [0, 0, 80])]).notes == []


def test_the_root_is_an_end_and_no_place_that_a_vessel_passes():
    lines = [straight([0, 0, 0], [0, 0, 40]), straight([0, 0, 40], [0, 0, 80]), straight([0, 0, 40], [30, 0, 60])]
    assert np.abs(made(lines).tree.branches[0].centerline.points[0, 2] - 40) > 15


DATA = Path(__file__).parents[3] / "shared" / "data"


def made_of_file(path, vessel="generic"):
    content = read_source(path).content
    assert isinstance(content, Polylines)
    return tree_from_polylines(content, None, path.name, vessel)


@pytest.mark.skipif(not (DATA / "steve_bench").exists(), reason="the benchmark's curves are not at hand")
def test_the_loop_of_the_vertebral_arteries_is_said():
    folder = DATA / "steve_bench" / "dualdevicenav"
    curves = [curve for file in folder.glob("*.mrk.json") for curve in json.loads(file.read_text())["markups"]]
    found = made_of_file(folder)
    assert found.coverage["left_out_mm"] < 1.0
    basilar = next(np.array(c["controlPoints"][0]["position"]) for c in curves if len(c["controlPoints"]) == 30)
    (loop,) = [note for note in found.notes if "close a loop" in note]
    place = np.array(loop[loop.index("(") + 1 : loop.index(")")].split(","), dtype=float)
    assert np.linalg.norm(place - basilar) < 5.0
    assert any("do not touch" in note for note in found.notes)
    root = found.tree.branches[0].centerline.points[0]
    assert np.linalg.norm(root - [-367.5, 3.9, -10.2]) < 1.0  # the ascending aorta, which no vessel passes


@pytest.mark.skipif(not (DATA / "liver_tace").exists(), reason="the liver's vessel tree is not at hand")
def test_a_liver_tree_is_covered_but_for_its_parent_vessel():
    found = made_of_file(DATA / "liver_tace" / "tace-lps-0.75mm.vtp")
    assert len(found.tree.leaves()) > 40
    assert len(found.notes) == 1 and "lies in the parent vessel that the lines start in" in found.notes[0]


@pytest.mark.skipif(
    not (DATA / "coronary_centerlines").exists(), reason="the real patient's centerlines are not at hand"
)
@pytest.mark.parametrize("vessel", ["rca", "lca"])
def test_coronary_lines_are_covered_but_for_the_aorta(vessel):
    found = made_of_file(DATA / "coronary_centerlines" / f"{vessel}_cl.vtp", vessel)
    assert len(found.notes) == 1 and "lies in the parent vessel that the lines start in" in found.notes[0]
