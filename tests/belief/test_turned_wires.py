"""Simulated wires as they would lie, turned to other sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.moved_copies import SIDES, turn_to_all_sides
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator


@pytest.mark.parametrize("fastest_rad_s", [12.6, 3.14])
def test_copies_of_a_wire_are_turned_to_all_sides_as_fast_as_its_drive_may(fork, wire, fastest_rad_s) -> None:
    stack, config = Stack(replace(wire, max_rotation_rad_s=fastest_rad_s)), SimulatorConfig(threads=1)
    simulator = Simulator(fork, stack, worlds=2, config=config)
    simulator.reset(inserted_length=np.full(2, 10.0), rotation=np.full(2, 0.5))
    fan = Simulator(fork, stack, worlds=SIDES, config=config)
    turn_to_all_sides(fan, 1, simulator)
    turned = np.sort(fan.at_drive[:, 0, 1])
    np.testing.assert_allclose(turned, 0.5 + np.pi * np.arange(-7, 9) / 8, atol=1e-9)
    np.testing.assert_allclose(fan.at_drive[:, 0, 0], 10.0)
