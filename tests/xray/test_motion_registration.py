"""How a patient moves, from a run of contrast: amplitudes found again, and failures that are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.imaging.xray import motion_error_mm
from endopilot.simulation.motion import draw_motion, motion_named, published_mean
from endopilot.xray.image_fluoroscope import ImageFluoroscope


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
