"""A wire that MuJoCo moves: beside the rod core's, and as a world."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from bend import BEND

from endopilot.anatomy.distance import sample
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Hand
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.engine_simulator import SHELL_MM, EngineSimulator, wall_triangles
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target

WIRE = read_wire("workhorse-014")
CORE = SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1)
needs_mujoco = pytest.mark.skipif(
    importlib.util.find_spec("mujoco") is None, reason="MuJoCo is not installed; pip install 'endopilot[engine]'"
)


@needs_mujoco
def test_two_engines_push_a_wire_around_a_bend_alike(bend):
    engine, core = EngineSimulator(bend, Stack(WIRE), config=CORE), Simulator(bend, WIRE, config=CORE)
    for each in (engine, core):
        each.reset(inserted_length=[28.0], rotation=[0.3], friction=[0.1])
    steps = [[each.step([[5.0, 0.3]], 0.1) for each in (engine, core)] for _ in range(20)]
    theirs, ours = steps[-1]
    assert theirs.valid.all() and theirs.inserted_length[0, 0] == pytest.approx(38.0)
    assert theirs.rotation[0, 0] == pytest.approx(0.9) and engine.time[0] == pytest.approx(2.0)
    # no body of code is shared: the same wire lies on the same wall, pushed by the same force
    for one, other in steps:
        np.testing.assert_allclose(one.tip_position, other.tip_position, atol=0.3)
    np.testing.assert_allclose(engine.project().offset, core.project().offset, atol=0.1)
    mean_n = np.mean([[each.base_force[0, 0] for each in pair] for pair in steps], axis=0)
    assert mean_n[0] == pytest.approx(mean_n[1], rel=0.3)
    np.testing.assert_allclose(theirs.drive_force - theirs.base_force, ours.drive_force - ours.base_force, atol=2e-3)
    ahead = int(engine.active_nodes[0]) - 1
    assert ahead == int(core.active_nodes[0]) - 1
    assert sample(bend.distance_map, engine.position[0, :ahead]).min() > WIRE.tip_radius_mm - 0.1
    assert engine.contacts[0, 0] == pytest.approx(theirs.contact_force_max[0]) or theirs.contact_force_max[0] > 0
    with pytest.raises(InputError, match="another engine's state is not restored"):
        engine.set_state(engine.state)


@needs_mujoco
def test_a_wire_that_is_pulled_back_is_straight_again_in_its_catheter_and_bends_as_before(bend):
    engine, core = EngineSimulator(bend, Stack(WIRE), config=CORE), Simulator(bend, WIRE, config=CORE)
    for each in (engine, core):
        each.reset(inserted_length=[6.0], rotation=[0.5], friction=[0.1])
    np.testing.assert_allclose(engine.tip_position, core.tip_position, atol=0.15)
    np.testing.assert_allclose(engine.tip_direction, core.tip_direction, atol=0.15)
    before = engine.tip_position
    engine.step([[-12.0, 0.0]], 0.5)
    behind = engine.position[0, :8] - bend.insertion.position
    along = behind @ bend.insertion.direction
    off = np.linalg.norm(behind - along[:, None] * bend.insertion.direction, axis=1)
    assert engine.inserted_length[0, 0] == pytest.approx(0.0) and off[along < -4.0].max() < 0.05
    engine.step([[12.0, 0.0]], 0.5)
    np.testing.assert_allclose(engine.tip_position, before, atol=0.1)


@needs_mujoco
def test_it_is_a_world_of_a_navigation(bend):
    navigation = Navigation(
        anatomy=bend, device=WIRE, target=Target(branch=0, abscissa=60.0), start_inserted_length_mm=25.0, seconds=0.5
    )
    runs = [
        NavigationLoop(navigation, Hand(((4.0, 0.2),)), config=LoopConfig(simulator=CORE), seed=1, world=world).run()
        for world in (World(engine="mujoco"), World(engine="mujoco", friction_factor=2.0), World())
    ]
    theirs, rough, ours = runs
    assert (
        theirs.reason == "time" and theirs.cycles is not None and theirs.cycles.about["world"] == {"engine": "mujoco"}
    )
    assert theirs.trajectory.valid.all()
    np.testing.assert_allclose(theirs.tip.abscissa, ours.tip.abscissa, atol=0.5)
    assert not np.array_equal(theirs.tip_position, ours.tip_position)
    assert not np.array_equal(theirs.tip_position, rough.tip_position)
    again = NavigationLoop(
        navigation, Hand(((4.0, 0.2),)), config=LoopConfig(simulator=CORE), seed=1, world=World(engine="mujoco")
    ).run()
    np.testing.assert_array_equal(again.tip_position, theirs.tip_position)


def test_the_wall_lies_outside_the_lumen_and_leaves_the_catheter_free(bend):
    points, faces = wall_triangles(bend.distance_map, bend.insertion, 2 * bend.catheter_radius_mm)
    np.testing.assert_allclose(sample(bend.distance_map, points), -SHELL_MM, atol=0.06)
    assert points[:, 0].min() > bend.insertion.position[0] - 7.0  # the axis leaves through no triangle
    assert points[:, 1].max() > BEND and faces.max() == len(points) - 1


def test_what_it_cannot_move_is_refused(bend):
    with pytest.raises(InputError, match="engine: mujoco with motion"):
        World(engine="mujoco", motion=Motion())
    with pytest.raises(InputError, match="engine: mujoco with friction_along"):
        World(engine="mujoco", friction_along=(1.0, 2.0))
    stack = Stack(WIRE, (read_catheter("microcatheter-1.7f"),))
    with pytest.raises(InputError, match="a wire alone in a rigid wall"):
        EngineSimulator(bend, stack, config=CORE)
    navigation = Navigation(anatomy=bend, device=WIRE, target=Target(branch=0, abscissa=60.0))
    with pytest.raises(InputError, match="vessel that lies still"):
        NavigationLoop(
            navigation, Hand(), config=LoopConfig(simulator=CORE, motion=Motion()), world=World(engine="mujoco")
        )
    with pytest.raises(InputError, match="datasets are of the rod core alone"):
        World(engine="mujoco").check_engine("datasets")
