"""Dominance from both coronary arteries together, and sections that agree with it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.labels import dominance as tree_dominance
from endopilot.anatomy.labels import label_tree
from endopilot.anatomy.labels_tree import LCA_SECTIONS
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.vessels.coronary_ostia import CRUX_FROM_OSTIUM_MM, Crux, find_crux
from endopilot.vessels.sources import Polylines

OSTIUM = np.array([5.0, -7.0, 3.0])
CRUX = OSTIUM + CRUX_FROM_OSTIUM_MM


def beside(place, left, back, up):
    return place + np.array([left, back, up], dtype=float)


def polyline(*corners):
    """Straight pieces through the corners, in steps of about 1 mm, of radius 1.5 mm."""
    corners = np.array(corners, dtype=float)
    pieces = [corners[:1]]
    for start, end in itertools.pairwise(corners):
        count = round(float(np.linalg.norm(end - start)))
        pieces.append(start + np.linspace(0.0, 1.0, count + 1)[1:, None] * (end - start))
    return np.concatenate(pieces)


def tree_of_line(points):
    return tree_from_lines([Line(points, np.full(len(points), 1.5), -1, 0)])


def right_artery(*beyond):
    """Round the right border of the heart to the crux and on."""
    return polyline(OSTIUM, beside(OSTIUM, -35.0, -15.0, -20.0), beside(OSTIUM, -25.0, 0.0, -50.0), CRUX, *beyond)


@pytest.mark.parametrize(("right", "left", "dominance"), [(5, 40, "right"), (40, 5, "left"), (5, 5, "balanced")])
def test_the_artery_that_reaches_the_crux_is_dominant(right, left, dominance):
    trees = [polyline(OSTIUM, OSTIUM + (1.0 - gap / 62.7) * CRUX_FROM_OSTIUM_MM) for gap in (right, left)]
    found = find_crux(OSTIUM, *trees)
    assert found is not None and found.dominance == dominance
    np.testing.assert_array_equal(found.position, CRUX)


def test_arteries_that_end_before_the_crux_leave_dominance_open():
    assert (
        find_crux(
            OSTIUM, polyline(OSTIUM, beside(OSTIUM, 0.0, 0.0, -20.0)), polyline(OSTIUM, beside(OSTIUM, 30.0, 0, 0))
        )
        is None
    )


@pytest.mark.parametrize(
    ("beyond", "last"),
    [(CRUX + np.array([15.0, -30.0, -10.0]), "4"), (CRUX + np.array([35.0, 5.0, 0.0]), "16")],
    ids=["forwards to the apex", "on to the left"],
)
def test_what_lies_beyond_the_crux_is_named_by_where_it_goes(beyond, last):
    tree = label_tree(tree_of_line(right_artery(beyond)), "rca", crux=Crux(CRUX, "right"))
    assert tree.sections_present == ("1", "2", "3", last)
    line, names = tree.branches[0].centerline, np.array(tree.section_names)[tree.branches[0].section]
    crux_mm = line.abscissa[np.linalg.norm(line.points - CRUX, axis=1).argmin()]
    assert abs(line.abscissa[names == last].min() - crux_mm) < 2.0


@pytest.mark.parametrize(("length", "sections"), [(36, ("1",)), (70, ("1", "2"))])
def test_an_artery_that_ends_before_the_crux_has_the_segments_of_its_length(length, sections):
    piece = right_artery()[:length]
    assert label_tree(tree_of_line(piece), "rca", crux=Crux(CRUX, "left")).sections_present == sections


def test_an_artery_of_35_mm_is_its_first_segment_and_leaves_dominance_open():
    stump = right_artery()[:36]
    lines = Polylines((stump,), (np.full(36, 1.5),))
    anatomy = extract_anatomy(lines, name="stump", config=AnatomyConfig(vessel="rca"))
    assert anatomy.tree.sections_present == ("1",)
    assert anatomy.provenance["dominance"] is None
    assert any("only 35 mm long" in note for note in anatomy.provenance["notes"])


def left_tree():
    """Left main, LAD to the apex, LCx round the groove to the crux, beyond it 25 mm forwards."""
    ostium = beside(OSTIUM, 14.0, 28.0, 16.0)
    fork, apex = beside(ostium, 10.0, -3.0, 0.0), beside(ostium, 50.0, -60.0, -70.0)
    lad = polyline(ostium, fork, apex)
    around = beside(fork, 30.0, 25.0, -25.0)
    lcx = polyline(lad[10], around, beside(CRUX, 3.0, 3.0, 0.0), beside(CRUX, 10.0, -22.0, -8.0))
    lines = [Line(lad, np.full(len(lad), 1.5), -1, 0), Line(lcx, np.full(len(lcx), 1.4), 0, 10)]
    return tree_from_lines(lines)


@pytest.mark.parametrize(("dominance", "present"), [("left", True), ("balanced", True), ("right", False)])
def test_a_left_posterior_descending_is_named_only_where_the_left_artery_supplies_the_crux(dominance, present):
    sections = label_tree(left_tree(), "lca", crux=Crux(CRUX, dominance)).sections_present
    assert ("15" in sections) is present and {"5", "11", "13"} <= set(sections)


@pytest.mark.parametrize(
    ("course", "section", "missing"),
    [((50.0, -60.0, -70.0), "7", "circumflex"), ((35.0, 45.0, -45.0), "13", "anterior descending")],
    ids=["forwards to the apex", "round the back"],
)
def test_a_left_artery_that_does_not_fork_is_no_left_main_from_end_to_end(course, section, missing):
    line = polyline(OSTIUM, beside(OSTIUM, 10.0, 0.0, 0.0), beside(OSTIUM, *course))
    lines = Polylines((line,), (np.full(len(line), 1.5),))
    anatomy = extract_anatomy(lines, name="piece", config=AnatomyConfig(vessel="lca"))
    branch = anatomy.tree.branches[0]
    names = np.array(anatomy.tree.section_names)[branch.section]
    assert branch.centerline.abscissa[names == "5"].max() < 15.0 and section in names
    assert any(f"the {missing} artery is missing" in note for note in anatomy.provenance["notes"])
    assert anatomy.provenance["dominance"] is None


def test_segment_16_is_the_right_arterys_alone_and_the_ramus_is_17():
    lad = polyline(OSTIUM, beside(OSTIUM, 10.0, 0.0, 0.0), beside(OSTIUM, 50.0, -60.0, -70.0))
    lcx = polyline(lad[10], beside(lad[10], 30.0, 25.0, -25.0))
    ramus = polyline(lad[10], beside(lad[10], 35.0, -10.0, -25.0))
    lines = [
        Line(points, np.full(len(points), 1.4), *on)
        for points, on in ((lad, (-1, 0)), (lcx, (0, 10)), (ramus, (0, 10)))
    ]
    assert {"5", "17"} <= set(label_tree(tree_from_lines(lines), "lca").sections_present)
    assert "16" not in LCA_SECTIONS


def test_a_right_artery_that_reaches_the_crux_without_its_branches_leaves_dominance_open():
    whole = label_tree(tree_of_line(right_artery()), "rca")
    assert not {"4", "16"} & set(whole.sections_present)
    assert whole.longest_path().abscissa[-1] > 120.0 and tree_dominance(whole) is None


@pytest.mark.parametrize(("kind", "asked"), [("rca", "lca"), ("lca", "rca"), ("rca", "rca"), ("lca", "lca")])
def test_lines_of_the_other_artery_are_noted(kind, asked):
    tree, _ = make_patient_tree(AtlasConfig(vessel=kind, seed=5), 0)
    notes = extract_anatomy(tree, config=AnatomyConfig(vessel=asked)).provenance["notes"]
    runs = [note for note in notes if "runs as a" in note]
    found = "right" if kind == "rca" else "left"
    assert bool(runs) == (kind != asked) and all(f"as a {found} coronary artery does" in note for note in runs)
