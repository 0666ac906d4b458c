"""Synthetic patients: their statistics against the published ones, their trees, their determinism."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.anatomy.distance import sample
from endopilot.atlas import curves as shape
from endopilot.atlas.atlas import AtlasConfig, make_atlas, make_patient, make_patient_tree
from endopilot.atlas.branching import Vessel, lumens_collide
from endopilot.lines import length_along

COUNT = 60


@pytest.fixture(scope="module")
def patients():
    config = AtlasConfig(seed=11, population="textbook")
    return [make_patient_tree(config, index) for index in range(COUNT)]


def assert_mean(values, mean, sd):
    """The sample mean lies within 2.5 standard errors of the published mean, the error taken from the published SD."""
    assert abs(np.mean(values) - mean) <= 2.5 * sd / np.sqrt(len(values))


def test_course_statistics_match_the_published_ones(patients):
    paths = [tree.longest_path().points for tree, _ in patients]
    lengths = np.array([length_along(points)[-1] for points in paths])
    assert_mean(lengths, 164, 30)
    assert lengths.min() > 111 and lengths.max() < 224
    assert_mean([shape.tortuosity(points) for points in paths], 2.07, 0.23)
    assert_mean([shape.curvature(points).mean() for points in paths], 0.061, 0.017)
    assert_mean([np.quantile(shape.curvature(points), 0.9) for points in paths], 0.11, 0.04)
    assert 20 < lengths.std() < 36


@pytest.mark.parametrize(("share", "diameter"), [(0.1, 4.0), (0.2, 3.8), (0.5, 3.5), (0.7, 2.7), (0.9, 2.3)])
def test_diameters_along_the_artery_match_the_published_ones(patients, share, diameter):
    paths = [tree.longest_path() for tree, _ in patients]
    found = [2 * np.interp(share * path.abscissa[-1], path.abscissa, path.radius) for path in paths]
    assert_mean(found, diameter, 0.6)
    assert np.std(found) <= 0.6


@pytest.mark.parametrize(("section", "diameter"), [("1", 3.9), ("2", 3.4), ("3", 3.1), ("4", 2.2)])
def test_diameters_of_segments_agree_with_dodge(patients, section, diameter):
    # The two published sets contradict each other by up to 0.4 mm; the atlas follows the diameters along the artery.
    found = []
    for tree, truth in patients:
        number = tree.section_names.index(section)
        radii = [b.centerline.radius[b.section == number] for b in tree.branches]
        if truth["dominance"] == "right":
            found.append(2 * np.mean(np.concatenate(radii)))
    assert abs(np.mean(found) - diameter) <= 0.45


@pytest.mark.parametrize(("section", "mean", "sd"), [("conus", 15, 6), ("SA", 16, 6), ("AM", 42, 8)])
def test_branches_leave_at_the_published_places(patients, section, mean, sd):
    origins = []
    for tree, _ in patients:
        number = tree.section_names.index(section)
        origins += [b.centerline.abscissa[0] for b in tree.branches if np.all(b.section == number)]
    assert len(origins) > 0.4 * COUNT
    assert_mean(origins, mean, sd)


def test_sections_follow_dominance(patients):
    drawn = {truth["dominance"] for _, truth in patients}
    assert "right" in drawn
    for tree, truth in patients:
        names = {tree.section_names[i] for branch in tree.branches for i in branch.section}
        expected = {"right": {"4", "16"}, "left": set()}.get(truth["dominance"])
        if expected is not None:
            assert names & {"4", "16"} == expected
        assert {"1", "2", "3"} <= names


def test_lumens_keep_apart():
    straight = np.stack([np.arange(0, 60, 0.5), np.zeros(120), np.zeros(120)], axis=1)
    radius = np.full(120, 1.5)
    back = np.concatenate(
        [straight, np.stack([59.5 - np.arange(0, 60, 0.5), np.full(120, 3.2), np.zeros(120)], axis=1)]
    )
    assert not lumens_collide([Vessel(straight, radius, ())])
    assert lumens_collide([Vessel(back, np.full(240, 1.5), ())])
    assert not lumens_collide([Vessel(back, np.full(240, 1.0), ())])


def test_anatomy_holds_lumen_and_catheter():
    (anatomy,) = make_atlas(config=AtlasConfig(seed=2, stenosis_share=1.0))
    path = anatomy.tree.longest_path()
    depth = sample(anatomy.distance_map, path.points)
    # Linear interpolation on the grid rounds off the ridge on the axis.
    assert 0 < np.median(path.radius - depth) < 0.2
    behind = anatomy.insertion.position - np.outer(np.arange(2.0, 18.0), anatomy.insertion.direction)
    tube = sample(anatomy.distance_map, behind)
    # Half a grid cell's diagonal across the axis is what linear interpolation rounds off there.
    rounded = 0.75 * anatomy.distance_map.spacing_mm
    assert anatomy.catheter_radius_mm - rounded < tube.min() and tube.max() < anatomy.catheter_radius_mm + 0.02
    assert anatomy.insertion.direction @ (path.points[4] - path.points[0]) > 0
    (stenosis,) = anatomy.provenance["stenoses"]
    here = np.interp(stenosis["abscissa_mm"], path.abscissa, path.radius)
    before = np.interp(stenosis["abscissa_mm"] - stenosis["length_mm"], path.abscissa, path.radius)
    assert here < 0.85 * before
    assert make_patient(AtlasConfig(seed=2, stenosis_share=1.0), 0).name == anatomy.name


def test_curves_against_closed_forms():
    turn = np.linspace(0, np.pi, 200)
    circle = np.stack([20 * np.cos(turn), 20 * np.sin(turn), np.zeros(200)], axis=1)
    np.testing.assert_allclose(shape.curvature(circle)[2:-2], 1 / 20, rtol=1e-3)
    assert shape.tortuosity(circle) == pytest.approx(np.pi / 2, rel=1e-3)
    normals = shape.parallel_normals(shape.tangents(circle), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (200, 1)), atol=1e-12)
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], axis=1)
    bent = shape.bend(line, np.array([0.0, 0.0, 1.0]), 1.2)
    # Tangents that turn in proportion to the length make a circle's arc of radius length / angle.
    np.testing.assert_allclose(shape.curvature(bent)[2:-2], 1.2 / 99, rtol=1e-3)


def test_side_branches_stay_outside_the_heart():
    def depth(points):
        return 30.0 - np.linalg.norm(points, axis=1)

    along, down = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])
    curve = shape.steer(np.array([33.0, 0.0, 0.0]), along, [(0.0, down)], 60.0, 7.0, depth)
    height = np.linalg.norm(curve, axis=1) - 30.0
    assert height.min() > 0.5 and height.max() < 9
