"""A wall that yields, and friction and stiffness that vary along the vessel; what cannot be followed is invalid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bend import vessel

from endopilot.anatomy.distance import sample
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import COMPLIANT_WALL_AT_TIP_MM, COMPLIANT_WALL_STIFFENING_MM2, SimulatorConfig
from endopilot.simulation.core_state import CONTACTS, LIMIT, NODE, NORMAL_FORCE, OFFSET, POSITION, nodes_of, with_nodes
from endopilot.simulation.groups import factor_at
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator

WIRE = read_wire("workhorse-014")
CORE = SimulatorConfig(time_step_s=0.05, element_mm=1.5, threads=1, tolerance_mm=1e-6)
STIFF = read_wire("stiff-014")
PUSH = np.tile([5.0, 0.3], (1, 16, 1))
START = np.array([[20.0, 0.0]])
FARTHER = np.tile([5.0, 0.3], (2, 24, 1))
RIGID, SOFT = SimulatorConfig(), SimulatorConfig(compliant_wall_n_mm2=0.01)


@pytest.fixture(scope="module")
def pushed(anatomy):
    """Return a function that pushes a wire into the bend under some settings and a coefficient of friction."""

    def push(friction=0.1, **changed):
        return simulate(
            anatomy, WIRE, PUSH, initial=START, friction=np.array([[friction]]), config=replace(CORE, **changed)
        )

    return push


def test_a_state_has_its_numbers_where_they_are_said_to_be(anatomy):
    simulator = Simulator(anatomy, WIRE, worlds=2, config=CORE)
    simulator.reset(inserted_length=[35.0, 40.0], rotation=[0.0, 0.5], friction=[0.1, 0.3])
    simulator.step(np.tile([5.0, 0.0], (2, 1)), 0.5)
    numbers = nodes_of(simulator.state.values[0], simulator.nodes, 1)
    assert numbers.shape == (2, simulator.nodes, NODE)
    np.testing.assert_array_equal(sum(numbers[..., at + NORMAL_FORCE] for at in CONTACTS), simulator.contacts)
    active = int(simulator.active_nodes.min())
    offset = numbers[..., CONTACTS[0] :][..., OFFSET]
    np.testing.assert_array_equal((numbers[..., POSITION] + offset)[:, :active], simulator.position[:, :active])
    for at in CONTACTS:  # the limit is the coefficient times the force, extrapolated by half a step
        touches = numbers[..., at + NORMAL_FORCE] > 1e-3
        ratio = numbers[..., at + LIMIT] / np.where(touches, numbers[..., at + NORMAL_FORCE], 1.0)
        np.testing.assert_allclose(ratio[0][touches[0]], 0.1, rtol=0.3)
        np.testing.assert_allclose(ratio[1][touches[1]], 0.3, rtol=0.3)
    state = simulator.state.values[0]
    np.testing.assert_array_equal(with_nodes(state, numbers, 1), state)


def test_the_same_factor_everywhere_is_that_friction(pushed):
    plain, rough, thrice = pushed(), pushed(0.3), pushed(friction_along=(3.0, 3.0))
    np.testing.assert_allclose(thrice.tip_position, rough.tip_position, atol=0.06)  # brought to its start with 0.1
    np.testing.assert_allclose(thrice.base_force[0, 4:], rough.base_force[0, 4:], rtol=0.05)
    assert thrice.base_force[0, -1, 0] > 1.2 * plain.base_force[0, -1, 0]
    np.testing.assert_allclose(pushed(friction_along=(1.0,)).tip_position, plain.tip_position, atol=0.02)


def test_what_is_rough_ahead_holds_the_wire_once_it_is_there(pushed):
    plain, ahead = pushed(), pushed(friction_along=(1.0, 1.0, 1.0, 5.0, 5.0))
    force, before = ahead.base_force[0, :, 0], plain.base_force[0, :, 0]
    there = plain.tip.abscissa[0, :, 0] > 45.0  # the path is 64 mm long
    assert (force[there] > 1.1 * before[there]).all() and force[-1] > 1.25 * before[-1]
    np.testing.assert_allclose(force[:3], before[:3], rtol=0.05)


def test_the_wall_yields_where_it_is_soft(anatomy):
    soft = replace(CORE, compliant_wall_n_mm2=0.04)

    def dents(**changed):
        made = simulate(anatomy, WIRE, PUSH, initial=START, config=replace(soft, **changed), record_shape=True)
        assert made.valid.all() and made.shape is not None
        nodes = made.shape[0, -1]
        depth = WIRE.tip_radius_mm - sample(anatomy.distance_map, nodes)
        along = anatomy.tree.branches[0].centerline
        at = along.abscissa[np.argmin(np.linalg.norm(nodes[:, None] - along.points, axis=2), axis=1)]
        return at, depth, made.base_force[0, -1, 0]

    _, even, _ = dents()
    _, four, _ = dents(wall_along=(4.0,))
    _, stiff, _ = dents(compliant_wall_n_mm2=0.16)
    assert four.max() == pytest.approx(stiff.max(), rel=0.1) and four.max() < 0.5 * even.max()
    at, graded, _ = dents(wall_along=(0.25, 4.0))
    _, grew, _ = dents(wall_along=(4.0, 0.25))
    assert graded[at < 25].max() > 2 * grew[at < 25].max() and graded[at > 40].max() < grew[at > 40].max()


def test_the_wall_yields_to_the_side_where_it_is_soft(anatomy):
    """Factors begin at the normals, which here stand across the plane of the bend: its outer wall is a quarter away."""
    line = anatomy.tree.branches[0].centerline
    tangent = np.gradient(line.points, axis=0)
    outwards = np.cross(tangent, line.normals)  # a quarter turn on from the normals
    middle = len(line.points) // 2
    outer = outwards[middle] @ (line.points[[0, -1]].mean(axis=0) - line.points[middle]) < 0

    def dent(around):
        config = replace(CORE, compliant_wall_n_mm2=0.04, wall_around=around)
        made = simulate(anatomy, WIRE, PUSH, initial=START, config=config, record_shape=True)
        assert made.valid.all() and made.shape is not None
        return (WIRE.tip_radius_mm - sample(anatomy.distance_map, made.shape[0, -1])).max()

    one, other = dent((1.0, 0.25, 1.0, 4.0)), dent((1.0, 4.0, 1.0, 0.25))
    soft, stiff = (one, other) if outer else (other, one)
    assert soft > 2 * stiff  # the wire lies on the outer wall
    assert dent((4.0,)) == pytest.approx(dent((4.0, 4.0, 4.0)), rel=1e-6)


def test_walls_that_vary_otherwise_are_not_shared(anatomy):
    soft = replace(CORE, compliant_wall_n_mm2=0.04)
    # as stiff where they are stiffest: the maps alone differ
    one, other = (
        Simulator(anatomy, WIRE, config=replace(soft, wall_along=each)) for each in ((0.25, 4.0), (4.0, 0.25))
    )
    for each in (one, other):
        each.reset(inserted_length=[40.0], rotation=[0.0])
    assert np.abs(other.position - one.position).max() > 1e-3


def test_a_factor_is_linear_between_its_places(anatomy):
    end = float(anatomy.tree.longest_path().abscissa[-1])
    found = factor_at(np.array([-3.0, 0.0, 0.25 * end, end, end + 9.0]), anatomy.tree, (1.0, 3.0, 2.0))
    assert found == pytest.approx([1.0, 1.0, 2.0, 2.0, 2.0])
    assert factor_at(np.array([5.0]), anatomy.tree, (3.0,)) == pytest.approx([3.0])
    with pytest.raises(InputError, match="wall_along: the wall is not compliant"):
        SimulatorConfig(wall_along=(1.0, 2.0))
    with pytest.raises(InputError, match="wall_around: the wall is not compliant"):
        SimulatorConfig(wall_around=(1.0, 2.0))
    with pytest.raises(InputError, match=r"wall_along: the wall has 0\.0025 N/mm² at least"):
        SimulatorConfig(compliant_wall_n_mm2=0.01, wall_along=(1.0, 0.25))


def test_a_stiff_wire_straightens_a_compliant_vessel(anatomy) -> None:
    rigid, soft = (simulate(anatomy, STIFF, FARTHER, config=config) for config in (RIGID, SOFT))
    assert rigid.valid.all() and soft.valid.all()
    assert soft.wall_force.max() < 0.7 * rigid.wall_force.max()
    assert soft.base_force.max() < rigid.base_force.max()
    # The wire cuts the bend: its tip, in the straight part behind it, has the same length of wire and more vessel.
    assert (soft.tip.abscissa[:, -1] != rigid.tip.abscissa[:, -1]).all()


def test_the_displacement_does_not_depend_on_the_elements(anatomy) -> None:
    # The wall's stiffness belongs to the length of the wire, not to its nodes.
    rough, fine = (
        simulate(anatomy, STIFF, FARTHER[:1], config=replace(SOFT, element_mm=size)) for size in (0.75, 0.375)
    )
    np.testing.assert_allclose(fine.tip_position[0, -1], rough.tip_position[0, -1], atol=0.01)
    np.testing.assert_allclose(fine.contact_force_sum[0, 8:], rough.contact_force_sum[0, 8:], rtol=0.05)


def test_the_tip_takes_more_of_the_wall_along_than_its_own_length() -> None:
    # Head on, the tip alone touches: F = K (l/4 + 6.4 mm) d exp(s d²), with d by which it is beyond the blind end.
    anatomy, wire = vessel(0.01), STIFF.with_tip(bend_rad=0.0, stiffness_factor=1.0)
    pushed = simulate(anatomy, wire, np.tile([0.3, 0.0], (1, 4, 1)), initial=np.array([[34.9, 0.0]]), config=SOFT)
    depth = wire.tip_radius_mm - sample(anatomy.distance_map, pushed.tip_position[0, :, 0])
    assert 0.02 < depth[0] < depth[-1] < 0.5
    stiffness = 0.01 * (SOFT.element_mm / 4 + COMPLIANT_WALL_AT_TIP_MM)
    force = stiffness * depth * np.exp(COMPLIANT_WALL_STIFFENING_MM2 * depth**2)
    np.testing.assert_allclose(pushed.contact_force_max[0], force, rtol=0.01)


def test_a_wall_that_would_yield_beyond_the_distance_map_is_refused() -> None:
    for stiffness in (0.0, 0.003):
        with pytest.raises(InputError, match=f"compliant_wall_n_mm2: {stiffness:g}"):
            SimulatorConfig(compliant_wall_n_mm2=stiffness)
