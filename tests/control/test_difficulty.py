"""How hard a patient is: shapes of routes, arch types, and what a navigation is expected to take."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from endopilot.atlas.atlas import AtlasConfig, make_patient, make_patient_tree
from endopilot.control.difficulty import NAVIGATIONS_FILE, Shape, arch_type, assess_difficulty, expected
from endopilot.devices.device import read_wire
from endopilot.tasks.route import Route
from endopilot.types import Branch, VesselTree
from toy_evaluation import LENGTH_MM, RADIUS_MM, make_anatomy


def test_a_route_s_shape_is_that_of_its_line():
    """The tube lies on x = −s²/200 at depth s: its direction turns by atan(s/100) from the first chord to the last."""
    anatomy = make_anatomy()
    shape = Shape.of(Route.to(anatomy, anatomy.target("2", depth_mm=19.9)))
    first, last = (np.degrees(np.arctan(middle / 100)) for middle in (2.5, LENGTH_MM - 2.5))
    assert shape.turning_deg == pytest.approx(last - first, abs=0.2)
    assert (round(shape.length_mm), shape.forks) == (40, 0)


def test_each_section_is_told_once_and_the_near_one_is_easier():
    wire = read_wire("workhorse-014")
    near, far = assess_difficulty(make_anatomy(), wire)
    assert (near["section"], far["section"]) == ("1", "2")
    assert near["bore_mm"] == pytest.approx(2 * RADIUS_MM - wire.diameter_mm)
    for measure in ("exposures", "seconds"):
        assert near[measure] < far[measure]
        assert near[f"{measure}_from"] < near[measure] < near[f"{measure}_to"]


def test_behind_a_place_narrower_than_the_wire_nothing_is_expected():
    anatomy = make_anatomy()
    branch = anatomy.tree.branches[0]
    radius = np.where(np.arange(81) == 30, 0.1, branch.centerline.radius)
    tree = VesselTree((Branch(replace(branch.centerline, radius=radius), -1, branch.section),), ("1", "2"))
    rows = {row["section"]: row for row in assess_difficulty(replace(anatomy, tree=tree), read_wire("workhorse-014"))}
    assert rows["1"]["seconds"] > 0
    assert rows["2"]["seconds"] is None and rows["2"]["bore_mm"] < 0


REAL = (
    *((140.4, 379, 4, 7, 13.5), (75.4, 271, 1, 6, 7.5), (108.4, 469, 1, 9, 11.0), (129.9, 283, 3, 8, 13.0)),
    *((46.6, 105, 2, 3, 5.0), (84.3, 190, 3, 9, 8.5), (82.6, 222, 2, 5, 9.5), (52.7, 168, 2, 5, 6.5)),
    *((81.5, 219, 1, 6, 8.0), (30.3, 105, 0, 3, 3.0), (69.1, 201, 2, 7, 8.0), (121.4, 531, 2, 6, 12.5)),
    *((74.5, 263, 3, 5, 10.0), (102.8, 264, 3, 7, 10.0), (60.4, 152, 1, 5, 6.5), (183.6, 749, 2, 12, 19.0)),
)
"""Length, mm, turning, degrees, forks, exposures and seconds of the agent's navigations in real coronary arteries that
the model has not seen: `python -m benchmarks coronary-navigation PATIENT... --config.world nominal` printed them."""
TOLD = [expected(Shape(length, float(turning), forks)) for length, turning, forks, *_ in REAL]


@pytest.mark.parametrize(("measure", "column"), [("exposures", 3), ("seconds", 4)])
def test_intervals_hold_in_real_arteries(measure, column):
    truth = np.array([row[column] for row in REAL])
    inside = [
        each[f"{measure}_from"] <= value <= each[f"{measure}_to"] for each, value in zip(TOLD, truth, strict=True)
    ]
    assert np.mean(inside) >= 0.7  # intervals of 80 %


def test_expected_seconds_in_real_arteries_beat_the_mean_of_the_ladder():
    truth = np.log([row[4] for row in REAL])
    table = np.genfromtxt(str(files("endopilot.control") / NAVIGATIONS_FILE), delimiter=",", names=True, dtype=None)
    errors = np.abs(truth - np.log([each["seconds"] for each in TOLD]))
    assert errors.mean() < 0.5 * np.abs(truth - np.log(table["seconds"]).mean()).mean()


def test_ways_that_are_longer_than_the_ladder_s_are_extrapolated():
    rows = assess_difficulty(make_patient(AtlasConfig(vessel="arch", seed=5), 0), read_wire("j-035"))
    assert [row["extrapolated"] for row in rows] == [row["length_mm"] > 241 for row in rows] == [False] * 5 + [True] * 3


def test_an_arch_is_of_the_type_that_was_drawn():
    """Types of synthetic arches: the drawn drop is in diameters of a healthy artery, read from the lumen as it is."""
    drawn = [make_patient_tree(AtlasConfig(vessel="arch", seed=11), index) for index in range(20)]
    right = [arch_type(tree) == about["arch_type"] for tree, about in drawn]
    assert sum(right) >= 18
    assert arch_type(make_anatomy().tree) is None
