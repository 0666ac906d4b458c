from __future__ import annotations

from dataclasses import replace

import numpy as np
from bend import vessel

from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, free_wire_load, random_controls
from endopilot.simulation.simulate import simulate


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
