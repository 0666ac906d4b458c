"""Drives of robots: limits, acceleration, play."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits, far_end_mm, within_travel
from endopilot.devices.robot import DriveConfig, DriveMotion, RobotConfig, read_robot
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.types import Branch, VesselTree
from toy_evaluation import make_anatomy

LIMITS = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.0, travel_mm=(0.0, 100.0))
IDEAL = read_robot("ideal")
STIFF = replace(IDEAL.wire, max_acceleration_mm_s2=1e9, max_acceleration_rad_s2=1e9)


def drive_of(config: RobotConfig, at: tuple[float, float] = (10.0, 0.0), seed: int = 0) -> DriveMotion:
    """Return the motion of one robot with one device."""
    return DriveMotion(config, [[LIMITS]], np.array([[at]]), seeds=[seed])


def ordered(drive: DriveMotion, translation: float, rotation: float, duration: float) -> np.ndarray:
    """Return how far the device moves in some time after a command, mm and rad."""
    drive.command(np.array([[[translation, rotation]]]))
    return drive.advance(duration)[0, 0]


@settings(deadline=None, max_examples=30)
@given(some.lists(some.tuples(some.floats(-40, 40), some.floats(-12, 12), some.floats(0.0, 0.4)), max_size=8))
def test_the_motor_keeps_speed_acceleration_and_travel(orders) -> None:
    config = RobotConfig(jitter_s=0.03)
    drive = drive_of(config, (50.0, 0.0))
    for translation, rotation, wait in orders:
        drive.command(np.array([[[translation, rotation]]]))
        for _ in range(int(wait / 0.01)):
            speed, place = drive.velocity, drive.position
            moved = drive.advance(0.01)
            assert (np.abs(drive.velocity) <= [40.0, 12.0]).all()
            most = 0.01 * np.array([config.wire.max_acceleration_mm_s2, config.wire.max_acceleration_rad_s2])
            assert (np.abs(drive.velocity - speed) <= most + 1e-9).all()
            assert 0.0 <= drive.position[0, 0, 0] <= 100.0
            np.testing.assert_allclose(drive.position - place, moved)


def test_a_command_acts_after_the_latency_and_the_ramp() -> None:
    drive = drive_of(replace(IDEAL, latency_s=0.1, wire=replace(IDEAL.wire, max_acceleration_mm_s2=100.0)))
    assert not ordered(drive, 20.0, 0.0, 0.1).any()
    # v²/2a on the ramp of v/a = 0.2 s, then v·t
    assert drive.advance(0.2)[0, 0, 0] == pytest.approx(2.0)
    assert drive.advance(0.3)[0, 0, 0] == pytest.approx(6.0)
    drive.command(np.zeros((1, 1, 2)))
    drive.stop()
    assert drive.advance(1.0)[0, 0, 0] == pytest.approx(2.0)


@given(some.floats(0.1, 5.0), some.lists(some.floats(0.05, 8.0), min_size=1, max_size=6))
def test_after_a_reversal_of_u_the_device_lags_by_the_smaller_of_u_and_the_play(play, strokes) -> None:
    """After a reversal it moves by max(u - play, 0): the motor goes through the play first. Mid-play at the start."""
    wire = replace(STIFF, play_mm=play, play_rad=play / 2)
    drive = drive_of(replace(IDEAL, wire=wire), (50.0, 0.0))
    forward = ordered(drive, 20.0, 4.0, 1.0)
    assert forward == pytest.approx([20.0 - play / 2, 4.0 - play / 4], abs=1e-6)
    for u in strokes:
        back = ordered(drive, -u, 0.0, 1.0)[0]
        assert back == pytest.approx(-max(u - play, 0.0), abs=1e-6)
        # forward again by more than the play: the whole play is lost if the stroke back was longer
        assert ordered(drive, u + play, 0.0, 1.0)[0] == pytest.approx(u + play - min(u, play), abs=1e-6)
    assert drive.motor[0, 0, 0] == pytest.approx(70.0 + play * len(strokes))
    assert ordered(drive, 0.0, -1.0, 1.0)[1] == pytest.approx(-max(1.0 - play / 2, 0.0), abs=1e-6)


def test_the_device_moves_by_gain_times_the_motor_and_no_faster_than_it_may() -> None:
    drive = drive_of(replace(IDEAL, wire=replace(STIFF, gain_translation=0.9, gain_rotation=1.2)))
    assert ordered(drive, 10.0, 2.0, 1.0) == pytest.approx([9.0, 2.4], abs=1e-6)
    assert drive.motor[0, 0] == pytest.approx([20.0, 2.0], abs=1e-6)
    assert ordered(drive, 10.0, 12.0, 0.5)[1] == pytest.approx(6.0, abs=1e-6)  # 12 rad/s is the device's limit


def test_gains_are_drawn_for_each_robot_and_the_same_seed_draws_the_same() -> None:
    config = replace(IDEAL, wire=replace(STIFF, gain_translation=1.1, gain_sd_translation=0.05))
    moved = np.array([ordered(drive_of(config, seed=seed), 10.0, 1.0, 1.0) for seed in range(300)])
    assert moved[:, 0].mean() == pytest.approx(11.0, abs=0.1) and moved[:, 0].std() == pytest.approx(0.55, abs=0.1)
    np.testing.assert_allclose(moved[:, 1], 1.0, atol=1e-6)
    assert (ordered(drive_of(config, seed=7), 10.0, 1.0, 1.0) == moved[7]).all()


def test_plays_are_drawn_for_each_robot_and_begin_anywhere_where_encoders_do_not_see_them() -> None:
    wire = replace(STIFF, play_mm=2.0, play_sd_share=0.1)
    lost, begun = [], []
    for seed in range(60):
        seen, unseen = (drive_of(replace(IDEAL, encoders_at=at, wire=wire), seed=seed) for at in ("wire", "motor"))
        assert seen._half_play.tolist() == unseen._half_play.tolist()
        ordered(seen, 10.0, 0.0, 1.0)
        lost.append(10.0 + ordered(seen, -10.0, 0.0, 1.0)[0])  # the whole play, from the side that it lies at
        begun.append((10.0 - ordered(unseen, 10.0, 0.0, 1.0)[0]) / lost[-1])  # of it, in the first motion
    assert np.mean(lost) == pytest.approx(2.0, abs=0.1) and np.std(lost) == pytest.approx(0.2, abs=0.06)
    assert min(begun) < 0.1 and max(begun) > 0.9 and np.mean(begun) == pytest.approx(0.5, abs=0.12)
    again = drive_of(replace(IDEAL, encoders_at="motor", wire=wire), seed=0)
    assert (10.0 - ordered(again, 10.0, 0.0, 1.0)[0]) / lost[0] == begun[0]


def test_jitter_makes_commands_late_and_none_overtakes_another() -> None:
    config, began = replace(IDEAL, latency_s=0.02, jitter_s=0.1, wire=STIFF), []
    for seed in range(200):
        one, alone = drive_of(config, seed=seed), drive_of(config, seed=seed)
        began.append(1.0 - ordered(alone, 10.0, 0.0, 1.0)[0] / 10.0)
        late = 2.0 - ordered(alone, 20.0, 0.0, 1.0)[0] / 10.0  # it moves by 10 t + 20 (1 - t)
        one.command(np.array([[[10.0, 0.0]]]))
        one.command(np.array([[[20.0, 0.0]]]))  # at the same time
        first, second = began[-1], max(began[-1], late)
        assert one.advance(1.0)[0, 0, 0] == pytest.approx(10 * (second - first) + 20 * (1 - second), abs=1e-6)
    assert 0.02 <= min(began) < 0.03 and 0.11 < max(began) <= 0.12 and np.mean(began) == pytest.approx(0.07, abs=0.01)


def test_each_device_has_a_drive_of_its_own() -> None:
    config = replace(IDEAL, wire=replace(STIFF, play_mm=1.0), catheters=(STIFF, replace(STIFF, gain_rotation=0.5)))
    drive = DriveMotion(config, [[LIMITS] * 4], np.full((1, 4, 2), 10.0))
    drive.command(np.full((1, 4, 2), 4.0))
    expected = [[3.5, 4.0], [4.0, 4.0], [4.0, 2.0], [4.0, 2.0]]  # the last catheter's drive serves further ones
    np.testing.assert_allclose(drive.advance(1.0)[0], expected, atol=1e-6)


def test_robots_side_by_side_move_as_alone_to_the_bit() -> None:
    wire = DriveConfig(play_mm=1.0, gain_sd_translation=0.05, gain_sd_rotation=0.05)
    other = RobotConfig(encoders_at="motor", latency_s=0.2, wire=DriveConfig(play_mm=3.0, max_acceleration_mm_s2=20.0))
    configs = [RobotConfig(jitter_s=0.07, wire=wire), other, RobotConfig(jitter_s=0.07, wire=wire), other, other]
    random = np.random.default_rng(0)
    control, start = random.uniform(-10, 10, (12, 5, 1, 2)), random.uniform(20, 60, (5, 1, 2))
    many = DriveMotion(configs, [[LIMITS]] * 5, start, seeds=range(5))
    alone = [DriveMotion(configs[k], [[LIMITS]], start[k : k + 1], seeds=[k]) for k in range(5)]
    for place, each in enumerate(control):
        if place == 6:
            many.reset([1, 3], start[[1, 3]], [[11], [13]], configs[:2])
            for k in (1, 3):
                alone[k].reset([0], start[k : k + 1], [[10 + k]], [configs[k // 2]])
        many.command(each)
        moved = many.advance(0.1)
        for k, one in enumerate(alone):
            one.command(each[k : k + 1])
            np.testing.assert_array_equal(one.advance(0.1)[0], moved[k])
            np.testing.assert_array_equal(one.motor[0], many.motor[k])


SLOW = DriveLimits(max_velocity_mm_s=20.0, max_rotation_rad_s=3.0, travel_mm=(0.0, 100.0))
ASKED = np.array([[50.0, -9.0], [-50.0, 1.0], [2.0, 0.0]])


def test_the_limits_of_a_wire_in_a_vessel_are_the_drives_speed_the_ostium_and_the_far_end():
    wire, vessel = read_wire("workhorse-014"), make_anatomy()
    length_mm = vessel.tree.longest_path().abscissa[-1]
    limits = DriveLimits.of(wire, vessel)
    assert limits.fastest.tolist() == [wire.max_velocity_mm_s, wire.max_rotation_rad_s]
    assert limits.travel_mm == (0.0, length_mm + 20.0) == (0.0, far_end_mm(vessel))
    assert DriveLimits.of(wire).travel_mm == (0.0, np.inf)


def test_a_clipped_control_stays_within_speed_and_travel():
    made = SLOW.clip(ASKED, np.array([97.0, 4.0, 50.0]), 0.5)
    assert made.tolist() == [[6.0, -3.0], [-8.0, 1.0], [2.0, 0.0]]
    assert SLOW.clip(ASKED, 50.0, 0.5).tolist() == [[20.0, -3.0], [-20.0, 1.0], [2.0, 0.0]]
    # a wire beyond its travel is moved no farther, and not brought back by force
    assert SLOW.clip(ASKED, 101.0, 0.5)[:, 0].tolist() == [0.0, -20.0, 0.0]
    assert SLOW.clip(ASKED, -1.0, 0.5)[:, 0].tolist() == [20.0, 0.0, 2.0]
    # each wire may have a travel of its own
    asked, inserted, end = np.array([5.0, 5.0, -5.0]), np.array([9.0, 9.0, 1.0]), np.array([10.0, 99.0, 9.0])
    made = within_travel(asked, inserted, 1.0, travel_mm=(0.0, end))
    assert made.tolist() == [1.0, 5.0, -1.0]


def test_a_sequence_ends_at_the_ends_of_the_travel_and_nan_stays():
    control = np.zeros((3, 4, 2))
    control[0, :, 0], control[1, :, 0], control[2, 1, 0] = 15.0, [-4.0, -4.0, 1.0, -4.0], np.nan
    made = SLOW.clip_sequence(control, np.array([90.0, 3.0, 50.0]), 0.5)
    assert made[0, :, 0].tolist() == [15.0, 5.0, 0.0, 0.0]
    assert made[1, :, 0].tolist() == [-4.0, -2.0, 1.0, -1.0]
    assert np.isnan(made[2, :, 0]).tolist() == [False, True, True, True]
    # what is within the limits stays the same to the last bit
    control = np.random.default_rng(0).uniform([-3.0, -2.0], [3.0, 2.0], (50, 20, 2))
    assert np.array_equal(SLOW.clip_sequence(control, np.full(50, 50.0), 0.5), control)


def test_a_simulator_takes_what_has_been_clipped():
    """A wire that is pushed on and on stops at the far end; rounding takes it no farther, which would be refused."""
    wire, tube = read_wire("workhorse-014"), make_anatomy()
    line = tube.tree.branches[0].centerline
    start = replace(line, **{name: values[:31] for name, values in vars(line).items()})
    vessel = replace(tube, tree=VesselTree((Branch(start, -1, np.zeros(31, dtype=int)),), ("1",)))
    simulator, end = Simulator(vessel, wire, worlds=8, config=SimulatorConfig(threads=1)), far_end_mm(vessel)
    begin = end - np.linspace(0.1, 0.9, 8)
    simulator.reset(inserted_length=begin, rotation=np.zeros(8))
    for _ in range(12):
        control = np.column_stack([np.linspace(3.3, 9.7, 8), np.zeros(8)])[:, None]
        simulator.step(DriveLimits.of(wire, vessel).clip(control, simulator.inserted_length, 0.07), 0.07)
    np.testing.assert_allclose(simulator.inserted_length, end, atol=1e-9)
