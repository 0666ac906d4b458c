"""The route to a target: progress along it, leaving it, and targets by name, place and depth."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.anatomy.analytic_lumens import tree_of
from endopilot.anatomy.projection import project_tip
from endopilot.errors import InputError
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.route import Route, check_passable
from endopilot.tasks.targets import find_target
from endopilot.types import Branch, VesselTree


@pytest.fixture
def route(fork) -> Route:
    return Route.to(fork, Target(branch=2, abscissa=35.0))


def tips(route, *points):
    return project_tip(route.anatomy.tree, route.anatomy.insertion, np.array(points, dtype=float))


def test_a_tip_in_the_wrong_branch_has_come_as_far_as_the_junction(route):
    side = np.array([0, 0, 20.0]) + 8.0 * np.array([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    tip = tips(route, [0, 0, 12.0], [0, 0, 27.0], side)
    assert np.allclose(route.progress(tip), [12.0, 20.0, 28.0], atol=0.2)
    assert np.allclose(route.off_route(tip), [0.0, 7.0, 0.0], atol=0.2)


def test_a_waypoint_is_passed_in_the_right_branch_alone(route):
    assert np.allclose(route.junctions, [20.0])
    assert np.allclose(route.waypoints, [22.5, 35.0])  # parent's radius 1 mm and 1.5 mm beyond
    out = np.array([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    inside, beside = np.array([0, 0, 20.0]) + 5.0 * out, [0, 0, 25.0]
    tip = tips(route, inside, beside, np.array([0, 0, 20.0]) + 15.0 * out)
    assert route.passed(tip, 22.5).tolist() == [True, False, True]
    assert route.passed(tip, 35.0).tolist() == [False, False, True]


def test_a_second_rule_asks_for_a_straight_distance_too(route):
    """1.2 mm along the vessel and 0.5 mm beside it are √(1.2² + 0.5²) = 1.3 mm."""
    out, side = np.array([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)]), np.array([0.0, 1.0, 0.0])
    tip = tips(route, np.array([0, 0, 20.0]) + (15.0 - 1.2) * out + 0.5 * side)
    for near_mm, there in ((None, True), (1.35, True), (1.25, False)):
        target = replace(route.target, near_mm=near_mm)
        assert target.reached(tip[:, None]).tolist() == [there]
        assert replace(route, target=target).passed(tip, 35.0).tolist() == [there]


def test_the_waypoint_of_a_short_branch_lies_before_its_end(fork):
    """A branch of 2 mm between two forks, in a vessel of 1 mm: its end comes before 1.5 mm beyond the parent's wall."""
    axis = np.arange(0.0, 41.0)[:, None] * np.array([0.0, 0.0, 0.5])
    aside = axis * np.array([0.0, 0.0, 0.5]) + axis[:, [2]] * np.array([0.8, 0.0, 0.0])
    tree = tree_of(
        (axis, 1.0, -1), (axis[:5] + axis[-1], 1.0, 0), (axis[-1] + aside, 0.8, 0),
        (axis + axis[-1] + axis[4], 1.0, 1), (axis[-1] + axis[4] + aside, 0.8, 1),
    )  # fmt: skip
    route = Route.to(replace(fork, tree=tree), Target(branch=4, abscissa=32.0))
    assert np.allclose(route.junctions, [20.0, 22.0])
    assert np.allclose(route.waypoints, [21.0, 24.5, 32.0])


@pytest.mark.parametrize(("angle_deg", "beyond_mm"), [(60, 2.0 + 1.5), (150, 2.0 / np.sin(np.deg2rad(30)) + 1.5)])
def test_the_waypoint_of_a_branch_that_leaves_backwards_lies_outside_its_parent(fork, angle_deg, beyond_mm):
    axis = np.arange(0.0, 81.0)[:, None] * np.array([0.0, 0.0, 0.5])
    out = np.array([np.sin(np.deg2rad(angle_deg)), 0.0, np.cos(np.deg2rad(angle_deg))])
    side = axis[40] + np.arange(0.0, 61.0)[:, None] * 0.5 * out
    tree = tree_of((axis[:41], 2.0, -1), (axis[40:], 2.0, 0), (side, 1.0, 0))
    own = tree.branches[2].centerline
    route = Route.to(replace(fork, tree=tree), Target(branch=2, abscissa=float(own.abscissa[-1]) - 2.0))
    assert route.waypoints[0] - 20.0 == pytest.approx(beyond_mm, abs=0.6)


@pytest.mark.parametrize("short", [False, True])
def test_beyond_the_carina_of_a_fork_the_lumina_have_parted(fork, short):
    """A branch of radius 0.8 mm leaves one of 1 mm at 60°: they part where s sin 60° - 1 = 0.8, 2.1 mm from the fork.

    One whose radius is 3 mm, 4 / sin 60° = 4.6 mm from it; no waypoint lies beyond a target that is nearer.
    """
    axis = np.arange(0.0, 81.0)[:, None] * np.array([0.0, 0.0, 0.5])
    side = axis[40] + np.arange(0.0, 61.0)[:, None] * 0.5 * np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)])
    for radius, carina_mm in ((0.8, 1.8 / np.sin(np.pi / 3)), (3.0, 4.0 / np.sin(np.pi / 3))):
        tree = tree_of((axis[:41], 1.0, -1), (axis[40:], 1.0, 0), (side, radius, 0))
        given = Route.to(replace(fork, tree=tree), Target(branch=2, abscissa=23.0 if short else 40.0))
        beyond = given.beyond_carinas()
        deepest = given.waypoints[0] if short and carina_mm > 3.0 else max(given.waypoints[0], 20.0 + carina_mm)
        assert beyond.waypoints[0] == pytest.approx(deepest, abs=0.5) and beyond.waypoints[-1] == given.waypoints[-1]
        assert np.array_equal(beyond.junctions, given.junctions)


@pytest.mark.parametrize(("wide_mm", "narrow_from_mm"), [((0.0, 10.0), 10.0), ((35.0, 40.0), 0.0)])
def test_the_lumen_is_narrow_behind_its_last_wide_place(fork, wide_mm, narrow_from_mm):
    """More than 16 mm are wide; what lies beyond the target does not count."""
    tree = tree_of((np.arange(0.0, 81.0)[:, None] * np.array([0.0, 0.0, 0.5]), 2.0, -1))
    line = tree.branches[0].centerline
    wide = (line.abscissa >= wide_mm[0]) & (line.abscissa <= wide_mm[1])
    line = replace(line, radius=np.where(wide, 8.5, 2.0))
    tree = replace(tree, branches=(replace(tree.branches[0], centerline=line),))
    assert Route.to(replace(fork, tree=tree), Target(branch=0, abscissa=30.0)).narrow_from() == narrow_from_mm


def named(fork):
    branches = [
        Branch(branch.centerline, branch.parent, np.full(len(branch.section), index))
        for index, branch in enumerate(fork.tree.branches)
    ]
    return replace(fork, tree=VesselTree(tuple(branches), ("1", "3", "4")))


def test_targets_by_name_and_by_place(fork):
    anatomy = named(fork)
    assert find_target(anatomy.tree, "PDA") == find_target(anatomy.tree, "4")
    target = find_target(anatomy.tree, "4")
    assert target.branch == 2 and target.abscissa == pytest.approx(30.0, abs=0.5)
    point = find_target(anatomy.tree, "0.3, 0, 31.9")
    assert point.branch == 1 and point.abscissa == pytest.approx(32.0, abs=0.3)
    assert find_target(anatomy.tree, [0.3, 0.0, 31.9]) == find_target(anatomy.tree, point) == point
    beyond = anatomy.target("PDA", depth_mm=4.0)
    assert (beyond.branch, beyond.abscissa) == (2, pytest.approx(24.0))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("LAD", "no such section"),
        ("50,0,0", "nearest centerline"),
        ("1,nan,2", "finite"),
        ("1,x,2", "finite"),
        ((1.0, 2.0), "1.0,2.0; not three"),
        (Target(branch=3, abscissa=1.0), "branches 0 to 2"),
        (Target(branch=2, abscissa=1.0), "runs from 20.0"),
    ],
)
def test_targets_outside_the_tree_are_refused(fork, wire, text, part):
    with pytest.raises(InputError, match=part):
        find_target(named(fork).tree, text)
    with pytest.raises(InputError, match=part):
        Navigation(anatomy=named(fork), device=wire, target=text)


@pytest.mark.parametrize("place", ["4", [0.3, 0.0, 31.9], "0.3,0,31.9"])
def test_a_navigation_takes_a_target_by_name_and_by_place(fork, wire, place):
    anatomy = named(fork)
    navigation = Navigation(anatomy=anatomy, device=wire, target=place)
    assert navigation.target == find_target(anatomy.tree, place)
    assert replace(navigation, target="3").target == anatomy.target("3")


def test_a_lumen_narrower_than_the_wire_hides_what_lies_behind_it(fork, wire):
    branches = list(fork.tree.branches)
    line = branches[2].centerline
    radius = line.radius.copy()
    radius[20] = 0.17
    branches[2] = Branch(replace(line, radius=radius), branches[2].parent, branches[2].section)
    anatomy = replace(fork, tree=VesselTree(tuple(branches), fork.tree.section_names))
    at = float(line.abscissa[20])
    with pytest.raises(InputError, match=f"occlusion.* at {at:.1f} mm"):
        check_passable(Route.to(anatomy, Target(branch=2, abscissa=35.0)), wire)
    check_passable(Route.to(anatomy, Target(branch=2, abscissa=at - 1.0)), wire)
    check_passable(Route.to(anatomy, Target(branch=1, abscissa=35.0)), wire)


@pytest.mark.parametrize(
    ("target", "mend"),
    [
        ("0.3 0 31.9", "write it as 0.3,0,31.9"),
        ("[0.3\t-0\t31.9]", "write it as 0.3,-0,31.9"),
        ("1,2,3,4", "these are 4 numbers"),
    ],
)
def test_a_point_that_is_written_otherwise_is_told(anatomy, target, mend) -> None:
    with pytest.raises(InputError, match=re.escape(f"a point is X,Y,Z in LPS mm, three numbers with commas: {mend}")):
        find_target(anatomy.tree, target)
    x, y, z = anatomy.tree.branches[0].centerline.points[3]
    assert find_target(anatomy.tree, f"({x}, {y}, {z})") == find_target(anatomy.tree, f"{x},{y},{z}")
