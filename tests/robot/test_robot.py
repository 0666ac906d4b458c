"""The robot in the simulator: limits hold whatever is asked, encoders see what lies before them, loads are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from endopilot.devices.catheter import read_catheter
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.devices.stack import Stack, Transmission
from endopilot.navigation.loop import start_world
from endopilot.robot.robot import CYCLE_S, Robot, SimulatedRobot
from endopilot.simulation.config import SimulatorConfig, wall_stiffness
from endopilot.simulation.robots import in_grip
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target

LIMITS = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.0, travel_mm=(0.0, 100.0))
IDEAL = read_robot("ideal")
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


def test_the_encoders_read_the_wire_with_noise(fork, wire) -> None:
    robot, simulator = held(fork, wire, with_wire(encoder_sd_mm=0.05), seed=3)
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
    robot = SimulatedRobot(simulator, [limits], IDEAL, ostium_mm=ostium_mm)
    robot.command(((20.0, 0.0),))
    robot.run(1.0)
    # by the encoder it goes no farther than the travel, and in truth no farther than the wire is laid out for
    assert robot.proximal[0, 0] == pytest.approx(15.0 + min(ostium_mm, 0.0), abs=1e-6)


def with_wire(**changed) -> RobotConfig:
    """Return the assumed robot with another drive of the wire."""
    return replace(RobotConfig(), wire=replace(RobotConfig().wire, **changed))


def held(fork, wire, config: RobotConfig, **given) -> tuple[SimulatedRobot, Simulator]:
    """Return a robot that holds a wire at 10 mm in a fork."""
    simulator = Simulator(fork, wire, config=SimulatorConfig(element_mm=1.5, threads=1))
    simulator.reset(inserted_length=[10.0], rotation=[0.3])
    return SimulatedRobot(simulator, [DriveLimits.of(wire, fork)], config, **given), simulator


@pytest.mark.parametrize("at", ["motor", "wire"])
def test_encoders_in_front_of_play_and_gain_do_not_see_them(fork, wire, at) -> None:
    drive = replace(IDEAL.wire, play_mm=2.4, play_rad=1.0, gain_translation=0.9)
    robot, simulator = held(fork, wire, replace(IDEAL, encoders_at=at, wire=drive), ostium_mm=0.5)
    robot.command(((3.0, 1.2),))
    robot.run(1.0)  # through the play, wherever the wire lay in it
    lost = 10.0 + 0.9 * 3.0 - robot.proximal[0, 0], 0.3 + 1.2 - robot.proximal[0, 1]
    middle = at == "wire"  # there the start is known
    assert lost[0] == pytest.approx(1.2, abs=1e-3 if middle else 1.2)
    assert lost[1] == pytest.approx(0.5, abs=1e-3 if middle else 0.5)
    robot.command(((3.0, 0.8),))
    robot.run(1.0)
    motor, true = (9.5 + 6.0, 0.3 + 2.0), (10.0 + 0.9 * 6.0 - lost[0], 0.3 + 2.0 - lost[1])
    assert robot.proximal[0] == pytest.approx(true, abs=1e-3)
    read = motor if at == "motor" else (true[0] - 0.5, true[1])
    assert robot.proximal_state().devices[0] == pytest.approx(read, abs=1e-3)
    assert simulator.inserted_length[0, 0] == robot.proximal[0, 0]
    robot.command(((-2.0, -0.5),))
    robot.run(1.0)  # not through the play: the wire rests
    assert robot.proximal[0] == pytest.approx(true, abs=1e-3)
    lag = 2.0 if at == "motor" else 0.0
    assert robot.proximal_state().devices[0][0] == pytest.approx(read[0] - lag, abs=1e-3)


def test_a_wire_slips_in_the_grip_at_its_force_and_only_an_encoder_on_the_wire_sees_it(fork, wire) -> None:
    """Against a wall the drive bears the grip's force, and what is commanded beyond is lost."""
    navigation = Navigation(anatomy=fork, device=wire, target=Target(branch=1, abscissa=30.0))
    read = {}
    for at in ("motor", "wire"):
        config = replace(IDEAL, encoders_at=at, wire=replace(IDEAL.wire, grip_n=0.1))
        simulator = start_world(navigation, World(), SimulatorConfig(element_mm=1.5, threads=1), robot=config)
        limits = [DriveLimits.of(navigation.device, navigation.anatomy)]
        robot = SimulatedRobot(simulator, limits, config)
        robot.command(((10.0, 0.0),))
        robot.run(5.0)
        made = robot.recorder.trajectory()
        lost = made.slip[0, :, 0].sum()
        assert lost > 5.0
        assert made.base_force[0, :, 0].max() == pytest.approx(0.1, rel=1e-2)
        asked = CYCLE_S * made.command[0, :, 0, 0].sum()
        assert asked == pytest.approx(50.0, abs=1e-3)
        assert robot.proximal[0, 0] == pytest.approx(navigation.start[0, 0] + asked - lost, abs=1e-6)
        read[at] = robot.proximal_state().devices[0][0]
        if at == "wire":
            assert read[at] == pytest.approx(robot.proximal[0, 0], abs=1e-9)
    assert read["motor"] == pytest.approx(navigation.start[0, 0] + 50.0, abs=1e-3)


def test_the_load_is_the_drives_with_noise_and_the_valve_resists_either_way(fork, wire) -> None:
    robot, simulator = held(fork, wire, replace(IDEAL, wire=replace(IDEAL.wire, load_sd_n=0.02, load_sd_n_mm=0.005)))
    core = simulator.config
    for speed in (5.0, -5.0):
        robot.command(((speed, 0.0),))
        robot.run(1.0)
        valve = core.introducer_friction_n + 5.0 * core.introducer_drag_n_s_mm
        expected = float(simulator.base_load[0, 0, 0]) + np.sign(speed) * valve
        assert simulator.drive_load[0, 0, 0] == pytest.approx(expected, abs=1e-4)
        read = np.array([robot.proximal_state().load[0] for _ in range(500)])
        assert read.mean(axis=0) == pytest.approx(simulator.drive_load[0, 0], abs=3e-3)
        assert read.std(axis=0) == pytest.approx([0.02, 0.005], rel=0.15)


def test_what_was_measured_is_kept_beside_what_was_true_and_the_same_seed_repeats_it(fork, wire) -> None:
    kept = []
    for _ in range(2):
        robot, _ = held(fork, wire, replace(with_wire(play_mm=1.0), encoders_at="motor", jitter_s=0.02), seed=4)
        told = []
        for speed in (4.0, -4.0, 4.0):
            robot.command(((speed, 0.5),))
            robot.run(0.5)
            told.append(robot.proximal_state())
        kept.append(robot.measured)
    encoders, load = kept[0]["encoders"], kept[0]["load"]
    assert encoders.shape == load.shape == (1, 30, 1, 2)
    for name, values in kept[0].items():
        np.testing.assert_array_equal(values, kept[1][name])
    np.testing.assert_array_equal(encoders[0, 9::10, 0], [state.devices[0] for state in told])
    np.testing.assert_array_equal(load[0, 9::10, 0], [state.load[0] for state in told])
    true = robot.recorder.trajectory()
    assert np.abs(encoders[0, :, 0, 0] - true.inserted_length[0, :, 0]).max() > 0.4  # half the play, and more
    assert (load[0, :, 0, 0] - true.drive_force[0, :, 0]).std() == pytest.approx(0.02, rel=0.4)


def test_a_robot_brings_what_lies_between_its_drives_and_the_ostium(wire) -> None:
    catheter = read_catheter("microcatheter-1.7f")
    behind = Transmission(length_mm=900.0, twist_friction_n_mm_mm=1e-4)
    robot = replace(IDEAL, wire=replace(IDEAL.wire, transmission=behind))
    gripped, core = in_grip(Stack(wire, (catheter,)), robot, SimulatorConfig())
    assert gripped.transmissions == (behind, Transmission()) and gripped.devices == (wire, catheter)
    assert core == SimulatorConfig()  # the wall stays as hard as it was, without a weaker grip
    own = Stack(wire, transmissions=(behind,))
    assert in_grip(own, IDEAL, core) == (own, core)
    weak, core = in_grip(own, replace(IDEAL, wire=replace(IDEAL.wire, grip_n=0.1)), SimulatorConfig())
    assert weak.wire.push_limit_n == 0.1
    assert core.wall_stiffness_n_mm == wall_stiffness(SimulatorConfig(), wire.push_limit_n)


def test_an_encoder_on_the_wire_reads_its_proximal_end_and_not_its_rotation_at_the_ostium(fork, wire) -> None:
    navigation = Navigation(anatomy=fork, device=wire, target=Target(branch=1, abscissa=30.0))
    behind = Transmission(length_mm=1000.0, twist_friction_n_mm_mm=3e-4)
    config = replace(IDEAL, wire=replace(IDEAL.wire, transmission=behind))
    simulator = start_world(navigation, World(), SimulatorConfig(element_mm=1.5, threads=1), robot=config)
    robot = SimulatedRobot(simulator, [DriveLimits.of(wire, fork)], config)
    robot.command(((0.0, 2.0),))
    robot.run(3.0)
    assert robot.proximal_state().devices[0][1] == pytest.approx(6.0, abs=1e-4)
    assert 2.0 < robot.proximal[0, 1] < 4.5  # the lag is some 2.5 rad
    assert robot.proximal_state().load[0][1] > 0.25  # N mm, of the friction
