"""Where coronary arteries begin, in lumens without an aorta, and what the crux of the heart tells."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial import KDTree

from benchmarks.anatomy.analytic_lumens import mask_of
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.labels import dominance as tree_dominance
from endopilot.anatomy.labels import label_tree
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume
from endopilot.types import Insertion, LumenMask
from endopilot.vessels.coronary_inlet import coronary_inlet
from endopilot.vessels.coronary_ostia import CRUX_FROM_OSTIUM_MM, Crux, end_score, find_crux, rank_ostia
from endopilot.vessels.ends import open_ends, skeleton_of
from endopilot.vessels.inlet import component, entrance, grid_points
from endopilot.vessels.sources import Polylines
from endopilot.vessels.surface import Surface, distance_map_from_surface, surface_from_mask
from toy_coronaries import PLACE_MM, artery, mask_of_arteries, without

REAL = Path(__file__).parents[3] / "shared" / "data" / "real_coronaries"


@pytest.fixture(scope="module")
def both():
    return mask_of_arteries(artery("rca"), artery("lca"))


@pytest.fixture(scope="module")
def right_alone():
    return mask_of_arteries(artery("rca"))


def test_each_artery_is_found_in_a_mask_of_both_with_crumbs_and_in_its_surface(both):
    voxels = both.volume.voxels.copy()
    voxels[2:5, 2:5, 2:5] = True
    for content, side in (
        (LumenMask(replace(both.volume, voxels=voxels)), "rca"),
        (surface_from_mask(both.volume), "lca"),
    ):
        found = coronary_inlet(content, side, "patient")
        assert np.linalg.norm(found.position - PLACE_MM[side]) < 4.0
        assert found.confidence > 0.9
        assert found.runner_up is not None and found.runner_up.probability < 0.1


def test_the_tree_begins_at_the_found_ostium_and_the_record_says_how_sure_it_is(both):
    def left_or_near(points):
        return (np.linalg.norm(points, axis=1) < 28) | ((points[:, 1] > 15) & (points[:, 0] > 10))

    config = AnatomyConfig(vessel="rca", spacing_mm=2.0)
    anatomy = extract_anatomy(without(both, left_or_near), name="patient", config=config)
    assert np.linalg.norm(anatomy.insertion.position) < 4.0
    assert anatomy.provenance["ostium_rule"] == "shape of the coronary arteries"
    assert 0.9 < anatomy.provenance["ostium_confidence"] <= 1.0
    assert len(anatomy.provenance["ostium_runner_up"]["position_mm"]) == 3
    assert any("right coronary artery is only" in note for note in anatomy.provenance["notes"])
    assert any("perhaps the left coronary artery" in note for note in anatomy.provenance["notes"])


@pytest.mark.parametrize("vessel", ["rca", None])
def test_a_given_ostium_five_millimetres_off_enters_at_the_open_end(right_alone, vessel):
    lumen = distance_map_from_surface(surface_from_mask(right_alone.volume), spacing_mm=0.5)
    points, clearance = grid_points(lumen, component(lumen, None))
    for offset in np.array([[5.0, 0, 0], [0, -5.0, 0], [0, 0, 5.0]]):
        found = entrance(lumen, points, clearance, Insertion(offset, np.zeros(3)), vessel)
        assert np.linalg.norm(found.position) < 4.0 and not found.direction.any()


def test_a_cone_narrows_from_its_wide_end_and_widens_from_the_narrow_one():
    def cone(points):
        height = np.clip(points[..., 2], -30.0, 30.0)
        return 1.7 - height / 60.0 - np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + (points[..., 2] - height) ** 2)

    lumen = distance_map_from_surface(surface_from_mask(mask_of(cone, (5, 5, 34), (0.5,) * 3).volume), spacing_mm=0.5)
    ends = open_ends(skeleton_of(*grid_points(lumen, lumen.values > 0), lumen.spacing_mm))
    wide, narrow = (pick(ends, key=lambda end: end.position[2]) for pick in (min, max))
    # mean of ln(u) over u from 1 to 2.2/1.2, where u is the radius over that of the narrow end
    ratio = 2.2 / 1.2
    assert abs(narrow.widening - (ratio * np.log(ratio) / (ratio - 1.0) - 1.0)) < 0.1
    assert wide.widening < 0.04
    assert wide.taper > 0.75 and narrow.taper < -0.75
    assert wide.calibre > 0.95 and narrow.calibre < 0.7
    np.testing.assert_allclose([wide.heading[2], narrow.heading[2]], [1.0, -1.0], atol=0.01)


def test_the_likeliest_pair_of_ends_wins_over_each_ends_own_score(both):
    """The end that alone looks best as a left main does not win against one at the right place."""
    lumens = [artery("rca"), artery("lca")]
    ends = [open_ends(skeleton_of(*grid_points(each, each.values > 0), each.spacing_mm)) for each in lumens]
    true = max(ends[1], key=lambda end: end_score(end, "lca"))
    away = replace(true, position=true.position + np.array([25.0, -20.0, -30.0]), calibre=1.0, taper=0.6, widening=0.0)
    ranking = rank_ostia([ends[0], [*ends[1], away]])["lca"]
    assert end_score(away, "lca") > end_score(true, "lca")
    assert np.linalg.norm(ranking.candidates[0].position - true.position) < 0.1
    assert ranking.absent + sum(candidate.probability for candidate in ranking.candidates) <= 1.0 + 1e-9


@pytest.mark.skipif(not REAL.exists(), reason="the real coronary masks are not here")
@pytest.mark.parametrize("patient", ["0002", "0134"])
def test_ostia_of_real_patients(patient):
    """A conus branch beside the ostium, and a right artery of 35 mm."""
    content = read_volume(REAL / f"{patient}.nii.gz")
    mask = LumenMask(replace(content, voxels=content.voxels > 0))
    for vessel, known in json.loads((REAL / "ostia.json").read_text())[patient].items():
        found = coronary_inlet(mask, vessel, patient)
        assert np.linalg.norm(found.position - known["near_aorta_mm"]) < 5.0
        assert found.confidence > 0.9


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


@pytest.mark.parametrize(
    ("right", "left", "dominance"), [(5, 40, "right"), (40, 5, "left"), (5, 5, "balanced"), (40, 40, None)]
)
def test_the_artery_that_reaches_the_crux_is_dominant(right, left, dominance):
    trees = [polyline(OSTIUM, OSTIUM + (1.0 - gap / 62.7) * CRUX_FROM_OSTIUM_MM) for gap in (right, left)]
    found = find_crux(OSTIUM, *trees)
    assert (found and found.dominance) == dominance
    assert found is None or np.array_equal(found.position, CRUX)


@pytest.mark.parametrize(("length", "sections"), [(36, ("1",)), (70, ("1", "2")), (None, ("1", "2", "3"))])
def test_an_artery_that_ends_at_or_before_the_crux_has_the_segments_of_its_length(length, sections):
    crux = None if length is None else Crux(CRUX, "left")
    tree = label_tree(tree_of_line(right_artery()[:length]), "rca", crux=crux)
    assert tree.sections_present == sections
    assert crux is not None or tree_dominance(tree) is None


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
    anatomy = extract_anatomy(lines, name="piece", config=AnatomyConfig(vessel="lca", spacing_mm=1.0))
    branch = anatomy.tree.branches[0]
    names = np.array(anatomy.tree.section_names)[branch.section]
    assert branch.centerline.abscissa[names == "5"].max() < 15.0 and section in names
    assert any(f"the {missing} artery is missing" in note for note in anatomy.provenance["notes"])
    assert anatomy.provenance["dominance"] is None


@pytest.mark.parametrize(("kind", "asked"), [("rca", "lca"), ("lca", "lca")])
def test_lines_of_the_other_artery_are_noted(kind, asked):
    tree, _ = make_patient_tree(AtlasConfig(vessel=kind, seed=5), 0)
    notes = extract_anatomy(tree, config=AnatomyConfig(vessel=asked, spacing_mm=2.0)).provenance["notes"]
    runs = [note for note in notes if "runs as a" in note]
    found = "right" if kind == "rca" else "left"
    assert bool(runs) == (kind != asked) and all(f"as a {found} coronary artery does" in note for note in runs)


RAS = np.array([-1.0, -1.0, 1.0])


def test_a_single_artery_in_ras_axes_is_never_taken_for_the_other_one():
    wall = surface_from_mask(mask_of_arteries(artery("lca")).volume)
    turned = Surface(wall.vertices * RAS, wall.faces)
    for asked in ("rca", "lca"):
        with pytest.raises(InputError, match="give --coordinates ras") as refused:
            coronary_inlet(turned, asked, "tree", "lps")
        assert "--vessel" not in str(refused.value)
    assert np.linalg.norm(coronary_inlet(wall, "lca", "tree", "ras").position - PLACE_MM["lca"]) < 4.0
    with pytest.raises(InputError, match="leave --coordinates ras out"):
        coronary_inlet(turned, "lca", "tree", "ras")


@pytest.mark.parametrize(
    ("turned", "exchanged"), [((1, 2), "left and right, front and back"), ((1,), "front and back")]
)
def test_a_mask_in_other_axes_names_those_that_are_exchanged(both, turned, exchanged):
    voxels = np.flip(both.volume.voxels, axis=turned).copy()
    with pytest.raises(InputError, match=f"with {exchanged} exchanged, .* mend the orientation") as refused:
        coronary_inlet(LumenMask(replace(both.volume, voxels=voxels)), "rca", "mask")
    assert "--vessel" not in str(refused.value)


def touching(mask):
    """Both arteries in one piece: a bridge where they come nearest to each other beyond their first 40 mm."""
    pieces, _ = label(mask.volume.voxels, structure=np.ones((3, 3, 3)))
    one, two = (np.argwhere(pieces == number) for number in np.argsort(-np.bincount(pieces.ravel())[1:])[:2] + 1)
    places = [mask.volume.index_to_world(index[:, ::-1].astype(float)) for index in (one, two)]
    far = [np.linalg.norm(place[:, None] - list(PLACE_MM.values()), axis=-1).min(axis=1) > 40.0 for place in places]
    gap, nearest = KDTree(places[1][far[1]]).query(places[0][far[0]])
    start, end = one[far[0]][gap.argmin()], two[far[1]][nearest[gap.argmin()]]
    voxels = mask.volume.voxels.copy()
    for share in np.linspace(0.0, 1.0, 100):
        i, j, k = np.rint(start + share * (end - start)).astype(int)
        voxels[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2] = True
    return LumenMask(replace(mask.volume, voxels=voxels))


@pytest.mark.parametrize(("held", "asked"), [("rca", "lca"), ("lca", "rca")])
def test_the_other_vessel_is_advised_only_where_it_is_then_found(right_alone, held, asked):
    mask = right_alone if held == "rca" else mask_of_arteries(artery(held))
    with pytest.raises(InputError, match=f"take --vessel {held}"):
        coronary_inlet(mask, asked, "mask")
    found = coronary_inlet(mask, held, "mask")
    assert np.linalg.norm(found.position - PLACE_MM[held]) < 4.0


def test_arteries_that_touch_are_told_as_that_and_the_place_advised_is_an_ostium(both):
    mask = touching(both)
    with pytest.raises(InputError, match="one lumen seems to hold both coronary arteries") as refused:
        coronary_inlet(mask, "lca", "mask")
    assert "--vessel" not in str(refused.value)
    advised = re.search(r"or --ostium-mm (-?\d+\.\d) (-?\d+\.\d) (-?\d+\.\d)", str(refused.value))
    place = tuple(float(value) for value in advised.groups())
    config = AnatomyConfig(vessel="lca", ostium_mm=place, spacing_mm=2.0)
    anatomy = extract_anatomy(mask, name="mask", config=config)
    assert np.linalg.norm(anatomy.insertion.position - PLACE_MM["lca"]) < 4.0
