"""Balance of forces in a random navigation, from the recorded shapes alone."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate


def test_the_push_balances_the_wall() -> None:
    # At rest and without friction the drive's push along the catheter's axis d and the wall's forces on the wire
    # cancel: push = -d · Σ k (r - φ) ∇φ over the contact points with φ < r, φ being the quadratic spline of the
    # distance map. They are the nodes and the middles of elements, where the wire's curve passes them.
    anatomy, device = make_patient(AtlasConfig(population="textbook"), 0), read_wire("workhorse-014")
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=6, n_samples=24, seed=3, max_inserted_length_mm=longest
    )
    control[:, -4:] = 0.0  # at rest, where drag has gone
    config = SimulatorConfig(tolerance_mm=1e-7, wall_stiffness_n_mm=5.0, threads=1)
    rollout = simulate(
        anatomy, device, control, initial=initial, config=config, record_shape=True, friction=np.zeros(len(control))
    )
    assert rollout.valid.all() and rollout.shape is not None
    nodes, field = rollout.shape[:, -1].astype(float), anatomy.distance_map
    chord = nodes[:, :-1] - nodes[:, 1:]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    bend = (chord / length)[:, :-1] - (chord / length)[:, 1:]
    bend /= 0.5 * (length[:, :-1] + length[:, 1:])  # curvature vectors at the nodes
    bend = np.concatenate([bend[:, :1], bend, bend[:, -1:]], axis=1)
    middles = 0.5 * (nodes[:, :-1] + nodes[:, 1:]) - length**2 / 16 * (bend[:, :-1] + bend[:, 1:])
    points = np.concatenate([nodes, middles], axis=1)

    def distance(points: np.ndarray) -> np.ndarray:
        index = ((points - field.origin_mm) / field.spacing_mm)[..., ::-1]
        return map_coordinates(field.values.astype(float), np.moveaxis(index, -1, 0), order=2, mode="nearest")

    small = 1e-3 * np.eye(3)
    slope = np.stack([(distance(points + step) - distance(points - step)) / 2e-3 for step in small], axis=-1)
    depth = np.maximum(device.tip_radius_mm - distance(points), 0.0)
    behind = (nodes - anatomy.insertion.position) @ anatomy.insertion.direction
    held = (np.cumsum(behind[:, ::-1] > -3.0, axis=1) == 0)[:, ::-1]  # by the drive, in the catheter
    held = np.concatenate([held, held[:, 1:]], axis=1)  # the element that joins the base touches nothing
    pressed = np.where(held, 0.0, config.wall_stiffness_n_mm * depth)
    wall = (pressed[..., None] * slope).sum(axis=1) @ anatomy.insertion.direction
    push = rollout.base_force[:, -1, 0]
    assert np.abs(pressed.sum(axis=1) - rollout.contact_force_sum[:, -1]).max() < 0.05 * rollout.contact_force_sum.max()
    assert np.abs(push).max() > 5e-3
    assert np.abs(push + wall).max() < 0.01 * np.abs(push).max() + 1e-4, (push, wall)
