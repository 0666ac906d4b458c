"""A wall that yields: what a wire presses on is displaced, by less force; what cannot be followed is invalid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bend import vessel

from endopilot.anatomy.distance import sample
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import (
    COMPLIANT_WALL_AT_TIP_MM,
    COMPLIANT_WALL_STIFFENING_MM2,
    SimulatorConfig,
)
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator

STIFF = read_wire("stiff-014")
PUSH = np.tile([5.0, 0.3], (2, 24, 1))
RIGID, SOFT = SimulatorConfig(), SimulatorConfig(compliant_wall_n_mm2=0.01)


def test_a_stiff_wire_straightens_a_compliant_vessel() -> None:
    anatomy = vessel()
    rigid, soft = (simulate(anatomy, STIFF, PUSH, config=config) for config in (RIGID, SOFT))
    assert rigid.valid.all() and soft.valid.all()
    assert soft.wall_force.max() < 0.7 * rigid.wall_force.max()
    assert soft.base_force.max() < rigid.base_force.max()
    # The wire cuts the bend: its tip, in the straight part behind it, has the same length of wire and more vessel.
    assert (soft.tip.abscissa[:, -1] != rigid.tip.abscissa[:, -1]).all()


def test_the_displacement_does_not_depend_on_the_elements() -> None:
    # The wall's stiffness belongs to the length of the wire, not to its nodes.
    anatomy = vessel()
    rough, fine = (simulate(anatomy, STIFF, PUSH[:1], config=replace(SOFT, element_mm=size)) for size in (0.75, 0.375))
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


def test_a_simulator_with_a_compliant_wall_shares_no_rigid_one() -> None:
    anatomy = vessel()
    whole = simulate(anatomy, STIFF, PUSH[:, :4], config=SOFT)
    simulator = Simulator(anatomy, STIFF, worlds=2, config=SOFT, sharing=[Simulator(anatomy, STIFF, config=RIGID)])
    np.testing.assert_array_equal(simulator.run(PUSH[:, :4, None]).tip_position, whole.tip_position)


def test_a_catheter_straightens_more_than_its_wire() -> None:
    anatomy, wire = vessel(), read_wire("workhorse-014")
    stack, push = Stack(wire, (read_catheter("microcatheter-1.7f"),)), PUSH[:, :18]
    alone = simulate(anatomy, wire, push, config=SOFT)
    inside = simulate(anatomy, stack, np.stack([push, push], axis=2), config=SOFT)
    assert inside.valid.all()
    assert inside.wall_force.max() > alone.wall_force.max()


def test_a_wall_that_would_yield_beyond_the_distance_map_is_refused() -> None:
    for stiffness in (0.0, 0.003):
        with pytest.raises(InputError, match=f"compliant_wall_n_mm2: {stiffness:g}"):
            SimulatorConfig(compliant_wall_n_mm2=stiffness)


def test_a_stiff_wire_in_sharp_bends_stays_within_the_map() -> None:
    # A bed of springs that did not stiffen would let this wire leave the map.
    anatomy = make_patient(AtlasConfig(), 1)
    deep = 0.5 * anatomy.tree.longest_path().abscissa[-1]
    pushed = simulate(anatomy, STIFF, np.zeros((1, 1, 2)), initial=np.array([[deep, 0.0]]), config=SOFT)
    assert pushed.valid.all()
