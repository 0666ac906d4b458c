"""The drive's motion and the robot in the simulator: limits hold whatever is asked, and every imperfection is there."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.robot.remote import RemoteRobot
from endopilot.robot.robot import CYCLE_S, DriveMotion, Robot, RobotConfig, SimulatedRobot
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator

LIMITS = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.0, travel_mm=(0.0, 100.0))
IDEAL = {"latency_s": 0.0, "backlash_mm": 0.0, "backlash_rad": 0.0, "encoder_sd_mm": 0.0, "encoder_sd_rad": 0.0}
ANYTHING = some.one_of(
    some.floats(), some.integers(), some.none(), some.text(max_size=3), some.booleans(), some.just(np.float32("nan"))
)


@given(ANYTHING, ANYTHING)
def test_a_command_is_finite_and_within_limits_whatever_is_asked(translation, rotation) -> None:
    command = LIMITS.safe(translation, rotation)
    assert np.isfinite(command).all()
    assert (np.abs(command) <= [40.0, 12.0]).all()
    asked = [translation, rotation]
    if all(isinstance(value, float) and np.isfinite(value) for value in asked):
        np.testing.assert_array_equal(command, np.clip(asked, [-40, -12], [40, 12]))


@given(some.lists(some.tuples(some.floats(), some.floats()), min_size=1, max_size=4))
def test_what_is_sent_to_a_drive_is_finite_and_within_its_limits(orders) -> None:
    robot, sent = object.__new__(RemoteRobot), []
    robot._lock, robot._ticket, robot._ticket_time = threading.RLock(), "ticket", np.inf
    robot.limits, robot._ask = LIMITS, lambda verb, ticket, *arguments: sent.append((verb, *arguments))
    for translation, rotation in orders:
        (taken,) = robot.command(((translation, rotation),))
        assert taken == LIMITS.safe(translation, rotation)
    assert [verb for verb, *_ in sent] == ["MOVE"] * len(orders)
    numbers = np.array([[float(number) for number in numbers] for _, *numbers in sent])
    assert np.isfinite(numbers).all() and (np.abs(numbers) <= [40.0, 12.0]).all()


@settings(deadline=None, max_examples=30)
@given(some.lists(some.tuples(some.floats(), some.floats(), some.floats(0.0, 0.4)), max_size=8))
def test_the_motor_keeps_speed_acceleration_and_travel(orders) -> None:
    config = RobotConfig()
    drive = DriveMotion(LIMITS, config, (50.0, 0.0))
    for translation, rotation, wait in orders:
        drive.command(translation, rotation)
        for _ in range(int(wait / 0.01)):
            speed, place = drive.velocity, drive.position
            moved = drive.advance(0.01)
            assert (np.abs(drive.velocity) <= [40.0, 12.0]).all()
            most = 0.01 * np.array([config.max_acceleration_mm_s2, config.max_acceleration_rad_s2])
            assert (np.abs(drive.velocity - speed) <= most + 1e-9).all()
            assert 0.0 <= drive.position[0] <= 100.0
            np.testing.assert_allclose(drive.position - place, moved)


def test_a_command_acts_after_the_latency_and_the_ramp() -> None:
    drive = DriveMotion(LIMITS, RobotConfig(**IDEAL | {"latency_s": 0.1, "max_acceleration_mm_s2": 100.0}), (10.0, 0.0))
    drive.command(20.0, 0.0)
    assert not drive.advance(0.1).any()
    # v²/2a on the ramp of v/a = 0.2 s, then v·t
    assert drive.advance(0.2)[0] == pytest.approx(2.0)
    assert drive.advance(0.3)[0] == pytest.approx(6.0)
    drive.command(0.0, 0.0)
    drive.stop()
    assert drive.advance(1.0)[0] == pytest.approx(2.0)


def test_motion_is_lost_where_it_reverses() -> None:
    drive = DriveMotion(LIMITS, RobotConfig(**IDEAL | {"backlash_mm": 0.4, "max_acceleration_mm_s2": 1e9}), (10.0, 0.0))
    moved = []
    for speed in (2.0, 2.0, -2.0, -2.0, 2.0):
        drive.command(speed, 0.0)
        moved.append(drive.advance(1.0)[0])
    # half the gap at first, which starts in its middle; all of it at every reversal
    np.testing.assert_allclose(moved, [1.8, 2.0, -1.6, -2.0, 1.6], atol=1e-6)


def test_the_encoders_read_the_wire_with_noise(fork, wire) -> None:
    simulator = Simulator(fork, wire, config=SimulatorConfig(element_mm=1.5, threads=1))
    simulator.reset(inserted_length=[10.0], rotation=[0.3])
    robot = SimulatedRobot(simulator, [DriveLimits.of(wire, fork)], RobotConfig(encoder_sd_mm=0.05), seed=3)
    assert isinstance(robot, Robot)
    assert robot.command(((8.0, 0.0),)) == ((8.0, 0.0),)
    robot.run(10 * CYCLE_S)
    readings = np.array([robot.proximal_state().devices[0][0] for _ in range(400)])
    assert 12.5 < simulator.inserted_length[0] < 14.0  # 4 mm less latency, ramp and gap
    assert abs(readings.mean() - simulator.inserted_length[0]) < 0.01
    assert 0.04 < readings.std() < 0.06
    assert robot.proximal_state().time_s == pytest.approx(0.5)
    # at the far end of the travel the wire stops
    assert robot.command(((1e6, np.nan),)) == ((0.0, 0.0),)
    robot.command(((40.0, 0.0),))
    robot.run(3.0)
    assert simulator.inserted_length[0] <= DriveLimits.of(wire, fork).travel_mm[1] + 1e-6


@pytest.mark.parametrize("ostium_mm", [0.0, 1.7, -1.7])
def test_a_wire_is_not_driven_beyond_its_end_wherever_the_ostium_truly_is(fork, wire, ostium_mm) -> None:
    limits = replace(DriveLimits.of(wire, fork), travel_mm=(0.0, 15.0))
    simulator = Simulator(fork, wire, config=SimulatorConfig(element_mm=1.5, threads=1))
    simulator.reset(inserted_length=[10.0], rotation=[0.0])
    robot = SimulatedRobot(simulator, [limits], RobotConfig(**IDEAL), ostium_mm=ostium_mm)
    robot.command(((20.0, 0.0),))
    robot.run(1.0)
    # by the encoder it goes no farther than the travel, and in truth no farther than the wire is laid out for
    assert robot.proximal[0, 0] == pytest.approx(15.0 + min(ostium_mm, 0.0), abs=1e-6)


def test_refuses_bad_settings() -> None:
    for make, message in (
        (lambda: DriveLimits(max_velocity_mm_s=np.nan, max_rotation_rad_s=1.0), "max_velocity_mm_s: nan"),
        (lambda: DriveLimits(max_velocity_mm_s=1.0, max_rotation_rad_s=1.0, travel_mm=(3.0, 1.0)), "travel_mm"),
        (lambda: RobotConfig(latency_s=-1.0), "latency_s: -1.0"),
        (lambda: RobotConfig(max_acceleration_mm_s2=0.0), "max_acceleration_mm_s2: 0.0"),
    ):
        with pytest.raises(InputError, match=message):
            make()
