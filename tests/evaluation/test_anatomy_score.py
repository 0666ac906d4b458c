"""Scores of segmentation on cases made by hand, whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.anatomy.distance import distance_map_from_spheres
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.evaluation.anatomy_score import cl_dice, compare_trees, score_anatomy
from endopilot.types import Anatomy, Insertion, LumenMask, VesselTree, Volume


def line(begin, end, radius: float, parent: int = -1, place: int = 0) -> Line:
    count = round(np.linalg.norm(np.subtract(end, begin)) / 0.5) + 1
    return Line(np.linspace(begin, end, count), np.full(count, radius), parent, place)


def straight(*lines: Line) -> VesselTree:
    return tree_from_lines(list(lines))


TRUTH = straight(line((0, 0, 0), (0, 0, 40), 1.5))


def test_the_same_tree_agrees_wholly():
    same = compare_trees(TRUTH, TRUTH)
    assert (same.overlap, same.radius_mae_mm, same.false_length_mm) == (1.0, 0.0, 0.0)
    assert same.inside_accuracy_mm == pytest.approx(0.0, abs=1e-9)


def test_a_shifted_wider_line_is_inside_by_its_shift():
    agreement = compare_trees(straight(line((0.4, 0, 0), (0.4, 0, 40), 1.7)), TRUTH)
    assert agreement.overlap == 1.0
    assert agreement.inside_accuracy_mm == pytest.approx(0.4, abs=1e-6)
    assert agreement.radius_mae_mm == pytest.approx(0.2, abs=1e-6)


def test_a_line_that_stops_early_covers_its_share():
    # 20 of 40 mm are extracted; true points up to one radius, 1.5 mm, beyond its end are found as well.
    agreement = compare_trees(straight(line((0, 0, 0), (0, 0, 20), 1.5)), TRUTH)
    assert agreement.overlap == pytest.approx((20 + 21.5) / (20 + 40), abs=0.01)
    assert agreement.false_length_mm == 0.0


def test_the_longest_false_piece_counts():
    main = line((0, 0, 0), (0, 0, 40), 1.5)
    twigs = (line((0, 0, 10), (12, 0, 10), 1.0, 0, 20), line((0, 0, 30), (5, 0, 30), 1.0, 0, 60))
    agreement = compare_trees(straight(main, *twigs), TRUTH)
    assert agreement.false_length_mm == pytest.approx(12 - 1.5, abs=0.3)
    assert agreement.overlap == pytest.approx(1 - (10.5 + 3.5) / (80 + 17), abs=0.01)


def test_thin_vessels_are_not_scored_but_are_not_false_either():
    thin = straight(line((0, 0, 0), (0, 0, 40), 1.5), line((0, 0, 20), (20, 0, 20), 0.5, 0, 40))
    assert compare_trees(TRUTH, thin).overlap == 1.0
    both = compare_trees(thin, thin)
    assert (both.overlap, both.false_length_mm) == (1.0, 0.0)


def test_cl_dice_of_a_rod_half_found_and_one_that_goes_astray():
    truth, skeleton = np.zeros((5, 5, 20), dtype=bool), np.zeros((5, 5, 20), dtype=bool)
    truth[1:4, 1:4], skeleton[2, 2] = True, True
    half, half_skeleton = truth.copy(), skeleton.copy()
    half[..., 10:] = half_skeleton[..., 10:] = False
    assert cl_dice(truth, truth, skeleton, skeleton) == 1.0
    # Precision 1, sensitivity 1/2.
    assert cl_dice(half, truth, half_skeleton, skeleton) == pytest.approx(2 / 3)
    # A skeleton in which a quarter lies outside the truth, of a mask that covers it: precision 3/4, sensitivity 1.
    stray = skeleton.copy()
    stray[2, 2, :5], stray[0, 0, :5] = False, True
    assert cl_dice(np.ones_like(truth), truth, stray, skeleton) == pytest.approx(2 * 0.75 / 1.75)


def anatomy(tree: VesselTree, shift_mm: float = 0.0) -> Anatomy:
    ostium = Insertion(np.array([shift_mm, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    return Anatomy("made by hand", tree, distance_map_from_spheres(tree, spacing_mm=0.3), ostium, 0.9)


def mask(radius: float, end: float = 40.0) -> LumenMask:
    k, j, i = np.indices((160, 26, 26))
    across, along = np.hypot(i - 12.4, j - 12.4) * 0.3, k * 0.3 - 4.0
    inside = (across < radius) & (along > 0) & (along < end)
    return LumenMask(Volume(inside, np.full(3, 0.3), np.array([-3.72, -3.72, -4.0]), np.eye(3)))


def test_masks_are_scored_by_their_voxels():
    truth = anatomy(TRUTH)
    good = score_anatomy(mask(1.5), truth, truth)
    assert good.dice > 0.97 and good.cldice > 0.97
    # A disc of half the area in one of the full: 2·½ / 1½.
    thin = score_anatomy(mask(1.5 / np.sqrt(2)), truth, truth)
    assert thin.dice == pytest.approx(2 / 3, abs=0.05) and thin.cldice > 0.95
    half = score_anatomy(mask(1.5, 20.0), truth, truth)
    assert half.dice == pytest.approx(2 / 3, abs=0.02)
    assert half.cldice == pytest.approx(2 / 3, abs=0.03)


def test_the_ostium_error_is_the_distance_of_the_ostia():
    assert score_anatomy(mask(1.5), anatomy(TRUTH, 0.7), anatomy(TRUTH)).ostium_error_mm == pytest.approx(0.7)
