"""What an exposure shows of a patient who moves: the wire where it is, less what is known of the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from endopilot.simulation.motion import Motion, draw_motion, motion_named, place, published_mean
from endopilot.xray.moving_patient import seen_in_episodes, turned

OSTIUM = np.array([3.0, -2.0, 10.0])


def test_the_published_mean_of_what_moves_is_known() -> None:
    assert published_mean(draw_motion(3)) == Motion() != draw_motion(3)
    breathing = replace(Motion(), annulus_mm=0.0, heart_volume_share=0.0, heart_rotation_deg=0.0)
    assert published_mean(replace(breathing, breathing_caudal_mm=8.0)) == motion_named("breathing")
    assert published_mean(replace(Motion(), annulus_mm=5.0, heart_period_s=1.0)) == replace(
        Motion(), heart_period_s=1.0
    )


def test_an_exposure_shows_what_is_not_known_of_the_motion() -> None:
    """The patient breathes 2 mm deeper than the mean; 2 s into a breath of 4 s all of it is there."""
    assert seen_in_episodes(None, None, OSTIUM, 4, 0.5) is None
    known = seen_in_episodes(Motion(), Motion(), OSTIUM, 4, 0.5)
    np.testing.assert_allclose(known, np.tile(np.eye(3, 4), (4, 1, 1)), atol=1e-9)
    still = {"annulus_mm": 0.0, "heart_volume_share": 0.0, "heart_rotation_deg": 0.0}
    still |= {"breathing_dorsal_deg": 0.0, "breathing_dextral_deg": 0.0}
    mean = replace(Motion(), **still)
    maps = seen_in_episodes(replace(mean, breathing_caudal_mm=6.9), mean, OSTIUM, 8, 0.5)
    assert maps is not None
    there = place(mean.core(OSTIUM).placements(np.array([2.0]))[0], place(maps[3], OSTIUM)[None])
    np.testing.assert_allclose(there[0] - OSTIUM, [0.0, -1.3, -6.9], atol=1e-6)
    np.testing.assert_allclose(place(maps[7], OSTIUM), OSTIUM, atol=1e-6)  # the breath is over


def test_directions_turn_with_the_vessel_and_stay_unit_vectors() -> None:
    stretch = np.column_stack([np.diag([2.0, 1.0, 1.0]), [5.0, 5.0, 5.0]])
    shown = turned(stretch[None], np.array([[[0.6, 0.8, 0.0]]]))
    np.testing.assert_allclose(shown, [[np.array([1.2, 0.8, 0.0]) / np.hypot(1.2, 0.8)]])
