"""Registration: a known pose found again, and failures that are told."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.imaging.xray import vessel_error_mm
from endopilot.xray.carm import Pose, view_at
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
