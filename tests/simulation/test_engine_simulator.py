"""A wire that is a Kirchhoff rod: beside the rod core's, and as a world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bend import BEND, RADIUS

from endopilot.anatomy.distance import sample
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Hand
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.engine_simulator import EngineSimulator
from endopilot.simulation.kirchhoff_rod import PointWall
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target

WIRE = read_wire("workhorse-014")
CORE = SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1)


def test_two_engines_push_wires_around_a_bend_alike(anatomy):
    engine, core = (kind(anatomy, Stack(WIRE), worlds=2, config=CORE) for kind in (EngineSimulator, Simulator))
    for each in (engine, core):
        each.reset(inserted_length=[28.0, 20.0], rotation=[0.3, 2.0], friction=[0.1, 0.3])
    steps = [[each.step([[5.0, 0.3], [8.0, -1.0]], 0.1) for each in (engine, core)] for _ in range(10)]
    theirs = steps[-1][0]
    assert theirs.valid.all()
    np.testing.assert_allclose(theirs.inserted_length, [[33.0], [28.0]])
    np.testing.assert_allclose(theirs.rotation, [[0.6], [1.0]])
    np.testing.assert_allclose(engine.time, 1.0)
    # no law is shared: the same wires lie on the same wall, pressed and pushed by the same forces
    for one, other in steps:
        np.testing.assert_allclose(one.tip_position, other.tip_position, atol=0.4)
    mean = {
        name: np.mean([[getattr(each, name).ravel() for each in pair] for pair in steps], axis=0)
        for name in ("contact_force_sum", "wall_force", "drive_force")
    }
    for theirs_n, ours_n in mean.values():
        np.testing.assert_allclose(theirs_n, ours_n, rtol=0.3)
    active = engine.active_nodes.astype(int)
    np.testing.assert_array_equal(active, core.active_nodes)
    for world, ahead in enumerate(active - 1):
        turned = (engine.orientation[world, :ahead] * core.orientation[world, :ahead]).sum(axis=1)
        assert np.abs(turned).min() > 0.99
        assert sample(anatomy.distance_map, engine.position[world, :ahead]).min() > WIRE.tip_radius_mm - 0.03
    np.testing.assert_allclose(engine.contacts.sum(axis=1), theirs.contact_force_sum)


def test_what_rests_holds_by_friction_and_does_not_creep(anatomy):
    engine = EngineSimulator(anatomy, Stack(WIRE), config=CORE)
    engine.reset(inserted_length=[30.0], rotation=[0.3], friction=[0.3])
    engine.step([[5.0, 0.0]], 0.5)
    engine.step([[0.0, 0.0]], 0.5)
    rested = engine.tip_position, engine.contacts
    engine.step([[0.0, 0.0]], 2.0)
    np.testing.assert_allclose(engine.tip_position, rested[0], atol=1e-4)
    np.testing.assert_allclose(engine.contacts, rested[1], atol=1e-4)


def test_a_drive_slips_at_its_limit(anatomy):
    weak = replace(WIRE, push_limit_n=0.001)
    engine = EngineSimulator(anatomy, Stack(weak), config=CORE)
    engine.reset(inserted_length=[14.0], rotation=[0.3], friction=[0.3])
    begun = engine.inserted_length[0, 0]
    steps = [engine.step([[10.0, 0.0]], 0.25) for _ in range(4)]
    slipped = sum(float(step.slip[0, 0]) for step in steps)
    assert slipped > 1.0
    assert engine.inserted_length[0, 0] == pytest.approx(begun + 10.0 - slipped)
    assert max(float(step.base_force[0, 0]) for step in steps) < 0.004


def test_a_wire_that_is_pulled_back_is_straight_again_in_its_catheter_and_bends_as_before(anatomy):
    engine, core = EngineSimulator(anatomy, Stack(WIRE), config=CORE), Simulator(anatomy, WIRE, config=CORE)
    for each in (engine, core):
        each.reset(inserted_length=[6.0], rotation=[0.5], friction=[0.1])
    np.testing.assert_allclose(engine.tip_position, core.tip_position, atol=0.15)
    np.testing.assert_allclose(engine.tip_direction, core.tip_direction, atol=0.15)
    before = engine.tip_position
    engine.step([[-12.0, 0.0]], 0.5)
    behind = engine.position[0, :8] - anatomy.insertion.position
    along = behind @ anatomy.insertion.direction
    off = np.linalg.norm(behind - along[:, None] * anatomy.insertion.direction, axis=1)
    assert engine.inserted_length[0, 0] == pytest.approx(0.0) and off[along < -4.0].max() < 0.05
    engine.step([[12.0, 0.0]], 0.5)
    np.testing.assert_allclose(engine.tip_position, before, atol=0.1)


def test_it_is_a_world_of_a_navigation(anatomy):
    navigation = Navigation(
        anatomy=anatomy, device=WIRE, target=Target(branch=0, abscissa=60.0), start_inserted_length_mm=25.0, seconds=0.5
    )
    runs = [
        NavigationLoop(navigation, Hand(((4.0, 0.2),)), config=LoopConfig(simulator=CORE), seed=1, world=world).run()
        for world in (World(engine="kirchhoff"), World(engine="kirchhoff", friction_factor=2.0), World())
    ]
    theirs, rough, ours = runs
    assert (
        theirs.reason == "time"
        and theirs.cycles is not None
        and theirs.cycles.about["world"] == {"engine": "kirchhoff"}
    )
    assert theirs.trajectory.valid.all()
    np.testing.assert_allclose(theirs.tip.abscissa, ours.tip.abscissa, atol=0.5)
    assert not np.array_equal(theirs.tip_position, ours.tip_position)
    assert not np.array_equal(theirs.tip_position, rough.tip_position)
    again = NavigationLoop(
        navigation, Hand(((4.0, 0.2),)), config=LoopConfig(simulator=CORE), seed=1, world=World(engine="kirchhoff")
    ).run()
    np.testing.assert_array_equal(again.tip_position, theirs.tip_position)


def test_the_wall_lies_where_the_lumen_ends(anatomy):
    around = np.linspace(0.1, 1.4, 60)
    outward = np.column_stack([np.sin(around), -np.cos(around), 0 * around])
    side = np.cos(7 * around)[:, None] * outward + np.sin(7 * around)[:, None] * np.array([0.0, 0.0, 1.0])
    axis = np.array([0.0, BEND, 0.0]) + BEND * outward
    along = np.column_stack([np.cos(around), np.sin(around), 0 * around])
    for inside in (0.3, 0.1, -0.1):
        depth, axes, turns = PointWall(anatomy.distance_map).at(axis + (RADIUS - inside) * side, along)
        np.testing.assert_allclose(depth, inside, atol=0.02)
        np.testing.assert_allclose(axes[:, 0], -side, atol=0.05)
        np.testing.assert_allclose(np.abs((axes[:, 1] * along).sum(axis=1)), 1.0, atol=0.01)
        np.testing.assert_allclose(turns, 1 / RADIUS, atol=0.2)


def test_what_it_cannot_move_is_refused(anatomy):
    with pytest.raises(InputError, match="engine: kirchhoff with motion"):
        World(engine="kirchhoff", motion=Motion())
    with pytest.raises(InputError, match="engine: kirchhoff with friction_along"):
        World(engine="kirchhoff", friction_along=(1.0, 2.0))
    stack = Stack(WIRE, (read_catheter("microcatheter-1.7f"),))
    with pytest.raises(
        InputError, match="it has a wire alone, driven by velocities, in a rigid vessel of one friction"
    ):
        EngineSimulator(anatomy, stack, config=CORE)
    navigation = Navigation(anatomy=anatomy, device=WIRE, target=Target(branch=0, abscissa=60.0))
    with pytest.raises(InputError, match="that lies still"):
        NavigationLoop(
            navigation, Hand(), config=LoopConfig(simulator=CORE, motion=Motion()), world=World(engine="kirchhoff")
        )
    with pytest.raises(InputError, match="datasets are of the rod core alone"):
        World(engine="kirchhoff").check_engine("datasets")
