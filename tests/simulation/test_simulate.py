"""The simulator in analytic vessels: kinematics, determinism, forces, drawn controls, refusal of bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bend import BEND, vessel
from jaxtyping import Float

from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, free_wire_load, random_controls
from endopilot.simulation.simulate import WALL_FORCE_LIMIT_N, simulate, wall_force_worlds
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy, Insertion

WORLDS, SAMPLES = 6, 16
DEVICE = read_wire("workhorse-014")


def drive(worlds: int = WORLDS) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n samples 2"]]:
    random = np.random.default_rng(5)
    initial = np.column_stack([random.uniform(5, 30, worlds), random.uniform(-3, 3, worlds)])
    return initial, np.stack(
        [random.uniform(1, 8, (worlds, SAMPLES)), random.uniform(-3, 3, (worlds, SAMPLES))], axis=-1
    )


def test_kinematics_and_forces(anatomy: Anatomy) -> None:
    initial, control = drive()
    trajectory = simulate(anatomy, DEVICE, control, initial=initial, record_shape=True)
    expected = initial[:, None] + 0.5 * np.cumsum(control, axis=1)
    np.testing.assert_allclose(trajectory.proximal[:, :, 0], expected, rtol=0, atol=1e-12)
    assert trajectory.shape is not None
    along = np.linalg.norm(np.diff(trajectory.shape, axis=2), axis=-1).sum(axis=-1)
    np.testing.assert_allclose(along, along[0, 0], rtol=2e-3)  # the wire does not stretch
    behind = trajectory.shape[..., -1, :] - anatomy.insertion.position
    np.testing.assert_allclose(behind[..., 0], trajectory.inserted_length[..., 0] - along[0, 0], atol=0.2)
    assert (trajectory.contact_force_max <= trajectory.contact_force_sum + 1e-12).all()
    assert (trajectory.tip.abscissa < trajectory.inserted_length + 3).all()
    assert trajectory.contact_force_max.max() / 5.0 < 0.05  # penetration, mm


@pytest.mark.parametrize("element_mm", [0.2, 1.0])
def test_the_wall_force_is_the_largest_resultant_on_two_millimetres_of_the_wire(
    anatomy: Anatomy, element_mm: float
) -> None:
    config = SimulatorConfig(element_mm=element_mm)
    trajectory = simulate(
        anatomy, DEVICE, np.zeros((1, 1, 2)), initial=np.array([[30.0, 2.0]]), config=config, record_shape=True
    )
    simulator = Simulator(anatomy, DEVICE, config=config)
    simulator.reset(inserted_length=[30.0], rotation=[2.0])
    simulator.step(np.zeros((1, 2)), 0.5)
    assert trajectory.shape is not None
    at, force = trajectory.shape[0, 0], simulator.contacts[0, : trajectory.shape.shape[2]]
    assert force.max() == trajectory.contact_force_max[0, 0]
    # The wall pushes towards the tube's axis: a line, a quarter of a circle around (0, 20, 0) and a line.
    from_middle = at[:, :2] - [0.0, BEND]
    turned = np.clip(np.arctan2(from_middle[:, 0], -from_middle[:, 1]), 0.0, np.pi / 2)
    out = np.column_stack([np.sin(turned), -np.cos(turned), 0 * turned])
    radial = np.column_stack([(from_middle * out[:, :2]).sum(axis=1) - BEND, at[:, 2]])
    towards = -(radial[:, :1] * out + radial[:, 1:] * [0.0, 0.0, 1.0]) / np.linalg.norm(radial, axis=1)[:, None]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1)))
    within = (along >= along[:, None] - 1e-6) & (along <= along[:, None] + 2.0)
    resultants = np.linalg.norm(within @ (force[:, None] * towards), axis=1)
    assert trajectory.wall_force[0, 0] == pytest.approx(resultants.max(), rel=0.02)
    assert trajectory.wall_force[0, 0] > 1.5 * force.max()  # two contacts lie 1 to 2 mm apart


def test_node_iterations_count_every_evaluation_of_an_active_node(anatomy: Anatomy) -> None:
    initial, control = np.array([[20.0, 0.0]]), np.tile([0.0, 1.0], (1, 4, 1))
    simulator = Simulator(anatomy, DEVICE)
    simulator.reset(inserted_length=initial[:, 0], rotation=initial[:, 1])
    active, steps = simulator.active_nodes[0], 5
    for largest_jump in (1e3, 0.01, 1e-3):  # no step is shortened, some are, many are
        config = SimulatorConfig(largest_jump=largest_jump, time_step_s=0.1)
        trajectory = simulate(anatomy, DEVICE, control, initial=initial, config=config)
        evaluations = trajectory.node_iterations / active
        np.testing.assert_array_equal(evaluations, np.round(evaluations))
        made = evaluations / trajectory.iterations  # steps
        np.testing.assert_allclose(made, np.round(made), rtol=1e-12)
        assert (made == steps).all() if largest_jump == 1e3 else (made > steps).any()


def test_the_wire_moves_on_evenly_while_nodes_are_set_free(anatomy: Anatomy) -> None:
    """A node passes the place where the wire is held every 0.7 mm; the tip must not feel it."""
    slippery = replace(DEVICE, friction=0.0)
    control = np.tile([0.25, 0.0], (1, 40, 1))
    config = SimulatorConfig(element_mm=0.5)
    trajectory = simulate(anatomy, slippery, control, initial=np.array([[20.0, 0.0]]), config=config)
    steps = np.diff(trajectory.tip_position[0, 2:, 0], axis=0)  # mm, for 0.125 mm of wire each
    turns = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    np.testing.assert_allclose(turns, turns.mean(), rtol=0.1)  # as an even bend asks


def test_a_wall_force_that_no_vessel_should_bear_is_told(anatomy: Anatomy) -> None:
    control = np.zeros((2, 20, 2))
    control[0, :, 0], control[1, :, 0] = 4.0, -1.0  # against the blind end; out
    hard = replace(DEVICE, push_limit_n=2.0)
    with pytest.warns(UserWarning, match=r"^1 of 2 worlds press the wall with more than 0\.7 N; world 0 after") as told:
        trajectory = simulate(anatomy, hard, control, initial=np.array([[55.0, 0.0], [20.0, 0.0]]))
    first = int(np.flatnonzero(trajectory.wall_force[0] > WALL_FORCE_LIMIT_N)[0])
    wanted = f"world 0 after {0.5 * (first + 1):g} s, with up to {trajectory.wall_force[0].max():.2f} N"
    assert first > 0 and str(told[0].message).endswith(wanted)
    assert wall_force_worlds(trajectory).tolist() == [0]
    assert not len(wall_force_worlds(replace(trajectory, valid=np.zeros_like(trajectory.valid))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, i: (c * 100, i), "exceeds"),
        (lambda c, i: (c, i - [50, 0]), "world 0: .* give 0 to"),
        (lambda c, i: (c[:0], i[:0]), "at least one"),
        (lambda c, i: (c, i * np.inf), "finite"),
        (lambda c, i: (c, i + np.array([1e6, 0.0])), "initial: world 1: 1.*e.06 mm inserted; give at most 5000"),
    ],
)
def test_refuses_bad_controls(anatomy: Anatomy, change, message: str) -> None:
    initial, control = drive()
    control, initial = change(control, initial)
    with pytest.raises(InputError, match=message):
        simulate(anatomy, DEVICE, control, initial=initial)


def test_refuses_wires_that_the_memory_does_not_hold_before_they_are_laid_out(anatomy: Anatomy) -> None:
    with pytest.raises(InputError, match=r"^reach_mm: wires of 1e\+12 mm need .* GiB of .*; push less far$"):
        Simulator(anatomy, DEVICE, reach_mm=1e12)


def test_refuses_bad_anatomies(anatomy: Anatomy) -> None:
    initial, control = drive(1)
    field = anatomy.distance_map
    broken = replace(field, values=np.where(field.values > 1, np.nan, field.values))
    for bad, message in (
        (replace(anatomy, distance_map=broken), "not finite"),
        (replace(anatomy, distance_map=replace(field, values=-field.values)), "positive"),
        (replace(anatomy, insertion=Insertion(np.array([500.0, 0, 0]), np.array([1.0, 0, 0]))), "positive"),
        (replace(anatomy, insertion=Insertion(np.array([-5.0, 0, 0]), np.array([2.0, 0, 0]))), "unit vector"),
        (replace(anatomy, insertion=Insertion(np.array([np.nan, 0, 0]), np.array([1.0, 0, 0]))), "not finite"),
        (replace(anatomy, insertion=Insertion(np.array([-5.0, 0, 0]), np.array([0.0, 0, 1.0]))), "positive"),
        (replace(anatomy, distance_map=replace(field, spacing_mm=0.0)), "positive spacing"),
        (replace(anatomy, catheter_radius_mm=0.1), "wider"),
    ):
        with pytest.raises(InputError, match=message):
            simulate(bad, DEVICE, control, initial=initial)


def test_refuses_another_shape_no_period_and_worlds_that_the_memory_does_not_hold(anatomy: Anatomy) -> None:
    with pytest.raises(InputError, match=r"^friction: shape \(2, 2\); give \(2,\)"):
        simulate(anatomy, DEVICE, np.zeros((2, 4, 2)), friction=np.zeros((2, 2)))
    with pytest.raises(InputError, match="period_s: 0"):
        simulate(anatomy, DEVICE, np.zeros((2, 4, 2)), period_s=0.0)
    with pytest.raises(InputError, match=r"need .* simulate fewer at once$"):
        simulate(anatomy, DEVICE, np.broadcast_to(0.0, (10_000_000, 10_000, 2)))


def test_a_list_and_the_name_of_a_motion_are_taken(anatomy: Anatomy) -> None:
    from endopilot.simulation.motion import motion_named

    control = [[[5.0, 0.5], [6.0, -0.5]]]
    named = simulate(anatomy, DEVICE, control, initial=[[8, 0]], motion="breathing")
    made = simulate(
        anatomy, DEVICE, np.array(control), initial=np.array([[8.0, 0.0]]), motion=motion_named("breathing")
    )
    for name in ("tip_position", "base_force", "vessel_to_laboratory"):
        np.testing.assert_array_equal(getattr(named, name), getattr(made, name))
    with pytest.raises(InputError, match="motion: 'loud'; give Motion or one of 'still', 'breathing'"):
        simulate(anatomy, DEVICE, control, motion="loud")


def test_a_sequence_does_not_depend_on_the_others() -> None:
    few = random_controls(ControlConfig(), n_sequences=3, n_samples=50, seed=4, max_inserted_length_mm=100.0)
    many = random_controls(ControlConfig(), n_sequences=9, n_samples=50, seed=4, max_inserted_length_mm=100.0)
    other = random_controls(ControlConfig(), n_sequences=3, n_samples=50, seed=5, max_inserted_length_mm=100.0)
    assert np.array_equal(few[0], many[0][:3])
    assert np.array_equal(few[1], many[1][:3])
    assert not np.array_equal(few[1], other[1])


def test_the_load_of_a_free_wire_moves_it_at_the_drawn_speed() -> None:
    device = replace(read_wire("workhorse-014"), tip_bend_rad=0.0)
    config = SimulatorConfig()
    velocity = np.repeat([[[-1.5, 1.0]], [[1.0, -3.0]]], 2, axis=1)
    load = free_wire_load(
        velocity,
        radius_mm=device.tip_radius_mm,
        friction_n=config.introducer_friction_n,
        drag_n_s_mm=config.introducer_drag_n_s_mm,
        stick_mm_s=config.stick_velocity_mm_s,
    )
    initial = np.tile([2.0, 0.0], (2, 1))
    trajectory = simulate(vessel(), device, load, actuation="force", initial=initial, config=config)
    # In the first sample the wire starts from rest; in the second the blood's drag is left. 1 % of load is 25 % of
    # speed.
    np.testing.assert_allclose(trajectory.control[:, 1, 0], velocity[:, 1], rtol=0.02)
    travel = 0.5 * np.cumsum(trajectory.control[..., 0], axis=1)
    np.testing.assert_allclose(trajectory.inserted_length, 2.0 + travel, rtol=1e-12)
    assert np.array_equal(np.stack([trajectory.drive_force, trajectory.drive_torque], axis=-1), trajectory.command)
    assert np.array_equal(trajectory.command[:, :, 0], load)


def test_insertion_stays_in_its_range() -> None:
    config = ControlConfig()
    initial, control = random_controls(config, n_sequences=200, n_samples=120, seed=0, max_inserted_length_mm=80.0)
    inserted = initial[:, None, :, 0] + 0.5 * np.cumsum(control[..., 0], axis=1)
    assert inserted.min() > -1e-9
    assert inserted.max() < 80 + 1e-9
    assert np.abs(control[..., 0]).max() <= config.max_velocity_mm_s
    assert np.abs(control[..., 1]).max() <= config.max_rotation_rad_s
    assert np.abs(control[..., 1]).max() > 0.8 * config.max_rotation_rad_s
