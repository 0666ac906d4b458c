"""What is believed of drives whose encoders sit in front of their play, against drives that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.drives import Drives, Motion
from endopilot.devices.robot import DriveConfig, RobotConfig, through_play
from endopilot.tasks.navigation import DECISION_PERIOD_S

START, FASTEST = np.array([[2.0, 0.5]]), np.array([[40.0, 12.6]])
WIRE = DriveConfig(play_mm=2.6, play_rad=5.65, max_acceleration_mm_s2=1e9, max_acceleration_rad_s2=1e9)
ROBOT = RobotConfig(encoders_at="motor", latency_s=0.0, wire=WIRE)


class Real:
    """A drive whose play is known, with a device behind it."""

    def __init__(self, gap: tuple[float, float], ahead: tuple[float, float]) -> None:
        self.half_gap, self.ahead = np.array([gap]) / 2, np.array([ahead])
        self.motor, self.device = START.copy(), START.copy()

    def drive(self, believed: Drives, motion: Motion) -> None:
        """Do what is asked for a period, and let the belief read the encoders."""
        driven = motion.velocity * DECISION_PERIOD_S
        self.ahead, moved = through_play(self.ahead, driven, self.half_gap)
        self.motor, self.device = self.motor + driven, self.device + moved
        believed.sent(tuple(map(tuple, motion.velocity.tolist())))
        believed.follow(tuple(map(tuple, self.motor.tolist())))

    def look(self, believed: Drives) -> None:
        """Weight the samples as an exposure does that shows where the device is."""
        error = (believed.samples(0) - self.device[0]) / [0.5, 0.2]
        believed.weigh(0, -np.log1p(error**2).sum(axis=1))

    def bring(self, believed: Drives, *wanted: float, looks: int = 1) -> None:
        """Bring the device somewhere, mm and rad, and look at it."""
        for _ in range(30):
            motion = believed.towards(np.array([wanted]), np.array([np.inf, 7.0]))
            self.drive(believed, motion)
            if motion.done:
                break
        for _ in range(looks):
            self.look(believed)


def test_encoders_at_the_devices_say_where_they_are() -> None:
    for robot in (None, RobotConfig()):
        drives = Drives(robot, START, FASTEST)
        drives.follow(((7.0, 1.5),))
        assert not drives.lose and drives.proximal.tolist() == [[7.0, 1.5]] and not drives.sd.any()
        motion = drives.towards(np.array([[9.0, 1.0]]), np.array([np.inf, 0.1]))
        assert motion.done and motion.velocity.tolist() == [[4.0, -1.0]]


@pytest.mark.parametrize("ahead", [(1.1, -2.0), (-1.2, 2.4), (0.0, 0.0)])
@pytest.mark.parametrize("gap", [(2.6, 5.65), (3.2, 4.9), (2.0, 6.6)])
def test_a_play_that_is_not_known_exactly_is_found_and_taken_up(gap, ahead) -> None:
    real, believed = Real(gap, ahead), Drives(ROBOT, START, FASTEST)
    for place in ((8.0, 0.5), (8.0, 2.0), (4.0, 2.0), (9.0, 1.0), (5.0, 2.5), (12.0, 1.5)):
        real.bring(believed, *place, looks=2)
    assert np.abs(believed.proximal - real.device).max() < 0.3
    real.bring(believed, 8.0, 0.5, looks=0)  # back, without a look: both plays are known by now
    assert np.abs(real.device - [8.0, 0.5]).max() < 0.6
    assert np.abs(believed.proximal - real.device).max() < 0.6


@pytest.mark.parametrize("ahead", [1.2, -0.3, -1.2])
def test_a_force_says_when_the_play_is_taken_up(ahead) -> None:
    """The valve rubs with 0.05 N from when the device moves, 0.02 N of noise on it; nobody looks."""
    random, found = np.random.default_rng(0), {}
    for feels in (False, True):
        real, believed = Real((2.6, 5.65), (ahead, 0.0)), Drives(ROBOT, START, FASTEST)
        for _ in range(10):
            before = real.device[0, 0]
            real.drive(believed, Motion(np.array([[0.8, 0.0]]), done=True))
            rubs = 0.05 * (real.device[0, 0] > before)
            if feels:
                believed.feel(0, rubs + 0.02 * random.standard_normal(), pushed_n=0.0, valve=(0.05, 0.0))
        found[feels] = believed.sd[0, 0], abs(believed.proximal - real.device)[0, 0]
    assert found[True][0] < 0.5 * found[False][0] and found[True][1] < 0.35


def test_a_device_rests_while_a_play_is_taken_up() -> None:
    real, believed = Real((2.6, 5.65), (0.0, 0.0)), Drives(ROBOT, START, FASTEST)
    real.bring(believed, 10.0, 0.5, looks=3)
    before = real.device.copy()
    motion = believed.towards(np.array([[6.0, 0.5]]), FASTEST[0])
    real.drive(believed, motion)
    assert not motion.done
    assert motion.velocity[0, 0] * DECISION_PERIOD_S == pytest.approx(-2.6, abs=0.5)
    np.testing.assert_allclose(real.device, before, atol=0.4)
    motion = believed.towards(np.array([[6.0, 0.5]]), FASTEST[0])
    assert motion.velocity[0, 0] < 0 and motion.velocity[0, 1] == 0


def test_what_is_not_known_of_a_play_spreads_after_a_reversal_until_it_is_seen() -> None:
    real, believed = Real((2.6, 5.65), (1.0, 1.0)), Drives(ROBOT, START, FASTEST)
    assert not believed.sd.any() or believed.sd.max() < 1e-9
    real.bring(believed, 12.0, 0.5, looks=0)
    unseen = believed.sd[0, 0]
    for _ in range(3):
        real.look(believed)
    seen = believed.sd[0, 0]
    real.bring(believed, 6.0, 0.5, looks=0)
    assert unseen > 0.6 and seen < 0.5 * unseen and believed.sd[0, 0] > 1.2 * seen


def test_a_wire_turns_on_rather_than_back_where_that_is_shorter_for_its_motor() -> None:
    real, believed = Real((2.6, 5.65), (0.0, 0.0)), Drives(ROBOT, START, FASTEST)
    real.bring(believed, 2.0, 5.0, looks=3)
    assert believed.nearest_turn(np.array([4.5])) == pytest.approx(4.5 + 2 * np.pi)
    narrow = Drives(replace(ROBOT, wire=replace(WIRE, play_rad=0.1)), START, FASTEST)
    assert narrow.nearest_turn(np.array([0.2])) == pytest.approx(0.2)


def test_motors_go_on_for_their_latency_before_they_turn_back() -> None:
    slow = replace(ROBOT, latency_s=0.1, wire=replace(WIRE, max_acceleration_mm_s2=100.0))
    assert slow.run_out(np.array([[10.0, 0.0]]))[0, 0] == pytest.approx(10.0 * 0.1 + 10.0**2 / 200.0)
    believed = Drives(replace(slow, wire=replace(slow.wire, play_mm=1e-6, play_rad=1e-6)), START, FASTEST)
    believed.sent(((10.0, 0.0),))
    believed.follow(((6.0, 0.5),))
    assert believed.at_rest[0, 0] == pytest.approx(7.5, abs=0.05) and believed.proximal[0, 0] == pytest.approx(
        6.0, abs=0.05
    )
