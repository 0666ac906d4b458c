"""The wall of an anatomy for the core: as fine as a wide catheter needs it, and as it was for all others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import endopilot
from benchmarks.anatomy.analytic_lumens import forked_tree, tree_distance
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.groups import FINE_MM, make_wall
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy, DistanceMap
from toy_fork import SPACING_MM, make_fork


@pytest.fixture(scope="module")
def vessel() -> Anatomy:
    return make_patient(AtlasConfig(seed=23), 0)  # with a map of 0.41 mm spacing, too coarse for the wide catheter


@pytest.fixture(scope="module")
def wide() -> Stack:
    return Stack(read_wire("workhorse-014"), (read_catheter("straight-5f"),))


@pytest.fixture(scope="module")
def fine(vessel: Anatomy, wide: Stack):
    return make_wall(vessel, wide, SimulatorConfig())


def axis_of_guiding_catheter(anatomy: Anatomy) -> np.ndarray:
    return anatomy.insertion.position + np.linspace(-3, 0, 200)[:, None] * anatomy.insertion.direction


def test_the_guiding_catheter_is_as_wide_as_it_is_for_a_catheter_that_fills_it(vessel: Anatomy, wide, fine) -> None:
    axis, radius = axis_of_guiding_catheter(vessel), vessel.catheter_radius_mm
    coarse = make_lumen(vessel.distance_map, wide.outer_radius_mm).distance(axis)
    assert coarse.min() < wide.outer_radius_mm - 0.1  # the map leaves no room for it
    found = fine.distance(axis)
    assert found.min() > radius - 0.5 * FINE_MM
    assert np.median(found) == pytest.approx(radius, abs=0.25 * FINE_MM)


def test_a_finer_wall_lies_where_the_wall_was(vessel: Anatomy, wide: Stack, fine) -> None:
    """The surface where the distance is half a millimetre, found along rays from the centerline."""
    coarse = make_lumen(vessel.distance_map, wide.outer_radius_mm)
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


def test_a_wire_from_the_middle_of_a_wide_vessel_is_held_by_the_wall_that_it_reaches_within_a_period() -> None:
    """Where no wall is near none is stored; the vessel of 8 mm radius ends in a half sphere at z = 48 mm."""
    tree, low = forked_tree(radius=(8.0, 0.8)), np.array([-12.0, -12.0, -26.0])
    axes = [np.arange(a, b, SPACING_MM) for a, b in zip(low, (22.0, 12.0, 52.0), strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    catheter = np.where(z < 1.0, 0.9 - np.hypot(x, y), -1.0)
    inside = np.minimum(tree_distance(tree, np.stack([x, y, z], axis=-1)), z)
    values = np.maximum(np.maximum(inside, catheter), -1.0)
    anatomy = replace(make_fork(), tree=tree, distance_map=DistanceMap(values, SPACING_MM, low))
    simulator = Simulator([anatomy], [read_wire("workhorse-014")], config=SimulatorConfig(threads=1))
    simulator.reset(inserted_length=[20.0], rotation=[0.0])
    clearance = []
    for _ in range(2):
        assert simulator.step([[[40.0, 0.0]]], 0.5).valid.all()
        ahead = simulator.position[0, simulator.position[0, :, 2] > 2.0]
        clearance.append(tree_distance(tree, ahead).min())
    assert clearance[0] > 3.0 and 0.05 < clearance[1] < 0.19  # the wire's radius is 0.18 mm


@pytest.mark.parametrize("slope", [0.5, 3.0])
def test_the_largest_slope_of_a_map_is_known(slope: float) -> None:
    """A spline keeps a linear function, of gradient g = slope · (1, 2, 2)/3, as it is: its slope is |g| everywhere."""
    axis = SPACING_MM * np.arange(24)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    plane = DistanceMap(slope * (x + 2 * y + 2 * z) / 3, SPACING_MM, np.zeros(3))
    bent = DistanceMap(slope * np.abs(x - axis.mean()), SPACING_MM, np.zeros(3))
    assert slope * (1 - 1e-4) <= make_lumen(plane, 0.2).steepest <= 1.25 * slope  # it is mirrored at the map's edges
    wall, draw = make_lumen(bent, 10.0), np.random.default_rng(0)
    points = draw.uniform(axis[2], axis[-3], (20000, 3))
    beside = points + 1e-3 * draw.normal(size=points.shape)
    apart = np.abs(wall.distance(points) - wall.distance(beside)) / np.linalg.norm(points - beside, axis=1)
    assert apart.max() <= wall.steepest * (1 + 1e-3)


def test_a_wire_in_a_map_with_steep_walls_moves_alone_as_in_company() -> None:
    fork = make_fork(radius=(2.0, 1.5))
    values = np.maximum(4.0 * fork.distance_map.values, -1.0)
    steep = replace(fork, distance_map=replace(fork.distance_map, values=values))
    draw = np.random.default_rng(3)
    control = np.stack([draw.uniform(-20, 40, (5, 12)), draw.uniform(-6, 6, (5, 12))], axis=-1)
    together = endopilot.simulate(steep, read_wire("workhorse-014"), control)
    for world in range(len(control)):
        alone = endopilot.simulate(steep, read_wire("workhorse-014"), control[[world]])
        np.testing.assert_array_equal(alone.tip_position, together.tip_position[[world]])
