"""The wall of an anatomy for the core: as fine as a wide catheter needs it, and as it was for all others."""

from __future__ import annotations

import numpy as np
import pytest

import endopilot
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.vessel_wall import FINE_MM, make_wall
from endopilot.types import Anatomy


@pytest.fixture(scope="module")
def vessel() -> Anatomy:
    return make_patient(AtlasConfig(seed=7), 3)  # of 1.3 mm radius and more, with a map of 0.49 mm spacing


@pytest.fixture(scope="module")
def wide() -> Stack:
    return Stack(read_wire("workhorse-014"), (read_catheter("straight-5f"),))


def axis_of_guiding_catheter(anatomy: Anatomy) -> np.ndarray:
    return anatomy.insertion.position + np.linspace(-3, 0, 200)[:, None] * anatomy.insertion.direction


def test_the_guiding_catheter_is_as_wide_as_it_is_for_a_catheter_that_fills_it(vessel: Anatomy, wide: Stack) -> None:
    axis, radius = axis_of_guiding_catheter(vessel), vessel.catheter_radius_mm
    coarse = make_lumen(vessel.distance_map, wide.outer_radius_mm).distance(axis)
    assert coarse.min() < wide.outer_radius_mm - 0.1  # the map leaves no room for it
    fine = make_wall(vessel, wide, SimulatorConfig()).distance(axis)
    assert fine.min() > radius - 0.5 * FINE_MM
    assert np.median(fine) == pytest.approx(radius, abs=0.25 * FINE_MM)


def test_a_finer_wall_lies_where_the_wall_was(vessel: Anatomy, wide: Stack) -> None:
    """The surface where the distance is half a millimetre, found along rays from the centerline."""
    coarse, fine = make_lumen(vessel.distance_map, wide.outer_radius_mm), make_wall(vessel, wide, SimulatorConfig())
    line = vessel.tree.branches[0].centerline
    draw = np.random.default_rng(0)
    at = draw.integers(10, len(line.points) - 10, 300)
    rays = draw.normal(size=(300, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    out = np.arange(0, 4, 0.02)
    points = line.points[at][:, None] + out[:, None] * rays[:, None]
    depths = []
    for wall in (coarse, fine):
        inside = wall.distance(points.reshape(-1, 3)).reshape(len(rays), -1) > 0.5
        depths.append(out[np.argmin(inside, axis=1)])
    apart = np.abs(depths[0] - depths[1])
    assert np.median(apart) <= 0.02 and np.percentile(apart, 95) <= 0.06


@pytest.mark.parametrize("catheters", [(), ("microcatheter-1.7f",), ("microcatheter-2.4f",)])
def test_the_wall_stays_as_it_is_for_devices_that_find_room_in_it(vessel: Anatomy, catheters: tuple[str, ...]) -> None:
    stack = Stack.of("workhorse-014", *catheters)
    wall, plain = make_wall(vessel, stack, SimulatorConfig()), make_lumen(vessel.distance_map, stack.outer_radius_mm)
    points = vessel.tree.branches[0].centerline.points
    assert wall.bytes == plain.bytes
    np.testing.assert_array_equal(wall.distance(points), plain.distance(points))


def test_a_straight_catheter_that_fills_the_guiding_catheter_does_not_press_it(vessel: Anatomy, wide: Stack) -> None:
    """A straight tube on the axis of a wider one touches it no more than the bent tip of the wire in it does."""
    initial = np.array([[[0.0, 0.0], [1.0, 0.0]]])
    trajectory = endopilot.simulate(vessel, wide, np.zeros((1, 4, 2, 2)), initial=initial)
    assert trajectory.valid.all()
    assert trajectory.contact_force_max.max() < 0.2  # N; 10 N and more where the map is too coarse
