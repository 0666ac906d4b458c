"""Simulated devices whose drives lie a metre behind the ostium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator

CONFIG = SimulatorConfig(element_mm=1.25, time_step_s=0.025, threads=1)
BEHIND = Transmission(length_mm=1000.0, twist_friction_n_mm_mm=2e-4)


def commands(worlds: int, samples: int, devices: int = 1, seed: int = 4) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return draw.uniform(-1, 1, (worlds, samples, devices, 2)) * [8.0, 4.0]


def simulator(anatomy, stack: Stack, worlds: int = 3) -> Simulator:
    made = Simulator(anatomy, stack, worlds=worlds, config=CONFIG)
    made.reset(inserted_length=np.full((worlds, len(stack)), 30.0), rotation=np.zeros((worlds, len(stack))))
    return made


def test_a_drive_without_a_length_behind_acts_at_the_ostium(anatomy, wire: Wire) -> None:
    control = commands(3, 6)
    plain = simulator(anatomy, Stack(wire)).run(control)
    rubs = Stack(wire, (), (Transmission(length_mm=0.0, twist_friction_n_mm_mm=1e-3),))
    near = simulator(anatomy, rubs)
    found = near.run(control)
    assert np.array_equal(found.tip_position, plain.tip_position)
    assert np.array_equal(found.drive_torque, plain.drive_torque)
    assert np.array_equal(near.drive_rotation, near.rotation)


def test_the_ostium_follows_the_drive_after_the_lag(anatomy, wire: Wire) -> None:
    stack = Stack(wire, (), (BEHIND,))
    world = simulator(anatomy, stack, 1)
    turning = np.tile([0.0, 4.0], (1, 12, 1))
    world.run(turning)
    # m ∫ s/GJ ds from the ostium to the drive, and what the torque there adds
    s = np.linspace(0.0, 1000.0, 20001)
    gj = wire.twist_stiffness(world.inserted_length[0, 0] + 3.0 + s)
    torque = world.base_load[0, 0, 1]
    lag = np.trapezoid((torque + BEHIND.twist_friction_n_mm_mm * s) / gj, s)
    assert world.drive_rotation[0, 0] == pytest.approx(24.0, abs=1e-12)
    assert world.drive_rotation[0, 0] - world.rotation[0, 0] == pytest.approx(lag, rel=0.03)
    assert world.rotation[0, 0] == pytest.approx(24.0 - lag, abs=0.05)


def test_a_drive_slips_at_its_own_torque(anatomy, wire: Wire) -> None:
    # friction takes 0.2 N mm of it, and no more than the limit reaches the drive
    weak = replace(wire, torque_limit_n_mm=0.1)
    world = simulator(anatomy, Stack(weak, (), (BEHIND,)), 1)
    trajectory = world.run(np.tile([0.0, 4.0], (1, 12, 1)))
    held = np.abs(trajectory.drive_torque).max()
    assert 0.1 <= held < 0.11  # with the introducer's valve
    assert world.drive_rotation[0, 0] < 2.0  # of 24 rad that were commanded
    assert world.rotation[0, 0] == pytest.approx(0.0, abs=0.05)


def test_what_cannot_be(anatomy, wire: Wire) -> None:
    with pytest.raises(InputError, match="transmissions: 2 for 1 devices; give one for each device, or none"):
        Stack(wire, (), (BEHIND, BEHIND))
    with pytest.raises(InputError, match="actuation: 'force' with a length between drive and ostium"):
        Simulator(anatomy, Stack(wire, (), (BEHIND,)), actuation="force")
    with pytest.raises(InputError, match=r"length_mm: -1.*give"):
        Transmission(length_mm=-1.0)
