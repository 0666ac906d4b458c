"""Worlds: what each field changes in reality, and the files that hold them."""

from __future__ import annotations

import runpy
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.anatomy.distance import sample
from endopilot.devices.catheter import read_catheter
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.world import NOMINAL, Stenosis, World, list_worlds, read_world
from endopilot.tasks.navigation import Navigation, Target
from toy_fork import make_fork

CORE = SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1)
IDEAL = read_robot("ideal")


class Forward:
    """Pushes on at one speed with X-ray on, and keeps what it is given."""

    def __init__(self, speed: float = 4.0, rotation: float = 0.0) -> None:
        self.speed, self.rotation, self.given = speed, rotation, []

    def start(self, navigation, seed):
        self.navigation = navigation

    def decide(self, observation):
        self.given.append(observation)
        return Decision(((self.speed, self.rotation),), expose=True)


@pytest.fixture(scope="module")
def straight(fork, wire):
    return Navigation(anatomy=fork, device=wire, target=Target(branch=1, abscissa=38.0), seconds=4.0)


def drive(navigation, world=None, policy=None, **changed):
    loop = NavigationLoop(
        navigation, policy or Forward(), config=LoopConfig(**{"robot": IDEAL, "simulator": CORE} | changed), world=world
    )
    return loop.run()


def depth(anatomy, along_mm, branch=0):
    """Return the distance to the wall on the centerline at some abscissae, mm."""
    line = anatomy.tree.branches[branch].centerline
    points = np.stack([np.interp(along_mm, line.abscissa, axis) for axis in line.points.T], axis=-1)
    return sample(anatomy.distance_map, points)


def test_a_nominal_world_is_what_is_given(straight, fork, wire):
    world = World()
    assert world.differences() == {} and world.drawn(fork, 3) == world == read_world(NOMINAL)
    assert world.wire(wire) == wire and world.anatomy(fork) is fork and world.core(CORE) is CORE
    assert world.real_robot(IDEAL) == IDEAL
    plain, named = drive(straight), drive(straight, world)
    for name in ("tip_position", "shape", "contact_force_max", "load"):
        np.testing.assert_array_equal(getattr(plain, name).view(np.int64), getattr(named, name).view(np.int64))


def test_the_tip_has_another_shape_and_stiffness(wire):
    bent = World(tip_bend_factor=1.5, tip_bend_length_factor=0.5).wire(wire)
    assert bent.tip_bend_rad == 1.5 * wire.tip_bend_rad
    assert bent.tip_bend_length_mm == 0.5 * wire.tip_bend_length_mm
    stiff = World(tip_stiffness_factor=2.0, shaft_stiffness_factor=3.0).wire(wire)
    at = np.array(wire.abscissa_mm)
    for profile in ("bend_stiffness_n_mm2", "twist_stiffness_n_mm2"):
        ratio = np.array(getattr(stiff, profile)) / np.array(getattr(wire, profile))
        np.testing.assert_allclose(ratio, np.where(at <= 10.0, 2.0, 3.0), rtol=1e-12)


def test_friction_wall_elements_and_motion_reach_the_simulator(straight):
    catheter, finer = read_catheter("microcatheter-1.7f"), {"element_mm": 0.5, "time_step_s": 0.025}
    world = World(friction_factor=2, compliant_wall_n_mm2=0.02, motion="both", **finer)
    both, config = replace(straight, catheters=(catheter,)), LoopConfig(simulator=CORE)
    set_up = NavigationLoop(both, Forward(), config=config, world=world).simulator.set_up
    assert set_up.friction[0].tolist() == [2 * straight.device.friction, 2 * catheter.friction]
    assert set_up.config == replace(CORE, compliant_wall_n_mm2=0.02, **finer) and set_up.motion == Motion()
    with pytest.raises(InputError, match=r"time_step_s: 0\.3 does not divide"):
        World(time_step_s=0.3)
    for bad in ("still", "shaking"):
        with pytest.raises(InputError, match=rf"motion: '{bad}'; choose from breathing, heartbeat and both"):
            World(motion=bad)


def test_a_lumen_is_scaled_and_offset(fork):
    # in the trunk's axis the distance to the wall of a tube of radius r is r; the wall then lies at f r + o
    along, radius = np.array([6.0, 10.0]), fork.tree.branches[0].centerline.radius[0]
    for world, wanted in ((World(lumen_factor=1.2), 1.2 * radius), (World(lumen_mm=-0.25), radius - 0.25)):
        real = world.anatomy(fork)
        assert real.tree.branches[0].centerline.radius == pytest.approx(wanted)
        np.testing.assert_allclose(depth(real, along) - depth(fork, along), wanted - radius, atol=1e-5)
        side = fork.tree.branches[0].centerline.points[20] + (wanted - 0.1) * np.array([[1.0, 0.0, 0.0]])
        assert sample(real.distance_map, side)[0] == pytest.approx(0.1, abs=0.05)
    behind = fork.insertion.position - 10.0 * fork.insertion.direction
    np.testing.assert_allclose(
        sample(real.distance_map, behind[None]), sample(fork.distance_map, behind[None]), atol=1e-6
    )  # the guiding catheter stays as wide as it is, to its end
    end = fork.insertion.position - 0.2 * fork.insertion.direction
    assert sample(World(lumen_mm=-0.4).anatomy(fork).distance_map, end[None])[0] > 0.75
    assert (World(lumen_mm=-0.25, lumen_factor=1.2).anatomy(fork).tree.branches[1].centerline.radius >= 0.02).all()


def test_a_stenosis_narrows_one_place(fork):
    line = fork.tree.longest_path()
    middle = 0.3 * line.abscissa[-1]
    real = World(stenosis=Stenosis(at_share=0.3, length_mm=6.0, diameter_share=0.6)).anatomy(fork)
    narrow = real.tree.longest_path()
    # the cosine: 1 - share/2 (1 + cos(π s)), s from the middle in halves of the length
    off = np.clip(np.abs(line.abscissa - middle) / 3.0, 0, 1)
    assert narrow.radius == pytest.approx(line.radius * (1 - 0.3 * (1 + np.cos(np.pi * off))), rel=1e-9)
    assert narrow.radius.min() == pytest.approx(0.4 * line.radius[0], rel=0.02)
    inside = depth(real, np.array([middle])) - depth(fork, np.array([middle]))
    assert inside[0] == pytest.approx(-0.6 * line.radius[0], abs=0.05)
    assert depth(real, np.array([middle - 4.0])) == pytest.approx(depth(fork, np.array([middle - 4.0])), abs=1e-6)


@pytest.mark.parametrize("side_mm", [0.8, 1.0])
def test_a_missing_branch_is_closed_and_its_parent_stays_open(side_mm):
    fork = make_fork(radius=(1.0, side_mm))
    tree = fork.tree
    section = np.where(np.arange(len(tree.branches[2].section)) >= 0, len(tree.section_names), 0)
    named = replace(
        fork,
        tree=replace(
            tree,
            section_names=(*tree.section_names, "side"),
            branches=(*tree.branches[:2], replace(tree.branches[2], section=section)),
        ),
    )
    real = World(occluded=("side",)).anatomy(named)
    side = named.tree.branches[2].centerline
    far = side.abscissa[side.abscissa > side.abscissa[0] + 3.0]
    assert (depth(real, far, 2) < 0.05).all() and (depth(named, far, 2) > 0.5).all()
    trunk = np.arange(2.0, 20.1)
    assert (depth(real, trunk) > 0.9 * depth(named, trunk)).all()
    on = np.arange(20.0, 38.0, 0.5)
    assert (depth(real, on, 1) > 0.9 * depth(named, on, 1)).all()
    for world in (World(occluded=("none",)), World(stenosis=Stenosis(section="none"))):
        with pytest.raises(InputError, match=r"section 'none'; .* has no such section \(it has .*side\)"):
            world.anatomy(named)
    narrow = World(stenosis=Stenosis(section="side", length_mm=4.0)).anatomy(named).tree.branches
    assert (narrow[1].centerline.radius == tree.branches[1].centerline.radius).all()
    assert narrow[2].centerline.radius.min() < 0.6 * side.radius.min()


def test_a_catheter_that_backs_out_takes_the_wire_along_and_no_encoder_sees_it(straight):
    policy, stays = Forward(), Forward()
    record = drive(straight, World(backs_out_mm=3.0, backs_out_after_s=2.0), policy)
    drive(straight, None, stays)
    encoder = np.array([seen.devices[0][0] for seen in policy.given])
    np.testing.assert_allclose(encoder, [seen.devices[0][0] for seen in stays.given], atol=1e-9)
    # 3 mm at 5 mm/s from 2 s on: 2.5 mm of them are done at 2.5 s, all at 3 s
    gone = encoder - record.inserted_length[:-1, 0]
    np.testing.assert_allclose(gone, np.interp(record.time_s[:-1], [2.0, 2.6], [0.0, 3.0]), atol=1e-6)
    still = drive(straight, World(backs_out_mm=3.0, backs_out_after_s=0.0), Forward(0.0))
    assert still.inserted_length.min() == pytest.approx(0.0, abs=1e-9)  # only 2 mm were inserted


def test_the_robot_is_another_than_the_one_that_is_known(straight):
    assert World(robot="kweon-2021-2d").robot == read_robot("kweon-2021-2d")
    world = World(robot={"wire": {"play_mm": 2.0}}, latency_factor=3.0)
    assert world.real_robot(IDEAL).wire.play_mm == 2.0
    assert world.real_robot(IDEAL).latency_s == pytest.approx(3 * RobotConfig().latency_s)
    policy = Forward()
    loop = NavigationLoop(
        straight, policy, config=LoopConfig(robot=IDEAL, simulator=CORE), world=World(latency_factor=2)
    )
    assert loop.navigation.robot == IDEAL == policy.navigation.robot
    with pytest.raises(InputError, match="robot 'none': no such robot or file"):
        World(robot="none")


def test_xray_shows_the_wire_beside_where_it_lies(straight):
    plain, biased = Forward(), Forward()
    drive(straight, None, plain)
    drive(straight, World(registration_mm=(0.0, 0.0, 0.7)), biased)  # along the vessel, where nothing clips it
    off = np.array([b.tip.position - a.tip.position for a, b in zip(plain.given, biased.given, strict=True)])
    np.testing.assert_allclose(off[1:].mean(axis=0), [0.0, 0.0, 0.7], atol=0.1)


def test_a_registration_drifts_and_an_ostium_lies_aside(fork):
    world = World(registration_mm=(0.5, 0.0, -1.0), drift_mm_min=(0.0, 2.0, 1.0), ostium_aside_mm=(0.3, -0.4))
    assert world.registered_mm(0.0) == (0.5, 0.0, -1.0) and world.registered_mm(30.0) == (0.5, 1.0, -0.5)
    given, real = fork.insertion, world.anatomy(fork).insertion
    off = real.position - given.position
    assert np.linalg.norm(off) == pytest.approx(0.5) and abs(off @ given.direction) < 1e-9
    np.testing.assert_allclose(real.direction, given.direction)


def test_what_is_drawn_follows_the_seed_and_what_is_given_stays(fork):
    world = World(share=0.2, tip_stiffness_factor=1.5, axis_deg=10.0)
    drawn = [world.drawn(fork, seed) for seed in range(6)]
    diameter = 2 * fork.tree.branches[0].centerline.radius[0]
    for each in drawn:
        assert abs(each.friction_factor - 1) == pytest.approx(0.2) == abs(each.latency_factor - 1)
        assert abs(each.ostium_mm) == pytest.approx(0.2 * diameter)
        assert each.tip_stiffness_factor == 1.5 and 0 <= each.axis_side_deg < 360
        assert each.drawn(fork, 7) == each
    assert world.drawn(fork, 0) == drawn[0] != drawn[1]
    told = (drawn[2].friction_factor, drawn[2].latency_factor, round(drawn[2].axis_side_deg, 6))
    assert told == (1.2, 0.8, 193.853634)  # as in all navigations that were recorded


def test_a_file_holds_a_world(tmp_path):
    world = World(
        about="all", occluded=("1",), stenosis=Stenosis(), robot="ideal", motion="both", registration_mm=(1, 0, 0)
    )
    world.write(tmp_path / "world.yaml")
    assert read_world(tmp_path / "world.yaml") == world
    assert from_record(World, world.differences(), onto=World()) == world


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lumen_factor: 3", "lumen_factor: 3; give a number from 0.5 to 2"),
        ("lumen: 1", "lumen: no such field"),
        ("frictionfactor: 1", "did you mean friction_factor?"),
        ("stenosis: {length_mm: -1}", "stenosis.length_mm: -1; give a number from 0.5 to 100"),
        ("robot: {wire: {play_mm: -1}}", "robot.wire.play_mm: -1; give a number from 0 to 50 mm"),
        ("robot: none.yaml", "robot 'none.yaml': no such robot or file"),
        ("motion: still", "motion: 'still'; choose from breathing, heartbeat and both"),
        ("registration_mm: [1, 2]", "registration_mm"),
        ("share: 1.0", "share: 1.0; give a number from 0 to below 1"),
        ("- 1", "holds no mapping of fields"),
        ("about: [", "YAML"),
        (None, "choose from nominal, "),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "world.yaml"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_world(path)
    assert str(path) in str(error.value) and message in str(error.value)


@pytest.fixture(scope="module")
def plain(straight):
    return drive(replace(straight, seconds=2.0))


@pytest.mark.parametrize("name", list_worlds())
def test_a_shipped_world_says_what_it_is_and_is_driven_in(name, straight, plain):
    world = read_world(name)
    assert (name == NOMINAL) or (world.about and "\n" not in world.about and len(world.differences()) > 1)
    record = drive(replace(straight, seconds=2.0), world)
    assert record.reason in ("time", "reached") and record.trajectory.valid.all()
    assert record.cycles.about["world"] == NavigationLoop(straight, Forward(), world=world).world.differences()
    if name not in (NOMINAL, "backing-out", "stenosis"):  # those begin later, or deeper
        same = record.tip_position[-1].tolist() == plain.tip_position[-1].tolist()
        seen = [m.position.tolist() for m in record.measured[:-1]] == [m.position.tolist() for m in plain.measured[:-1]]
        assert not (same and seen)


def test_the_page_has_every_field_and_every_shipped_world():
    script = Path(__file__).parents[2] / "docs" / "worlds.py"
    made = runpy.run_path(str(script))
    page = made["PAGE"].read_text(encoding="utf-8")
    assert made["page"]() == page  # run `python docs/worlds.py`
    for each in fields(World):
        assert f"| `{each.name}` |" in page
    for name in list_worlds()[1:]:
        assert f"| `{name}` | {read_world(name).about} |" in page
