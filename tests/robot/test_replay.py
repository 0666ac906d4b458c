from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_robot import drawn, logged

from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.robot.replay import ReplayConfig, replay_log, summary
from endopilot.xray.camera import PlanarCamera

FEW = ReplayConfig(rotations=6)


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return drawn(3)


@pytest.fixture(scope="module")
def log(fork, wire, robot):
    return logged(fork, wire, robot, episodes=3, seconds=10.0, seed=3)


def test_the_robot_that_logged_is_predicted(fork, wire, robot, log) -> None:
    found = replay_log([log], fork, Stack(wire), robot=robot, config=FEW)
    figures = summary(found)
    assert figures["episodes"] == 3 and figures["error_along_mm"] < 0.2
    ideal = summary(replay_log([log], fork, Stack(wire), robot=RobotConfig(), config=FEW))
    assert ideal["error_along_mm"] > 2 * figures["error_along_mm"]
    assert ideal["error_along_of_the_drive_alone_mm"] > 2 * figures["error_along_of_the_drive_alone_mm"]
    for each in found:
        assert each.given.sum() == round(0.5 * len(each.given)) and not each.given[-1]
        assert np.isfinite(each.simulated).all() and len(each.force) >= len(each.time_s)


def test_what_a_camera_does_not_see_counts_for_nothing(fork, wire, robot, log) -> None:
    """The camera looks along y: a tip that lies elsewhere in y is the same pixel."""
    camera = PlanarCamera(mm_per_pixel=0.1, columns=(1.0, 0.0, 0.0), rows=(0.0, 0.0, -1.0))
    pixels = dataclasses.replace(log, tip=np.full_like(log.tip, np.nan), pixel=camera.project(log.tip), camera=camera)
    for each in replay_log([pixels], fork, Stack(wire), robot=robot, config=FEW):
        np.testing.assert_allclose(each.in_view[:, 1], 0.0, atol=1e-9)
        apart = each.simulated - each.seen
        np.testing.assert_allclose(each.in_view[:, [0, 2]], apart[:, [0, 2]], atol=1e-9)


def test_a_log_without_tips_is_refused(fork, wire, log) -> None:
    blind = dataclasses.replace(log, used=np.zeros(len(log), dtype=bool))
    with pytest.raises(InputError, match="synthetic: no episode shows the tip 20 times"):
        replay_log([blind], fork, Stack(wire), robot=RobotConfig(), config=FEW)
