"""Tip projection against brute force and across bifurcations."""

from __future__ import annotations

import numpy as np

from benchmarks.anatomy.analytic_lumens import forked_tree, tree_of
from endopilot.anatomy.projection import project_tip, safety_ratio
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.types import Insertion

INSERTION = Insertion(np.zeros(3), np.array([0.0, 0, 1]))


def brute_force(tree, points):
    """Least offset over radius of all segments of all branches, one by one."""
    best = np.full(len(points), np.inf)
    result = np.zeros((3, len(points)))
    for index, branch in enumerate(tree.branches):
        line = branch.centerline
        offset, abscissa, radius = np.full(len(points), np.inf), np.zeros(len(points)), np.ones(len(points))
        for i in range(len(line.points) - 1):
            axis = line.points[i + 1] - line.points[i]
            share = np.clip((points - line.points[i]) @ axis / (axis @ axis), 0, 1)
            gap = np.linalg.norm(points - line.points[i] - share[:, None] * axis, axis=1)
            nearer = gap < offset
            offset[nearer] = gap[nearer]
            abscissa[nearer] = (line.abscissa[i] + share * np.linalg.norm(axis))[nearer]
            radius[nearer] = (line.radius[i] + share * (line.radius[i + 1] - line.radius[i]))[nearer]
        better = offset / radius < best
        best[better] = (offset / radius)[better]
        result[:, better] = np.stack([abscissa, offset, np.full(len(points), index)])[:, better]
    return result


def test_a_point_is_projected_to_the_same_bits_whatever_the_others():
    tree = forked_tree()
    points = np.random.default_rng(1).uniform((-2, -1, -4), (8, 1, 30), (500, 3))  # behind the ostium too
    together = project_tip(tree, INSERTION, points)
    for name in ("abscissa", "offset", "branch", "radius"):
        alone = [getattr(project_tip(tree, INSERTION, point), name) for point in points[:100]]
        assert np.array_equal(alone, getattr(together, name)[:100])


def test_shapes_follow_the_points():
    found = project_tip(forked_tree(), INSERTION, np.tile([0.5, 0, 10.0], (3, 5, 1)))
    assert found.abscissa.shape == found.branch.shape == (3, 5)
    assert np.allclose(found.abscissa, 10.0) and np.allclose(found.offset, 0.5)
    assert project_tip(forked_tree(), INSERTION, np.array([0.0, 0, -3.0])).abscissa == -3.0


def test_agrees_with_brute_force_on_a_whole_tree():
    tree, _ = make_patient_tree(AtlasConfig(seed=3), 0)
    rng = np.random.default_rng(0)
    centre, size = (np.concatenate([getattr(b.centerline, n) for b in tree.branches]) for n in ("points", "radius"))
    chosen = rng.integers(0, len(centre), 1500)
    points = centre[chosen] + 0.4 * size[chosen, None] * rng.normal(size=(1500, 3))
    start = tree.branches[0].centerline.points
    insertion = Insertion(start[0], (start[1] - start[0]) / np.linalg.norm(start[1] - start[0]))
    points = points[(points - start[0]) @ insertion.direction > 0.5]
    found, exact = project_tip(tree, insertion, points), brute_force(tree, points)
    lines = [tree.branches[int(index)].centerline for index in exact[2]]
    ratio = np.array([np.interp(at, own.abscissa, own.radius) for at, own in zip(exact[0], lines, strict=True)])
    depth, least = found.offset / found.radius, exact[1] / ratio
    inside = least < 1.0
    # nearest places on a polyline and on its turning planes differ by the corners alone
    assert np.abs(depth - least)[inside].max() < 0.02
    assert (found.branch == exact[2])[inside].mean() > 0.99
    same = inside & (found.branch == exact[2])
    assert np.quantile(np.abs(found.abscissa - exact[0])[same], 0.99) < 0.2


def test_abscissa_follows_a_bend_smoothly_and_exactly():
    bend, step = 5.0, 0.5
    angle = np.arange(0.0, 2.0, step / bend)
    line = bend * np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1)
    tree, insertion = tree_of((line, 2.0, -1)), Insertion(np.zeros(3), np.array([1.0, 0, 0]))
    fine = np.linspace(0.05, angle[-1] - 0.05, 20_001)
    for off in (-1.5, 0.0, 1.5):  # outwards, on the axis and inwards of the bend
        radius = bend - off
        points = np.stack([radius * np.sin(fine), 0 * fine, bend - radius * np.cos(fine)], axis=1)
        found = project_tip(tree, insertion, points)
        assert np.abs(found.abscissa - bend * fine).max() < 0.01
        speed = np.diff(found.abscissa) / (bend * np.diff(fine))
        assert speed.min() > 0.95 and speed.max() < 1.05  # neither a jump nor a halt at any vertex
        assert np.abs(found.offset - abs(off)).max() < 0.01


def test_abscissa_is_continuous_across_the_ostium_and_joints_off_the_axis():
    tree = forked_tree()
    way = np.linspace(-3.0, 30.0, 3301)
    points = np.stack([0 * way, np.full(len(way), 1.5), way], axis=1)
    for direction in ([0.0, 0.0, 1.0], [0.0, 0.15, np.sqrt(1 - 0.15**2)], [0.0, -0.15, np.sqrt(1 - 0.15**2)]):
        found = project_tip(tree, Insertion(np.zeros(3), np.array(direction)), points)
        assert np.abs(np.diff(found.abscissa)).max() < 0.05
        assert np.diff(found.abscissa).min() >= 0.0


def test_a_step_into_a_branch_is_no_longer_than_the_shortcut():
    tree = forked_tree()
    rng = np.random.default_rng(1)
    for _ in range(20):
        start = np.array([0.0, 0, 15]) + rng.uniform(-1.0, 1.0, 3)
        end = np.array([6.0, 0, 23.5]) + rng.uniform(-0.6, 0.6, 3)
        share = np.linspace(0.0, 1.0, 2001)[:, None]
        found = project_tip(tree, INSERTION, (1 - share) * start + share * end)
        jump = np.abs(np.diff(found.abscissa))
        change = np.flatnonzero(np.diff(found.branch))
        assert found.branch[-1] == 2 and np.delete(jump, change).max() < 0.02
        assert (jump[change] <= found.offset[change] + found.offset[change + 1] + 0.02).all()


def test_the_safety_ratio_is_the_share_of_the_room_between_centerline_and_wall():
    offset, radius = np.array([0.0, 0.75, 1.32, 1.4]), np.full(4, 1.5)
    np.testing.assert_allclose(safety_ratio(offset, radius, 0.18), [0.0, 0.75 / 1.32, 1.0, 1.4 / 1.32])
    np.testing.assert_allclose(safety_ratio(offset, radius, 0.0), offset / 1.5)
    # Where the wire fills the lumen, the wall is reached wherever the wire lies.
    assert safety_ratio(np.array([0.0, 0.1]), np.array([0.18, 0.1]), 0.18).tolist() == [1.0, 1.0]
    assert np.isnan(safety_ratio(np.array([np.nan, 0.1]), np.array([0.1, np.nan]), 0.18)).all()
