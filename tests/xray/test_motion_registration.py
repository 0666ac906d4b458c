"""How a patient moves, from a run of contrast: amplitudes found again, and failures that are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.imaging.xray import motion_error_mm
from endopilot.errors import InputError
from endopilot.simulation.motion import draw_motion, motion_named, published_mean
from endopilot.xray import image_fluoroscope
from endopilot.xray.image import XrayImager
from endopilot.xray.image_fluoroscope import ImageFluoroscope
from endopilot.xray.registration import register_motion


@pytest.fixture(scope="module")
def arm(fork, wire):
    return ImageFluoroscope(fork, wire, seed=3)


@pytest.mark.parametrize("seed", [2, 5])
def test_a_run_of_contrast_shows_how_the_patient_moves(arm, fork, seed):
    motion = replace(draw_motion(seed), heart_period_s=0.7)
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


def test_the_error_of_a_motion_is_how_far_the_vessel_lies_off(fork):
    """A breath of sin⁴ that is 4 mm deeper displaces the vessel by 4 mm times 3/8 on average."""
    still = {"breathing_anterior_mm": 0.0, "breathing_dorsal_deg": 0.0, "breathing_dextral_deg": 0.0}
    breath = replace(motion_named("breathing"), **still)
    deeper = replace(breath, breathing_caudal_mm=breath.breathing_caudal_mm + 4.0)
    assert motion_error_mm(fork, deeper, breath) == pytest.approx(1.5, rel=0.03)


def test_a_run_without_contrast_is_told(arm, monkeypatch):
    signal = XrayImager.signal
    monkeypatch.setattr(
        XrayImager, "signal", lambda self, plane, nodes, **more: signal(self, plane, nodes, seed=more["seed"])
    )
    with pytest.raises(InputError, match=r"the motion of fork cannot be measured: .* inject contrast"):
        arm.measure_motion(draw_motion(2), np.random.default_rng(0))


def test_the_run_is_seen_from_where_the_patient_was_registered(arm, fork, monkeypatch):
    """The views are those of the patient's own pose, not of the CT's."""
    seen = []

    def remember(anatomy, views, *rest):
        seen.append(views)
        return register_motion(anatomy, views, *rest)

    monkeypatch.setattr(image_fluoroscope, "register_motion", remember)
    arm.measure_motion(draw_motion(2), np.random.default_rng(0))
    middle = fork.tree.branches[0].centerline.points[5]
    true = [plane.view.project(middle) for plane in arm._planes]
    np.testing.assert_allclose([view.project(middle) for view in seen[0]], true, atol=2.0)
