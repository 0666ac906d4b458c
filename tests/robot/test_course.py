from __future__ import annotations

import numpy as np
import pytest

from benchmarks.robot.synthetic import PERIOD_S, drawn, logged_and_true
from endopilot.devices.robot import DriveConfig
from endopilot.robot.log import Courses, RobotLog


def log_of(positions, *, period_s=0.1, seen_every=1) -> RobotLog:
    """A log whose drive is sent along positions, mm, and whose tips are the positions that it has then."""
    count = len(positions)
    nothing = np.full((count, 1, 2), np.nan)
    command = nothing.copy()
    command[:, 0, 0], command[:, 0, 1] = positions, 0.0
    return RobotLog(
        name="made",
        time_s=period_s * np.arange(count),
        episode=np.zeros(count, dtype=np.int64),
        command=command,
        encoders=nothing,
        load=nothing.copy(),
        tip=np.column_stack([positions, np.zeros((count, 2))]),
        pixel=np.full((count, 2), np.nan),
        used=np.arange(count) % seen_every == 0,
    )


def followed(courses, at_s, *, latency_s=0.0, gain=1.0, play=0.0, start=0.0):
    values = (np.array([value]) for value in (latency_s, gain, play))
    late, gains, plays = values
    return courses.followed(0, at_s=at_s, latency_s=late, gain=gains, play=plays, start=start)[0, 0]


def test_a_command_is_reached_by_the_next_one_and_later_by_the_latency() -> None:
    courses = Courses.of([log_of([0.0, 1.0, 1.0, 3.0])], DriveConfig())
    at_s = np.array([[0.1, 0.15, 0.2, 0.3, 0.35, 0.4, 5.0]])
    np.testing.assert_allclose(followed(courses, at_s), [0, 0.5, 1, 1, 2, 3, 3], atol=1e-9)
    np.testing.assert_allclose(followed(courses, at_s + 0.2, latency_s=0.2, gain=2.0), [0, 1, 2, 2, 4, 6, 6], atol=1e-9)


def test_play_is_lost_where_the_drive_reverses() -> None:
    courses = Courses.of([log_of([0.0, 5.0, 2.0, 5.0])], DriveConfig())
    ends = np.array([[0.2, 0.3, 0.4]])
    np.testing.assert_allclose(followed(courses, ends, play=1.0), [4.5, 2.5, 4.5])
    np.testing.assert_allclose(followed(courses, ends, play=4.0), [3.0, 3.0, 3.0])
    np.testing.assert_allclose(followed(courses, ends, play=4.0, start=1.0), [3.0, 3.0, 3.0])
    np.testing.assert_allclose(followed(courses, ends[:, :0], play=4.0), [])


@pytest.mark.parametrize("seed", [0, 1])
def test_it_is_the_motion_of_the_simulated_robot(fork, wire, seed) -> None:
    """The house's drive, which ramps and steps through time, leads the wire to the same places."""
    robot = drawn(seed)
    log, true = logged_and_true(fork, wire, robot, episodes=1, seconds=10.0, seed=seed)
    courses, late = Courses.of([log], robot.wire), robot.latency_s
    at_s = PERIOD_S * np.arange(1, len(true) + 1)[None]
    gain, play = robot.wire.gain_translation, robot.wire.play_mm
    motions = [  # where in its play a drive begins is drawn
        followed(courses, at_s, latency_s=late, gain=gain, play=play, start=start) for start in np.linspace(-1, 1, 41)
    ]
    errors = [true[:, 0] - motion for motion in motions]
    assert min(np.abs(error - np.median(error)).max() for error in errors) < 0.25
    assert np.ptp(true[:, 0]) > 5.0
