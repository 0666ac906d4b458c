"""A C-arm that makes images: in a patient who lies otherwise than in the CT, it finds the tip, or says it does not."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.imaging.xray import motion_error_mm, vessel_error_mm
from endopilot.errors import InputError
from endopilot.simulation.motion import Motion, draw_motion, motion_named, published_mean
from endopilot.xray import image_fluoroscope
from endopilot.xray.image_fluoroscope import ImageFluoroscope


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
