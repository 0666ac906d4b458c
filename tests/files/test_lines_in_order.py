"""Points out of order are sorted or refused as such; coarse lines are joined; jumps are cut. All of it is noted."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.anatomy.tree import tree_from_polylines
from endopilot.errors import InputError
from endopilot.vessels.sources import Polylines


def made(lines, radius=1.5, **given):
    source = Polylines(tuple(lines), tuple(np.full(len(line), radius) for line in lines))
    return tree_from_polylines(source, given.get("ostium"), "lines.vtp", given.get("vessel", "generic"))


def helix(count=240):
    turn = np.linspace(0.0, 2 * np.pi, count)
    return np.column_stack([15 * np.cos(turn), 15 * np.sin(turn), 6 * turn])


def straight(first, last, count=100):
    return np.linspace(first, last, count)


def test_points_in_another_order_than_along_the_vessel_are_sorted():
    line = helix()
    found = made([line[np.random.default_rng(3).permutation(len(line))]])
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert abs(found.tree.longest_path().abscissa[-1] - length) < 0.5
    assert any("in another order than along the vessel, and are sorted" in note for note in found.notes)


def test_two_points_that_are_swapped_are_sorted():
    line = straight([0, 0, 0], [0, 0, 60], 121)
    line[[40, 41]] = line[[41, 40]]
    found = made([line])
    assert abs(found.tree.longest_path().abscissa[-1] - 60) < 0.01
    assert any("sorted (61 mm became 60 mm)" in note for note in found.notes)


def test_points_in_no_order_are_refused_as_such_and_not_as_coarse():
    cloud = 50 * np.random.default_rng(0).random((60, 3))
    with pytest.raises(InputError, match=r"line 0: its points are not in order along a vessel .*; sort them") as error:
        made([cloud])
    assert "resample" not in str(error.value)


@pytest.mark.parametrize("line", [helix(), helix()[::-1], np.concatenate([helix(), helix()[::-1]])])
def test_points_in_order_are_left_as_they_are(line):
    assert made([line]).notes == []


def test_a_line_that_leads_there_and_back_is_one_vessel():
    line = straight([0, 0, 0], [0, 0, 60])
    found = made([np.concatenate([line, line[::-1]])])
    assert len(found.tree.branches) == 1
    assert abs(found.tree.longest_path().abscissa[-1] - 60) < 0.5


def test_one_line_through_a_whole_tree_is_that_tree():
    trunk, branch = straight([0, 0, 0], [0, 0, 60], 121), straight([0, 0, 30], [20, 0, 60])
    found = made([np.concatenate([trunk, trunk[60:][::-1], branch])])
    assert len(found.tree.leaves()) == 2 and found.notes == []


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
