"""Stepping many worlds: of several kinds, saved state, force drive, balance of loads, bad input."""

from __future__ import annotations

import doctest
import re
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bend import vessel

from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.groups import Readout
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulatorState
from endopilot.types import Anatomy

DEVICE = read_wire("workhorse-014")
STIFF = read_wire("stiff-014")
PERIOD = 0.5


@pytest.fixture(scope="module")
def wider() -> Anatomy:
    return vessel(np.pi / 3)


def start(worlds: int) -> np.ndarray:
    random = np.random.default_rng(3)
    return np.column_stack([random.uniform(5, 30, worlds), random.uniform(-3, 3, worlds)])


def controls(samples: int, worlds: int) -> np.ndarray:
    random = np.random.default_rng(4)
    return np.stack([random.uniform(-2, 6, (samples, worlds)), random.uniform(-3, 3, (samples, worlds))], axis=-1)


def begun(simulator: Simulator, worlds: int) -> Simulator:
    first = start(worlds)
    simulator.reset(inserted_length=first[:, 0], rotation=first[:, 1])
    return simulator


def test_every_world_has_its_own_anatomy_and_device(anatomy: Anatomy, wider: Anatomy) -> None:
    anatomies, devices = [anatomy, wider, anatomy, wider], [DEVICE, DEVICE, STIFF, STIFF]
    control = controls(3, 4)
    together = begun(Simulator(anatomies, devices), 4)
    for t in range(3):
        step = together.step(control[t], 0.3)
    assert together.position.shape == (4, together.nodes, 3)
    for world in range(4):
        alone = Simulator(anatomies[world], devices[world])
        first = start(4)[world]
        alone.reset(inserted_length=first[:1], rotation=first[1:])
        for t in range(3):
            single = alone.step(control[t, world][None], 0.3)
        assert np.array_equal(step.tip_position[world], single.tip_position[0])
        nodes = alone.nodes
        assert np.array_equal(together.position[world, :nodes], alone.position[0])
        assert np.isnan(together.position[world, nodes:]).all()
        assert np.array_equal(together.contacts[world, :nodes], alone.contacts[0])
    assert len({tuple(tip) for tip in step.tip_position[:, 0]}) == 4


@pytest.mark.parametrize("worlds", [1, 5])
def test_ctrl_c_stops_a_step_that_has_begun(anatomy: Anatomy, worlds: int) -> None:
    simulator = begun(Simulator(anatomy, DEVICE, worlds=worlds, config=SimulatorConfig(threads=2)), worlds)
    inserted = simulator.inserted_length
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    try:
        with pytest.raises(KeyboardInterrupt):
            simulator.step(np.tile([1e-3, 0.1], (worlds, 1)), 5000.0)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert np.array_equal(simulator.inserted_length, inserted)
    assert simulator.step(np.ones((worlds, 2)), 0.1).valid.all()


def test_worlds_go_over_into_another_simulator_of_the_same_kind(anatomy: Anatomy, wider: Anatomy) -> None:
    first = begun(Simulator(anatomy, [DEVICE, STIFF, DEVICE]), 3)
    second = Simulator(anatomy, [STIFF, DEVICE])
    second.copy_worlds([1, 2], of=first)
    moved = second.step(controls(1, 2)[0], PERIOD)
    wanted = first.step(controls(1, 2)[0][[0, 0, 1]], PERIOD)  # world 1 and world 2 get the controls of their copies
    assert np.array_equal(moved.tip_position, wanted.tip_position[[1, 2]])
    with pytest.raises(InputError, match="world 0 cannot become world 0"):
        second.copy_worlds([0, 2], of=first)
    with pytest.raises(InputError, match="world 0 cannot become world 0"):
        Simulator(wider, DEVICE).copy_worlds([0], of=first)
    with pytest.raises(InputError, match="other settings"):
        Simulator(anatomy, DEVICE, config=SimulatorConfig(element_mm=1.0)).copy_worlds([0], of=first)


def test_equal_anatomies_and_devices_are_stepped_together(anatomy: Anatomy) -> None:
    again = replace(anatomy, name="read again", distance_map=replace(anatomy.distance_map))
    bent = replace(DEVICE, tip_bend_rad=0.5)
    devices = [DEVICE, read_wire("workhorse-014"), replace(DEVICE, name="mine", sources={}), bent]
    simulator = begun(Simulator([anatomy, again, anatomy, again], devices), 4)
    shared = begun(Simulator(anatomy, [DEVICE, DEVICE, DEVICE, bent]), 4)
    for control in controls(2, 4):
        step, wanted = simulator.step(control, PERIOD), shared.step(control, PERIOD)
        assert np.array_equal(step.tip_position, wanted.tip_position)
    elsewhere = Simulator(again, read_wire("workhorse-014"), worlds=2)
    elsewhere.copy_worlds([2, 1], of=simulator)
    assert np.array_equal(elsewhere.position, simulator.position[[2, 1]])
    simulator.set_state(shared.state)


def test_groups_that_are_stepped_side_by_side_do_the_same(anatomy: Anatomy) -> None:
    devices, one = [DEVICE, STIFF] * 9, SimulatorConfig(threads=1)
    alone, beside = (begun(Simulator(anatomy, devices, config=each), 18) for each in (one, SimulatorConfig()))
    control = controls(1, 18)[0]
    wanted, step = alone.step(control, PERIOD), beside.step(control, PERIOD)
    assert np.array_equal(step.tip_position, wanted.tip_position)
    assert np.array_equal(step.node_iterations, wanted.node_iterations)


def test_lanes_that_wait_for_a_slower_world_count_as_evaluations(anatomy: Anatomy) -> None:
    """Nine alike fill two packs of eight lanes; where one does the most, the others wait for it."""
    alike = begun(Simulator(anatomy, DEVICE, worlds=9), 9)
    step = replace(alike.step(controls(1, 9)[0], PERIOD), node_iterations=np.full(9, 100.0))
    assert alike.evaluations(step) == 2 * 8 * 100
    slow = replace(step, node_iterations=np.array([1000.0, *[10.0] * 8]))
    assert alike.evaluations(slow) == 8 * 1000
    pair = Simulator(anatomy, Stack.of(DEVICE, "microcatheter-2.4f"), worlds=9)  # measured: as long a node
    assert pair.evaluations(step) == alike.evaluations(step)
    for few in (1, 4):
        moved = replace(step, node_iterations=np.where(np.arange(9) < few, 1000.0, 0.0))
        assert alike.evaluations(moved) == 4 * 1000


def test_worlds_that_are_not_driven_stay_as_they_are_and_the_others_move_as_ever(anatomy: Anatomy) -> None:
    """Of two groups one has a single world that moves, and one none."""
    devices = [DEVICE, STIFF, DEVICE, DEVICE, STIFF]
    some, everyone = (begun(Simulator(anatomy, devices), 5) for _ in range(2))
    before, moves = some.position.copy(), np.array([False, False, True, True, False])
    for control in controls(3, 5):
        step, wanted = some.step(control, PERIOD, worlds=moves), everyone.step(control, PERIOD)
        assert np.array_equal(step.tip_position[moves], wanted.tip_position[moves])
        assert not any(np.any(getattr(step, name)[~moves]) for name in ("tip_position", "contact_force_max", "valid"))
    assert np.array_equal(some.position[~moves], before[~moves])
    assert np.array_equal(some.position[moves], everyone.position[moves])
    assert not np.array_equal(some.position, everyone.position)
    assert some.time[moves] == pytest.approx(some.time[~moves][0] + 3 * PERIOD)
    along = begun(Simulator(anatomy, devices, config=SimulatorConfig(friction_along=(1.0, 2.0))), 5)
    with pytest.raises(InputError, match="worlds: some are given where friction differs along the vessel"):
        along.step(control, PERIOD, worlds=moves)


def test_a_seed_draws_the_same_start_whatever_the_number_of_worlds(anatomy: Anatomy) -> None:
    few, many = Simulator(anatomy, DEVICE, worlds=2), Simulator(anatomy, DEVICE, worlds=5)
    few.reset(seed=7)
    many.reset(seed=7)
    assert np.array_equal(few.position, many.position[:2])
    assert len(set(many.inserted_length[:, 0])) == 5
    kept = many.position[[0, 2, 4]]
    many.reset(seed=8, worlds=[1, 3])
    assert np.array_equal(many.position[[0, 2, 4]], kept)
    assert not np.array_equal(many.position[1], few.position[1])


def test_forces_replay_a_velocity_run(anatomy: Anatomy) -> None:
    # The drive's force and torque are the gradient of the step's potential in the drive's motion; taken as loads,
    # they make that motion the minimum.
    config, dt = SimulatorConfig(time_step_s=0.02, tolerance_mm=1e-9, largest_jump=1e6), 0.02
    leading = begun(Simulator(anatomy, DEVICE, worlds=4, config=config), 4)
    led = begun(Simulator(anatomy, DEVICE, worlds=4, config=config, actuation="force"), 4)
    random = np.random.default_rng(8)
    velocity = np.repeat(
        np.column_stack([random.uniform(1, 8, 8), random.uniform(-3, 3, 8)]).reshape(2, 4, 2), 40, axis=0
    )
    apart, torques = [], []
    for control in velocity:
        step = leading.step(control, dt)
        follower = led.step(leading.drive_load, dt)
        apart.append(np.linalg.norm(step.tip_position - follower.tip_position, axis=-1))
        torques.append(leading.drive_load)
    assert leading.valid.all() and led.valid.all()
    travelled = np.abs(velocity[..., 0]).sum(axis=0) * dt
    assert (travelled > 3).all()
    assert np.max(apart) < 1e-6
    assert np.abs(led.inserted_length - leading.inserted_length).max() < 1e-6
    assert np.abs(led.rotation - leading.rotation).max() < 1e-6
    assert np.array_equal(led.drive_load, leading.drive_load)


def test_force_drive_stops_where_the_wire_is_out(anatomy: Anatomy) -> None:
    simulator = Simulator(anatomy, DEVICE, worlds=1, actuation="force")
    simulator.reset(inserted_length=np.array([3.0]), rotation=np.array([0.0]))
    for _ in range(20):
        simulator.step(np.array([[-0.5, 0.0]]), 0.1)
    assert simulator.valid.all()
    # 0.5 N less the valve's 0.05 N on a stop of 100 N/mm
    assert simulator.inserted_length[0, 0] == pytest.approx(-0.0045, abs=1e-3)


@pytest.mark.parametrize(
    ("control", "duration", "message"),
    [
        (np.zeros((1, 2)), 0.1, r"shape \(1, 2\); give \(2, 2\)"),
        (np.array([[1, 0], [np.nan, 0]]), 0.1, "control: world 1: nan: translation in mm/s is no finite number"),
        (
            np.array([[1, 0], [1e3, 0]]),
            0.1,
            "control: world 1: 1000: translation in mm/s exceeds workhorse-014's limit of 40; slow",
        ),
        (np.array([[40.0, 0], [0, 0]]), 60.0, "world 0: may insert .* laid out for .* push less"),
        (np.zeros((2, 2)), 0.0, "duration_s: 0.0; give a positive"),
    ],
)
def test_bad_controls_move_no_world(anatomy: Anatomy, control: np.ndarray, duration: float, message: str) -> None:
    simulator = begun(Simulator(anatomy, DEVICE, worlds=2), 2)
    before = simulator.state.values[0]
    with pytest.raises(InputError, match=message):
        simulator.step(control, duration)
    assert np.array_equal(simulator.state.values[0], before)
    simulator.step(np.zeros((2, 2)), 0.1)


def test_bad_starts_and_states_are_refused(anatomy: Anatomy, wider: Anatomy, tmp_path: Path) -> None:
    simulator = Simulator(anatomy, DEVICE, worlds=2)
    for arguments, message in (
        ({}, "seed: none given"),
        ({"seed": 1, "friction": [0.1, -0.1]}, "friction: world 1"),
        ({"seed": 1, "inserted_length": [1.0, 1e4]}, "inserted_length: world 1: 10000 mm"),
        ({"seed": 1, "rotation": [0.0]}, "rotation: shape"),
        ({"seed": 1, "worlds": [2]}, "there are 2"),
    ):
        with pytest.raises(InputError, match=message):
            simulator.reset(**arguments)
    with pytest.raises(InputError, match="made with other anatomies"):
        simulator.set_state(Simulator(wider, DEVICE, worlds=2).state)
    with pytest.raises(InputError, match=r"no such file|no saved state"):
        SimulatorState.read(tmp_path / "absent.npz")
    with pytest.raises(InputError, match="give fewer"):
        Simulator(anatomy, DEVICE, worlds=100_000_000)


def test_every_public_name_has_an_example_that_runs(anatomy: Anatomy) -> None:
    simulator = Simulator(anatomy, DEVICE, worlds=4)
    simulator.reset(seed=1)
    known = {"np": np, "Simulator": Simulator, "anatomy": anatomy, "device": DEVICE, "simulator": simulator}
    finder = doctest.DocTestFinder(recurse=True)
    examples = [test for part in (Simulator, Readout) for test in finder.find(part, "Simulator", globs=known)]
    public = {name for name in dir(Simulator) if not name.startswith("_")}
    shown = {test.name.split(".")[-1] for test in examples if test.examples}
    shown |= set(re.findall(r"simulator\.(\w+)", "".join(part.source for test in examples for part in test.examples)))
    assert shown >= public
    runner = doctest.DocTestRunner()
    for test in examples:
        runner.run(test)
    assert runner.failures == 0 and runner.tries > 20
