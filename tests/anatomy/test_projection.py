"""Tip projection against brute force and across bifurcations."""

from __future__ import annotations

import itertools

import numpy as np
from analytic_shapes import forked_tree

from endopilot.anatomy.projection import project_tip
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


def test_agrees_with_brute_force():
    tree = forked_tree()
    points = np.random.default_rng(0).uniform((-2, -1, 1), (8, 1, 30), (4000, 3))
    exact = brute_force(tree, points)
    inside = exact[1] < 1.5
    found = project_tip(tree, INSERTION, points)
    assert np.allclose(found.abscissa[inside], exact[0][inside], atol=1e-9)
    assert np.allclose(found.offset[inside], exact[1][inside], atol=1e-9)
    assert np.array_equal(found.branch[inside], exact[2][inside])


def test_moves_continuously_from_the_catheter_into_a_branch():
    tree = forked_tree()
    aside = tree.path(2).points
    way = np.concatenate([np.outer(np.linspace(-8, 0, 81), [0, 0, 1.0]), aside])
    fine = np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in itertools.pairwise(way)])
    found = project_tip(tree, INSERTION, fine)
    step = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    assert found.abscissa[0] == -8.0
    assert np.abs(np.diff(found.abscissa) - step).max() < 0.05
    assert found.offset.max() < 1e-9
    assert found.branch[-1] == 2


def test_wall_of_a_wide_vessel_is_not_given_to_a_thin_neighbour():
    tree = forked_tree(angle_deg=5.0, radius=(2.0, 0.4))
    point = np.array([[1.2, 0.0, 28.0]])
    found = project_tip(tree, INSERTION, point)
    # The thin branch passes 0.5 mm away, outside of its own lumen; the wide vessel's axis is 1.2 mm away.
    assert found.branch[0] == 1
    assert abs(found.offset[0] - 1.2) < 1e-9
    assert found.radius[0] == 2.0


def test_shapes_follow_the_points():
    found = project_tip(forked_tree(), INSERTION, np.tile([0.5, 0, 10.0], (3, 5, 1)))
    assert found.abscissa.shape == found.branch.shape == (3, 5)
    assert np.allclose(found.abscissa, 10.0) and np.allclose(found.offset, 0.5)
    assert project_tip(forked_tree(), INSERTION, np.array([0.0, 0, -3.0])).abscissa == -3.0
