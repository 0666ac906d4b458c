"""Registration: a known pose found again, failures that are told, and what is known of a patient who moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.imaging.xray import vessel_error_mm
from endopilot.simulation.motion import Motion, draw_motion, motion_named, place, published_mean
from endopilot.xray.carm import Pose, view_at
from endopilot.xray.fluoroscope import seen_in_episodes, turned
from endopilot.xray.image import XrayImager
from endopilot.xray.registration import register

ANGLES = ((-30.0, 0.0), (60.0, 0.0))
POSE = Pose(np.deg2rad([2.0, -2.5, 1.5]), np.array([4.0, -3.0, 3.5]))
NONE = np.zeros((0, 3))


@pytest.fixture(scope="module")
def exposures(fork, wire):
    """Return the views as the C-arm has them, images with contrast, images before and a second time before."""
    imager = XrayImager(fork, wire)
    planes = [imager.plane(angles, pose=POSE) for angles in ANGLES]
    views = [view_at(angles, imager.isocenter, imager.config.geometry) for angles in ANGLES]
    lit, before, again = (
        [imager.signal(plane, NONE, contrast=share, seed=seed + index) for index, plane in enumerate(planes)]
        for share, seed in ((1.0, 0), (0.0, 10), (0.0, 20))
    )
    return views, lit, before, again


def test_two_views_find_the_pose(fork, exposures):
    views, lit, before, _ = exposures
    assert vessel_error_mm(fork, POSE, Pose()) > 5.0
    found = register(fork, views, lit, before)
    assert found.failure == "" and found.correlation > 0.9
    assert vessel_error_mm(fork, POSE, found.pose) < 0.5


def test_one_view_finds_what_it_sees(fork, exposures):
    """Across the beam the vessel lies where it is; along the beam one view knows little."""
    views, lit, before, _ = exposures
    found = register(fork, views[:1], lit[:1], before[:1])
    points = np.concatenate([branch.centerline.points for branch in fork.tree.branches])
    isocenter = points.mean(axis=0)
    pixels = [views[0].project(pose.move(points, isocenter)) for pose in (POSE, found.pose)]
    assert found.failure == ""
    assert np.linalg.norm(pixels[0] - pixels[1], axis=1).mean() < 2.0
    beam, error = views[0].axes[2], found.pose.vector - POSE.vector
    depth, aside = (axis @ found.covariance[3:, 3:] @ axis for axis in (beam, views[0].axes[0]))
    assert np.sqrt(depth) > 5 * np.sqrt(aside) and np.sqrt(depth) < 3.5
    assert error @ np.linalg.solve(found.covariance, error) < 16.8  # 99 % of normal errors in six numbers


def test_what_does_not_fit_is_told(fork, exposures):
    """An image without contrast, and a view that is not the given one."""
    views, lit, before, again = exposures
    assert "inject contrast" in register(fork, views, again, before).failure
    assert register(fork, views[::-1], lit, before).failure


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
