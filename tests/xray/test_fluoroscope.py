"""The C-arm, by assumed errors and by images: how far off a measured tip is, or that no tip is found."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.imaging.xray import motion_error_mm, vessel_error_mm
from endopilot.anatomy.catheter_axis import turned_axis
from endopilot.errors import InputError
from endopilot.simulation.motion import Motion, draw_motion, motion_named, published_mean
from endopilot.xray import image_fluoroscope
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig
from endopilot.xray.image_fluoroscope import ImageFluoroscope

RADIUS = 0.18
PIXEL_MM = 0.308 * 765 / 1100  # at the isocenter


def located(fork, config: FluoroscopeConfig, count: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true places inside the straight vessel, along the wire there, and where they are found."""
    arm, random = Fluoroscope(fork, RADIUS, config=config), np.random.default_rng(0)
    height, turn = random.uniform(5, 15, count), random.uniform(0, 2 * np.pi, count)
    true = np.stack([0.7 * np.cos(turn), 0.7 * np.sin(turn), height], axis=1)
    along = np.array([0.0, 0.0, 1.0])
    return true, along, np.array([arm.measure(place, along, place[2], random).position for place in true])


def test_two_views_without_error_find_the_tip(fork) -> None:
    true, _, found = located(fork, FluoroscopeConfig(pixel_sd=1e-3, along_sd=1e-3), 20)
    np.testing.assert_allclose(found, true, atol=0.01)


def test_two_views_err_as_their_pixels_do(fork) -> None:
    config = FluoroscopeConfig()
    true, _, found = located(fork, config)
    off = found - true
    # along the wire both views tell the same coordinate; across it each tells one
    assert off[:, 2].std() == pytest.approx(config.along_sd * PIXEL_MM / np.sqrt(2), rel=0.2)
    assert off[:, :2].std() == pytest.approx(config.pixel_sd * PIXEL_MM, rel=0.25)
    assert np.abs(off.mean(axis=0)).max() < 0.1


def test_one_view_knows_the_depth_by_the_vessel_alone(fork) -> None:
    config = FluoroscopeConfig(biplane=False)
    true, _, found = located(fork, config)
    beam = np.array([-0.5, -np.sqrt(0.75), 0.0])  # RAO 30°
    depth = (found - true) @ beam
    assert 0.3 < depth.std() < 0.7  # as wide as the lumen is: 0.7 mm in a random direction is 0.5 mm
    across = (found - true) @ np.array([np.sqrt(0.75), -0.5, 0.0])
    assert across.std() < 0.15
    assert np.linalg.norm(found[:, :2], axis=1).max() <= 1.0 - RADIUS + 1e-6  # inside the lumen


def test_two_views_show_a_tip_outside_the_lumen_as_it_is_believed_and_say_how_well(fork) -> None:
    """The wall lies 0.82 mm from the axis for this wire; a wall that yields lets it go to 1.4 mm."""
    arm, random = Fluoroscope(fork, RADIUS), np.random.default_rng(3)
    along = np.array([0.0, 0.0, 1.0])
    seen = [arm.measure(np.array([1.4, 0.0, 12.0]), along, 12.0, random) for _ in range(200)]
    off = np.array([(tip.abscissa - 12.0, tip.offset - 1.4) for tip in seen])
    assert np.abs(off.mean(axis=0)).max() < 0.1
    np.testing.assert_allclose(off.std(axis=0), np.mean([tip.tip_sd_mm for tip in seen], axis=0), rtol=0.2)


def test_one_view_says_how_little_it_knows_of_the_offset(fork) -> None:
    """A tip before or behind the line shows on it: its γ is known to lie between 0 and the wall, and no better."""
    arm, random = Fluoroscope(fork, RADIUS, config=FluoroscopeConfig(biplane=False)), np.random.default_rng(4)
    turn = random.uniform(0, 2 * np.pi, 200)
    true = np.stack([0.7 * np.cos(turn), 0.7 * np.sin(turn), np.full(200, 12.0)], axis=1)
    seen = [arm.measure(place, np.array([0.0, 0.0, 1.0]), 12.0, random) for place in true]
    taken = np.array([tip.offset - 0.7 for tip in seen])
    off = np.array([tip.less(np.array([12.0, 0.7])) for tip in seen]) / [tip.tip_sd_mm for tip in seen]
    assert taken.min() < -0.5 and taken.mean() < -0.2  # the likeliest place is too near to the line
    assert np.abs(off.mean(axis=0)).max() < 0.3 and (np.abs(off) < 1.645).mean(axis=0).min() > 0.88


def test_one_view_of_two_branches_that_overlap_states_both(fork) -> None:
    """Along x, a tip in the side branch, 60° off, shows at the place of one half as far along the straight vessel."""
    config = FluoroscopeConfig(biplane=False, view_angles_deg=((90.0, 0.0), (0.0, 0.0)))
    arm, random = Fluoroscope(fork, RADIUS, config=config), np.random.default_rng(5)
    line, heading = fork.tree.branches[2].centerline, np.array([np.sqrt(0.75), 0, 0.5])
    branches = set()
    for index in range(10, len(line.points), 2):
        between = 0.75 * float(line.abscissa[index]) + 0.25 * float(line.abscissa[0])
        tip = arm.measure(line.points[index], heading, between, random)
        branches.add(tip.branch)
        assert abs(tip.abscissa - line.abscissa[index]) < 3 * tip.tip_sd_mm[0]
        off = tip.position - line.points[index]
        assert off @ np.linalg.solve(tip.covariance, off) < 16.0
    assert len(branches) > 1  # it is not always in the right one


def test_the_branch_is_observed(fork) -> None:
    arm, random = Fluoroscope(fork, RADIUS), np.random.default_rng(1)
    line = fork.tree.branches[2].centerline
    for index in range(10, len(line.points), 5):
        tip = arm.measure(line.points[index], np.array([np.sqrt(0.75), 0, 0.5]), float(line.abscissa[index]), random)
        assert tip.branch == 2
        assert abs(tip.abscissa - line.abscissa[index]) < 2.0


def leaning(fork, side_deg: float) -> np.ndarray:
    return turned_axis(fork.insertion.direction, 20.0, float(side_deg))


def test_two_views_show_how_the_guiding_catheter_leans(fork) -> None:
    """A point errs by √(1/2) of a pixel across each view; two points 20 mm apart turn a line by √2 of that."""
    arm, random = Fluoroscope(fork, RADIUS), np.random.default_rng(2)
    true = np.repeat([leaning(fork, side) for side in range(0, 360, 30)], 20, axis=0)
    off = np.array([arm.catheter_axis(axis, random) for axis in true]) - true
    assert np.linalg.norm(off[:, :2], axis=1).max() < np.sin(np.radians(2.0))
    # the views stand at right angles: each tells one of the two components
    assert off[:, :2].std() == pytest.approx(np.sqrt(2) * 0.5 * PIXEL_MM / 20.0, rel=0.15)


def test_one_view_shows_the_lean_across_its_beam_alone(fork) -> None:
    """What it does not show is taken to be as given: the catheter leans not at all along the beam."""
    arm = Fluoroscope(fork, RADIUS, config=FluoroscopeConfig(biplane=False, pixel_sd=1e-3))
    beam, across = np.array([-0.5, -np.sqrt(0.75), 0.0]), np.array([np.sqrt(0.75), -0.5, 0.0])  # RAO 30°
    for side in range(0, 360, 45):
        true = leaning(fork, side)
        found = arm.catheter_axis(true, np.random.default_rng(0))
        assert np.arctan2(found @ across, found[2]) == pytest.approx(np.arctan2(true @ across, true[2]), abs=0.02)
        assert abs(found @ beam) < 0.03
        assert np.linalg.norm(found) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def arm(fork, wire):
    return ImageFluoroscope(fork, wire, seed=3)


def test_the_patient_is_registered_by_contrast(arm, fork):
    assert np.linalg.norm(arm.pose.translation_mm) > 1.0
    assert vessel_error_mm(fork, arm.pose, arm.registration.pose) < 0.5


def test_an_exposure_measures_the_tip_with_its_uncertainty(arm):
    at = np.arange(15.0, -30.0, -0.5)
    nodes = np.stack([0.4 + 0 * at, 0 * at, at], axis=-1)
    shown = arm.measure(nodes, 15.3, np.random.default_rng(0))
    assert shown is not None and shown.branch == 0
    assert np.linalg.norm(shown.position - nodes[0]) < 0.8
    assert shown.abscissa == pytest.approx(15.0, abs=0.6)
    assert all(0.02 < sd < 1.0 for sd in shown.tip_sd_mm)
    arm.forget_wires()
    again = arm.measure(nodes, 15.3, np.random.default_rng(0))
    np.testing.assert_array_equal(shown.position, again.position)


def test_exposures_show_a_vessel_that_lies_beside_where_it_is_registered(arm, fork):
    """The patient lies 2.5 mm beside where registration has them. Wires show it, to less than the room in the lumen."""
    unsure = copy(arm)
    unsure._registered = [replace(view, source=np.array([0.0, 2.5, 0.0]) + view.source) for view in arm._registered]
    unsure.forget_wires()
    at, errors = np.arange(15.0, -30.0, -0.5), []
    for index, side in enumerate((0.7, -0.7)):  # on one wall, then on the other
        nodes = np.stack([0 * at, np.where(at > 0, side, 0.0), at], axis=-1)
        shown = unsure.measure(nodes, 15.3, np.random.default_rng(index))
        errors.append(np.linalg.norm(shown.position - nodes[0]))
    room_mm = 1.0 - 0.18  # of the lumen and of the wire
    assert np.linalg.norm(unsure.shift - [0.0, 2.5, 0.0]) < room_mm and errors[1] < room_mm
    unsure.forget_wires()
    assert not unsure.shift.any()


def test_a_wire_is_found_where_the_known_motion_does_not_take_the_vessel(arm):
    """The vessel lies 2 mm beside where the known motion takes it, and the wire in it: the lumen's radius is 1 mm."""
    at = np.arange(15.0, -30.0, -0.5)
    nodes = np.stack([0 * at, np.full(len(at), 2.0), at], axis=-1)
    moving = copy(arm)
    moving.known_motion = Motion()
    moving.forget_wires()
    shown = moving.measure(nodes, 15.3, np.random.default_rng(0))
    assert shown is not None
    error = shown.position - nodes[0] + [0.0, 2.0, 0.0]
    # A straight vessel does not show how far it lies off along itself: the region says so.
    assert np.linalg.norm(error[:2]) < 0.82 and error @ np.linalg.solve(shown.covariance, error) < 4.0
    assert shown.covariance[1, 1] > 0.1  # how far it lies off is not quite known
    assert not moving.shift.any()  # the patient lies where they lay


def test_an_image_without_a_wire_measures_nothing(arm):
    assert arm.measure(np.zeros((0, 3)), 15.0, np.random.default_rng(1)) is None


def test_a_vessel_that_is_not_recognised_is_told(fork, wire, monkeypatch):
    monkeypatch.setattr(
        image_fluoroscope.Pose, "draw", lambda random: image_fluoroscope.Pose(np.zeros(3), np.full(3, 40.0))
    )
    with pytest.raises(InputError, match=r"fork cannot be registered"):
        ImageFluoroscope(fork, wire)


def test_a_run_of_contrast_shows_how_the_patient_moves(arm, fork):
    motion = replace(draw_motion(2), heart_period_s=0.7)
    mean = published_mean(motion)
    found = arm.measure_motion(motion, np.random.default_rng(0))
    assert found.heart_period_s == 0.7 and found.heart_rotation_deg == mean.heart_rotation_deg
    without, left = (motion_error_mm(fork, motion, each) for each in (mean, found))
    assert without > 0.4 and left < 0.2 and left < without / 3  # a vessel of 40 mm shows rotations roughly


def test_what_lies_still_stays_still(arm, fork):
    motion = replace(motion_named("breathing"), breathing_caudal_mm=7.5)
    found = arm.measure_motion(motion, np.random.default_rng(0))
    assert found.annulus_mm == found.heart_volume_share == 0
    assert found.breathing_caudal_mm == pytest.approx(7.5, abs=0.3)
    still = replace(motion_named("breathing"), breathing_caudal_mm=0.0, breathing_anterior_mm=0.0)
    still = replace(still, breathing_dorsal_deg=0.0, breathing_dextral_deg=0.0)
    assert arm.measure_motion(still, np.random.default_rng(0)) is None
