"""The atlas' patients against what was measured in real ones (docs/evidence/atlas.md), and what bends do."""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest

from benchmarks.anatomy.vessel_shape import vessel_shape
from endopilot.anatomy import distance
from endopilot.anatomy.distance import distance_map_from_spheres, sample
from endopilot.atlas import curves as shape
from endopilot.atlas.atlas import AtlasConfig, make_patient, make_patient_tree
from endopilot.atlas.branching import Vessel, lumens_collide, stenoses
from endopilot.atlas.population import Draw, Population, population_of
from endopilot.atlas.variation import TIGHTEST, bent, catheter_direction, ectasia

COUNT = 32
COARSE = partial(distance_map_from_spheres, spacing_mm=3.0)
"""A wall where lines are what counts: a fine one takes most of the time."""
REAL = {
    "rca": {
        "curvature p95, 1/mm": (0.17, 0.10, 0.25),
        "curvature peaks > 0.2 in 100 mm": (0.9, 0.0, 4.3),
        "largest κ·r": (0.52, 0.31, 1.00),
        "total turn, °": (739, 373, 1050),
        "tortuosity in 20 mm, p95": (1.30, 1.14, 1.54),
        "side-branch angle, °": (52, 22, 97),
        "parent's deflection at branches, °": (19, 5, 53),
        "catheter against vessel at 10 mm, °": (34, 11, 71),
        "branches > 10 mm": (4, 1, 5),
    },
    "lca": {
        "curvature p95, 1/mm": (0.12, 0.09, 0.28),
        "largest κ·r": (0.39, 0.29, 0.62),
        "tortuosity in 20 mm, p95": (1.10, 1.05, 1.36),
        "side-branch angle, °": (44, 20, 84),
        "parent's deflection at branches, °": (23, 7, 48),
        "catheter against vessel at 10 mm, °": (28, 13, 53),
        "branches > 10 mm": (5, 3, 8),
        "LM→LCx turn, °": (48, 31, 65),
        "LM→LAD turn, °": (26, 9, 62),
        "LAD–LCx angle, °": (76, 51, 98),
        "left main's length, mm": (4.9, 1.0, 15.0),
    },
}
"""Median, 5th and 95th percentile in 14 right and 16 left coronary arteries of 19 patients."""


@pytest.fixture(scope="module")
def measured():
    """Return the quantities of `COUNT` patients of a kind, of whom every twelfth has a fine wall."""
    found = {}
    for kind in REAL:
        values = defaultdict(list)
        for index in range(COUNT):
            fine = index % 12 == 0
            wall = distance_map_from_spheres if fine else COARSE
            with patch.object(distance, "distance_map_from_spheres", wall):
                patient = make_patient(AtlasConfig(vessel=kind, seed=0), index)
            for name, own in vessel_shape(patient).items():
                if fine or name != "non-circularity":  # all else is of lines
                    values[name] += own
        found[kind] = values
    return found


@pytest.mark.parametrize(("kind", "quantity"), [(kind, name) for kind, rows in REAL.items() for name in rows])
def test_patients_resemble_real_ones(measured, kind, quantity):
    # The median lies within 0.3 of the real 90 % interval from the real median, that interval holds 60 % of the atlas'
    # values or more, and the atlas' own 90 % interval is 0.4 to 2 times as wide.
    median, low, high = REAL[kind][quantity]
    values = np.array(measured[kind][quantity])
    assert abs(np.median(values) - median) <= 0.3 * (high - low)
    assert np.mean((values >= low) & (values <= high)) >= 0.6
    spread = float(np.diff(np.quantile(values, (0.05, 0.95)))[0])
    assert 0.4 <= spread / (high - low) <= 2.0


def test_sections_are_as_far_from_round_as_real_ones(measured):
    # Real sections deviate by 0.042 and 0.038, 0.019 of it by voxels.
    for kind in REAL:
        assert 0.028 <= np.median(measured[kind]["non-circularity"]) <= 0.048


def drawing(seed, **varies):
    return Draw(np.random.default_rng(seed), 0.0, Population(**varies))


def line_and_radius(length_mm=80.0, radius=1.8):
    along = np.arange(0.0, length_mm + 0.25, shape.STEP_MM)
    return np.stack([along, np.zeros(len(along)), np.zeros(len(along))], axis=1), np.full(len(along), radius)


def test_bends_keep_lengths_and_never_fold_the_wall():
    points, radius = line_and_radius()
    varies = {"waves_deg": (4.0, 9.0), "bends_per_100_mm": 6.0, "bend_tightness": (0.5, 1.0)}
    sharpest = []
    for seed in range(30):
        moved = bent(drawing(seed, **varies), points, radius, first=20)
        np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0), axis=1), shape.STEP_MM, atol=1e-9)
        np.testing.assert_array_equal(moved[:21], points[:21])
        sharpest.append(float((shape.curvature(moved) * radius)[1:-1].max()))
    assert max(sharpest) < TIGHTEST and max(sharpest) > 0.7


def test_the_textbook_bends_nothing_and_draws_nothing():
    points, radius = line_and_radius()
    draw = Draw(np.random.default_rng(0), 0.0, population_of("rca", "textbook"))
    assert bent(draw, points, radius) is points
    tree, _ = make_patient_tree(AtlasConfig(population="textbook"), 0)
    direction, drawn = catheter_direction(draw, tree, 0.9, 30.0)
    np.testing.assert_array_equal(direction, shape.tangents(tree.branches[0].centerline.points)[0])
    assert drawn == {} and draw.generator.random() == np.random.default_rng(0).random()


def test_catheters_keep_clear_of_the_vessels_and_meet_them_at_the_drawn_angle():
    for index in range(3):
        anatomy = make_patient(AtlasConfig(seed=21), index)
        path, direction = anatomy.tree.longest_path(), anatomy.insertion.direction
        at = int(np.searchsorted(path.abscissa, 10.0))
        there = path.points[at + 1] - path.points[at - 1]
        angle = np.rad2deg(np.arccos(np.clip(direction @ there / np.linalg.norm(there), -1, 1)))
        assert angle == pytest.approx(anatomy.provenance["catheter_angle_deg"], abs=0.1)
        tube = anatomy.insertion.position - np.outer(np.arange(4.0, 29.0), direction)
        # Where the tube met another lumen, the map would be deeper than the tube is wide.
        assert sample(anatomy.distance_map, tube).max() < anatomy.catheter_radius_mm + 0.1


def test_inscribed_spheres_stay_inscribed_in_sections_that_are_not_round():
    anatomy = make_patient(AtlasConfig(seed=9, stenosis_share=0.0), 2)
    path = anatomy.tree.longest_path()
    depth = sample(anatomy.distance_map, path.points)
    # Linear interpolation on the grid rounds off the ridge on the axis.
    assert 0 < np.median(path.radius - depth) < 0.75 * anatomy.distance_map.spacing_mm
    across = np.cross(path.normals, np.gradient(path.points, axis=0))
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    rings = [
        sample(
            anatomy.distance_map, path.points + path.radius[:, None] * (np.cos(t) * path.normals + np.sin(t) * across)
        )
        for t in np.linspace(0, np.pi, 12, endpoint=False)
    ]
    # On the circle of the inscribed sphere the wall is touched at two opposite places and lies farther out elsewhere.
    assert np.median(np.min(rings, axis=0)) == pytest.approx(0.0, abs=0.06)
    assert np.median(np.max(rings, axis=0)) > 0.1


def test_tandem_stenoses_lie_apart():
    along = np.arange(0.0, 150.0, 0.5)
    both = [stenoses(drawing(seed, tandem_share=1.0), along, (0.1, 0.8)) for seed in range(20)]
    pairs = [drawn for drawn, _ in both if len(drawn) == 2]
    assert len(pairs) > 15
    assert all(12 < abs(one["abscissa_mm"] - two["abscissa_mm"]) < 40 for one, two in pairs)
    drawn, factor = stenoses(drawing(0), along, (0.1, 0.8))
    assert len(drawn) == 1 and 0.3 < 1 - factor.min() < 0.66


def test_a_narrow_fork_keeps_its_lumens_in_contact_for_longer():
    points, radius = line_and_radius()
    angle = np.deg2rad(22.0)
    side = points[60] + 0.5 * np.arange(60)[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
    vessels = [Vessel(points, radius, ()), Vessel(side, np.full(60, 1.0), (), 0, 60)]
    assert lumens_collide(vessels) and not lumens_collide(vessels, 14.0)


def test_an_ectasia_widens_a_vessel_where_it_is_recorded():
    along = np.arange(0.0, 150.0, 0.5)
    for seed in range(5):
        (drawn,), widening = ectasia(drawing(seed, ectasia_share=1.0), along)
        assert widening.max() == pytest.approx(1 + drawn["diameter_increase"], rel=0.02)
        assert along[widening.argmax()] == pytest.approx(drawn["abscissa_mm"], abs=0.5)
        beyond = np.abs(along - drawn["abscissa_mm"]) > drawn["length_mm"]
        assert np.all(widening[beyond] < 1.001) and 1.4 <= widening.max() <= 2.0
    found, widening = ectasia(drawing(0), along)
    assert found == [] and np.all(widening == 1)
