"""Copies of the devices: their drives go somewhere and come back, or turn the wire to other sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.belief.monitor import Monitor
from endopilot.belief.moved_copies import SIDES, turn_to_all_sides
from endopilot.control.agent_config import read_agent_calibration
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.xray.fluoroscope import TipMeasurement

CONFIG = BeliefConfig(
    members=2,
    stiffness_levels=1,
    friction_spread=0.0,
    copies=32,
    element_mm=2.0,
    time_step_s=0.1,
    lost_along_mm=0.5,
    lost_across_mm=0.5,
)
MEMBERS = (World(), World(ostium_mm=0.02))


@pytest.fixture(scope="module")
def along_the_fork(fork, wire) -> Navigation:
    return Navigation(
        anatomy=fork,
        device=wire,
        target=Target(branch=1, abscissa=35.0),
        start_inserted_length_mm=25.0,
        start_rotation_rad=1.5,
    )


def seen_of(belief: Belief) -> TipMeasurement:
    """Return an exact measurement of the tip of a belief's first member."""
    tip, at = belief.tip, belief.simulator.tip_position[0, 0].copy()
    return TipMeasurement(at, float(tip.abscissa[0]), float(tip.offset[0]), int(tip.branch[0]), np.zeros((3, 3)))


def gone_and_come_back(navigation: Navigation) -> TipMeasurement:
    """Return where a tip is seen whose drive pulled it out of a branch, turned, and came back: into another branch."""
    belief = Belief(navigation, MEMBERS, CONFIG)
    for back in (0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0):
        belief.follow(((25.0 - 8.0 * back, 1.5 + 1.5 * back),))
    return seen_of(belief)


def test_copies_that_went_and_came_back_lie_as_the_real_devices_do(along_the_fork) -> None:
    seen, belief = gone_and_come_back(along_the_fork), Belief(along_the_fork, MEMBERS, CONFIG)
    drives = belief.simulator.at_drive.copy()
    belief.weigh(seen)
    apart = float(np.linalg.norm(seen.position - belief.simulator.tip_position[belief.best, 0]))
    assert apart > 3.0 and not belief.explains
    assert belief.seek(seen) and belief.explains
    assert np.linalg.norm(seen.position - belief.simulator.tip_position[:, 0], axis=1).max() < 0.7
    np.testing.assert_allclose(belief.simulator.at_drive, np.broadcast_to(drives[[0]], drives.shape), atol=1e-6)
    assert np.allclose(belief.weight, 0.5)


def test_without_copies_nothing_is_sought(along_the_fork) -> None:
    seen = gone_and_come_back(along_the_fork)
    for config, members in (
        (replace(CONFIG, copies=0), MEMBERS),
        (CONFIG, (World(), World(tip_stiffness_factor=1.2))),  # copies are of one kind
    ):
        belief = Belief(along_the_fork, members, config)
        before = belief.simulator.tip_position.copy()
        belief.weigh(seen)
        assert not belief.seek(seen) and np.array_equal(belief.simulator.tip_position, before)


def test_what_no_copy_explains_stays_unexplained(along_the_fork) -> None:
    belief = Belief(along_the_fork, MEMBERS, CONFIG)
    seen = seen_of(belief)
    far = replace(seen, position=seen.position + np.array([0.0, 0.0, 15.0]))
    belief.weigh(far)
    assert not belief.seek(far) and not belief.explains


def test_a_monitor_says_whether_devices_were_sought(along_the_fork) -> None:
    seen = gone_and_come_back(along_the_fork)
    monitor = Monitor(along_the_fork, read_agent_calibration("assumed", 1), config=CONFIG)
    monitor.belief = Belief(along_the_fork, MEMBERS, CONFIG)
    monitor.step(((25.0, 1.5),), (), seen)
    assert monitor.sought and not monitor.lost
    monitor.step(((25.0, 1.5),))
    assert not monitor.sought


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
