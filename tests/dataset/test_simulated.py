"""Datasets made with the real rod core, of wires alone and in catheters: what is stored, what repeats it, what holds
it back, and what is refused."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset, write_episode
from endopilot.dataset.info import describe_dataset
from endopilot.dataset.loader import Dataset, read_dataset, read_joined
from endopilot.dataset.navigations import (
    PULL_BACK_MM,
    STOP_SHORT_MM,
    TIP_GROUP,
    draw_navigations,
    patient_motion,
    simulate_navigations,
)
from endopilot.dataset.schema import OF_ROBOT
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.evaluation.evaluate import Recorded
from endopilot.files import read_json
from endopilot.models.config import WINDOW
from endopilot.simulation.motion import motion_named
from endopilot.simulation.signals import Outputs
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.simulation.world import World

DEVICE = read_wire("workhorse-014")


def test_an_episode_simulated_from_the_disk_repeats_to_the_bit(tmp_path, patient):
    ranges = {"friction": (0.05, 0.2), "tip_bend_factor": (0.5, 1.5), "tip_stiffness_factor": (0.5, 2.0)}
    config = DatasetConfig(sequences=TIP_GROUP + 2, seconds=4.0, seed=2, **ranges)
    generate_dataset([patient], output=tmp_path / "dataset", device=DEVICE, config=config)
    data = read_dataset(tmp_path / "dataset")
    assert data.valid.all()
    assert data.stack.wire.name == DEVICE.name
    assert (data.anatomy_folder(str(data.anatomy[0]))) == patient.resolve()
    assert np.ptp(data.tip_abscissa, axis=1).max() > 1
    tips = list(zip(data.tip_bend.tolist(), data.tip_stiffness_factor.tolist(), strict=True))
    assert [tip == tips[0] for tip in tips] == [True] * TIP_GROUP + [False] * 2
    again = data.driven()
    for name in ("contact_force_sum", "drive_force", "tip_position"):
        np.testing.assert_array_equal(getattr(again, name).astype(np.float32), getattr(data, name))


def test_a_robot_makes_the_motions_and_what_it_was_told_and_measured_stands_beside_what_was_true(tmp_path, patient):
    play = DriveConfig(play_mm=2.4, play_rad=1.0, gain_sd_translation=0.05, grip_n=0.3)
    robot = RobotConfig(encoders_at="motor", jitter_s=0.05, wire=play)
    config = DatasetConfig(sequences=5, seconds=20.0, seed=2, sequences_per_file=3, friction=(0.05, 0.2))
    generate_dataset([patient], device=DEVICE, output=tmp_path / "all", config=config, robot=robot)
    data = read_dataset(tmp_path / "all")
    assert data.robot == robot and data.stack.wire.push_limit_n == 0.3
    assert data.decided is not None and data.encoders is not None and data.load is not None
    # encoders at the motors follow what the robot was told, late; the devices lie off them by gain and play
    motor = data.encoders[..., 0, 0] - data.initial[:, None, 0, 0]
    told = 0.5 * np.cumsum(data.decided[..., 0, 0].astype(float), axis=1)
    assert np.abs(motor - told).max() < 12.0 * (0.05 + 0.05 + 0.1)
    true = data.inserted_length[..., 0] - data.initial[:, None, 0, 0]
    assert np.abs(true - motor).max() > 1.2
    reversals = np.abs(np.diff(np.sign(data.decided[..., 0, 0]), axis=1)) == 2
    assert reversals.any()
    noise = data.load[..., 0, 0] - data.drive_force[..., 0]
    assert noise.std() == pytest.approx(play.load_sd_n, rel=0.2)
    # what the drives made of it repeats the navigation
    again = data.driven()
    np.testing.assert_array_equal(again.tip.abscissa.astype(np.float32), data.tip_abscissa)
    np.testing.assert_array_equal(again.inserted_length.astype(np.float32), data.inserted_length)
    # a navigation's robot does not depend on the others
    fewer = replace(config, sequences=2)
    generate_dataset([patient], device=DEVICE, output=tmp_path / "few", config=fewer, robot=robot)
    few = read_dataset(tmp_path / "few")
    for name in ("decided", "encoders", "load", "inserted_length"):
        np.testing.assert_array_equal(getattr(few, name), getattr(data, name)[:2])
    forced = replace(config, control="force")
    with pytest.raises(InputError, match="control: 'force' with a robot, which takes velocities; give 'velocity'"):
        generate_dataset([patient], device=DEVICE, output=tmp_path / "no", config=forced, robot=robot)


def test_wires_stay_inside_the_imaged_vessel_and_repeat_from_the_recorded_controls(patient):
    anatomy, config = read_anatomy(patient), DatasetConfig().simulator
    leaves = anatomy.tree.leaves()
    ends = np.array([b.centerline.abscissa[-1] if i in leaves else np.inf for i, b in enumerate(anatomy.tree.branches)])
    control = np.zeros((6, 24, 1, 2))
    control[..., 0] = 12.0
    control[..., 1] = np.linspace(-2, 2, 6)[:, None, None]
    initial = np.column_stack([np.linspace(70.0, 1.5 * ends[np.isfinite(ends)].max(), 6), np.zeros(6)])[:, None]
    friction = np.linspace(0.05, 0.2, 6)[:, None]
    set_up = SimulationSetUp([anatomy] * 6, [Stack(DEVICE)] * 6, initial, friction, "velocity", None, config)
    driven, stopped = simulate_navigations(set_up, control)
    assert driven.valid.all()
    assert stopped.all()
    assert (driven.tip.abscissa < ends[driven.tip.branch] - 0.5 * STOP_SHORT_MM).all()
    applied, started = driven.command[:, :, 0], driven.set_up.initial
    pulled = applied[..., 0] < 0
    assert pulled.any(axis=1).all()  # pushed into a dead end, every wire is pulled back
    longest = max(len(run) for world in pulled for run in "".join("x" if p else " " for p in world).split())
    assert 0.5 * 12.0 * longest == pytest.approx(PULL_BACK_MM, abs=6.1)
    free = ~pulled & (applied[..., 0] == 12.0)
    assert free.mean() > 0.3
    again = simulate(anatomy, DEVICE, applied, initial=started, friction=friction, config=config)
    np.testing.assert_array_equal(again.tip_position, driven.tip_position)
    np.testing.assert_array_equal(again.inserted_length, driven.inserted_length)


def test_a_dataset_driven_by_force(tmp_path, patient):
    config = DatasetConfig(sequences=2, seconds=12.0, control="force", sequences_per_file=1, seed=6)
    generate_dataset([patient], output=tmp_path / "dataset", device=DEVICE, config=config)
    samples = pd.read_parquet(tmp_path / "dataset/data/chunk-000/file-001.parquet")
    load, velocity = np.stack(samples["action"]), np.stack(samples["velocity"])
    assert np.array_equal(load, samples[["drive_force_n", "drive_torque_nmm"]].to_numpy())
    assert 0.05 < np.abs(load[:, 0]).max() < DEVICE.push_limit_n
    data = read_dataset(tmp_path / "dataset")
    one = data[1]
    assert np.array_equal(one.command[0, :, 0], load)
    assert np.array_equal(one.control[0, :, 0], velocity)
    travel = 0.5 * np.cumsum(one.control.astype(float), axis=1)
    np.testing.assert_allclose(one.inserted_length, one.initial[:, None, :, 0] + travel[..., 0], atol=1e-4)
    assert np.ptp(data.inserted_length, axis=1).max() > 5
    np.testing.assert_array_equal(one.driven().tip.abscissa.astype(np.float32), one.tip_abscissa)
    assert sum(data.manifest["manoeuvres"].values()) == pytest.approx(1)


def test_vessels_move_as_it_is_drawn_for_each_patient(tmp_path, patient):
    config = DatasetConfig(sequences=2, seconds=16.0, seed=2, motion="both", anatomy_shares=(1.0, 0.0, 0.0))
    generate_dataset([patient], output=tmp_path / "dataset", device=DEVICE, config=config)
    data = read_dataset(tmp_path / "dataset")
    name = str(data.anatomy[0])
    assert data.motion(name) == patient_motion(config, name) != patient_motion(config, "somebody else")
    assert patient_motion(replace(config, motion="still"), name) is None
    options = {"initial": data.initial, "config": config.simulator}
    moved, still = (
        simulate(read_anatomy(patient), DEVICE, data.command, motion=motion, **options)
        for motion in (data.motion(name), None)
    )
    np.testing.assert_array_equal(moved.tip.abscissa.astype(np.float32), data.tip_abscissa)
    assert np.abs(still.tip.abscissa - data.tip_abscissa).max() > 0.3
    recorded = Recorded.of(data)
    ((_, again),) = recorded.simulated({"true_replay": data.command[:, WINDOW:, 0]})
    np.testing.assert_array_equal(again.tip.abscissa.astype(np.float32), data.tip_abscissa)


WIRE, CATHETER = read_wire("workhorse-014"), read_catheter("microcatheter-1.7f")
WEAK = replace(CATHETER, push_limit_n=0.03, pull_limit_n=0.021)
CONFIG = DatasetConfig(sequences=3, seconds=10.0, seed=7)
OF_EPISODES = ("folder", "manifest", "sample_period_s", "anatomy", "sequence", "split", "friction")
OF_EPISODES += ("tip_bend", "tip_stiffness_factor", "initial")
OF_TRAJECTORY = ("command", "control", *(each.name for each in fields(Outputs)))
OF_TIP = {"tip_abscissa": "abscissa", "tip_offset": "offset", "branch": "branch", "lumen_radius": "radius"}
EXACT = {"command": np.float64, "slip": np.float64, "rotation_slip": np.float64, "valid": np.bool_}


@pytest.fixture(scope="module")
def pairs(patient, tmp_path_factory):
    """Return a dataset of a wire in a weakly driven catheter, which slips."""
    folder = tmp_path_factory.mktemp("pairs") / "dataset"
    generate_dataset([patient], output=folder, device=Stack(WIRE, (WEAK,)), config=CONFIG)
    return folder


def test_the_commands_of_both_devices_repeat_an_episode_to_the_bit(pairs, patient):
    data = read_dataset(pairs)
    assert data.valid.all() and data.command.shape == (3, 20, 2, 2)
    assert (data.slip[:, :, 1] != 0).any()
    again = data.driven()
    _assert_same(data, again)
    first = data.inserted_length[:, 0] - 0.5 * data.control[:, 0, :, 0]
    assert np.abs(first - data.initial[..., 0])[:, 1].max() > 0.01  # one is carried along before the first period
    slips_mm_s = np.abs(data.slip[:, :, 1]) / 0.5
    assert (slips_mm_s > 1.1 * np.abs(data.command[:, :, 1, 0])).any()  # is carried along by the wire


def test_every_number_of_every_device_is_read_back(patient, tmp_path):
    drawn = draw_navigations(CONFIG, WIRE, read_anatomy(patient), range(1), devices=2)
    initial, stack = drawn.initial + np.array([[0.1, 0.2], [0.3, 0.4]]), Stack(WIRE, (WEAK,))
    made = simulate(
        read_anatomy(patient),
        stack,
        drawn.control,
        initial=initial,
        friction=np.array([[0.12, 1.2 * WEAK.friction]]),  # of wire and catheter, in reality
        config=CONFIG.simulator,
        motion="heartbeat",
    )
    assert (made.command != made.command.astype(np.float32)).any() and (made.slip != 0).any()
    told = {"task": "navigate", "seed": 7, "origin": {}, "tip_stiffness_factor": 1.0}
    write_episode(made, patient, tmp_path / "episode", stack, **told)
    data = read_dataset(tmp_path / "episode")
    _assert_same(data, made)
    assert data.motion(str(data.anatomy[0])) == motion_named("heartbeat")
    np.testing.assert_array_equal(data.initial, initial)
    np.testing.assert_array_equal(data.friction, made.set_up.friction)
    kept = {field.name for field in fields(data)} - set(OF_EPISODES)
    assert kept == {*OF_TRAJECTORY, *OF_TIP, *OF_ROBOT}
    assert all(getattr(data, name) is None for name in OF_ROBOT)  # no robot drove
    again = data.driven()
    for name in OF_TRAJECTORY:
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name), err_msg=name)


def _assert_same(data: Dataset, trajectory: Trajectory) -> None:
    """Check that a dataset holds the numbers of a trajectory, of every column and device."""
    for name in OF_TRAJECTORY:
        values, stored = getattr(trajectory, name), getattr(data, name)
        assert stored.dtype == (EXACT.get(name, np.float32)), name
        np.testing.assert_array_equal(values.astype(stored.dtype), stored, err_msg=name)
    for name, of_tip in OF_TIP.items():
        values, stored = getattr(trajectory.tip, of_tip), getattr(data, name)
        np.testing.assert_array_equal(values.astype(stored.dtype), stored, err_msg=name)


def test_devices_and_columns_are_named(pairs):
    data, info = read_dataset(pairs), read_json(pairs / "meta/info.json")
    assert [catheter.name for catheter in data.stack.catheters] == ["microcatheter-1.7f"]
    assert data.stack.catheters[0].push_limit_n == 0.03
    assert describe_dataset(pairs).figures["catheters"] == ["microcatheter-1.7f"]
    drives = ["translation_mm_s", "rotation_rad_s"]
    assert info["features"]["action"]["names"] == drives + [f"catheter_1_{name}" for name in drives]
    assert info["features"]["observation.state"]["shape"] == [8]
    assert info["features"]["branch"] == {"dtype": "int64", "shape": [2], "names": ["wire", "catheter_1"]}
    stats = read_json(pairs / "meta/stats.json")
    np.testing.assert_allclose(stats["action"]["mean"], data.command.mean(axis=(0, 1)).ravel(), atol=1e-12)
    np.testing.assert_allclose(stats["branch"]["max"], data.branch.max(axis=(0, 1)))


def test_the_wire_is_driven_as_it_is_without_a_catheter(patient):
    vessel = read_anatomy(patient)
    alone = draw_navigations(CONFIG, WIRE, vessel, range(3))
    both = draw_navigations(CONFIG, WIRE, vessel, range(3), devices=2)
    later = draw_navigations(CONFIG, WIRE, vessel, range(2, 3), devices=2)
    np.testing.assert_array_equal(both.control[:, :, :1], alone.control)
    np.testing.assert_array_equal(both.initial[:, :1], alone.initial)
    np.testing.assert_array_equal(both.control[2:], later.control)
    assert np.abs(both.control[:, :, 1:] - alone.control).max() > 1  # independently


def test_what_does_not_go_together_is_refused(pairs, patient, tmp_path):
    data = read_dataset(pairs)
    generate_dataset([patient], output=tmp_path / "bare", device=WIRE, config=CONFIG)
    with pytest.raises(InputError, match=r"lies in no catheter, and that of .* in microcatheter-1\.7f; join"):
        read_joined([pairs, tmp_path / "bare"])
    assert len(read_joined([pairs, pairs]).slip) == 2 * len(data)
    with pytest.raises(InputError, match="control: 'force' with catheters; give 'velocity'"):
        generate_dataset(
            [patient], output=tmp_path / "f", device=Stack(WIRE, (CATHETER,)), config=replace(CONFIG, control="force")
        )
    with pytest.raises(InputError, match="too wide for the bore"):
        generate_dataset([patient], output=tmp_path / "w", device=Stack(read_wire("j-035"), (CATHETER,)), config=CONFIG)
    assert not (tmp_path / "f").exists() and not (tmp_path / "w").exists()


def test_a_dataset_is_made_in_a_world_and_simulated_again_in_it(patient, tmp_path):
    world = World(lumen_factor=1.1, friction_factor=2.0, tip_bend_factor=0.5, axis_deg=5.0, compliant_wall_n_mm2=0.05)
    config = replace(CONFIG, sequences=2)
    for name, reality in (("plain", None), ("nominal", World()), ("world", world)):
        generate_dataset([patient], output=tmp_path / name, device="workhorse-014", config=config, world=reality)
    plain, nominal, data = (read_dataset(tmp_path / name) for name in ("plain", "nominal", "world"))
    assert plain.manifest["key"] == nominal.manifest["key"] and plain.manifest["world"] == {}
    anatomy = read_anatomy(patient)
    assert data.manifest["world"] == world.differences() and data.manifest["device"] == plain.manifest["device"]
    assert data.world == world.drawn(anatomy, config.seed) != world
    np.testing.assert_allclose(data.friction, 2 * plain.friction)
    line = anatomy.tree.branches[data.branch[0, 0, 0]].centerline
    given_mm = np.interp(data.tip_abscissa[0, 0, 0], line.abscissa, line.radius)
    assert data.lumen_radius[0, 0, 0] == pytest.approx(1.1 * given_mm, rel=1e-4)
    again = data.driven()
    _assert_same(data, again)
    _assert_same(data[1], data.trajectory(1))
    deeper = World(ostium_mm=1.5, robot="ideal")
    generate_dataset([patient], output=tmp_path / "deeper", device="workhorse-014", config=config, world=deeper)
    counted = read_dataset(tmp_path / "deeper")
    np.testing.assert_allclose(counted.encoders[..., 0], counted.inserted_length - 1.5, atol=1e-4)
    both = read_joined([tmp_path / "plain", tmp_path / "world"])
    with pytest.raises(InputError, match="holds episodes of several worlds"):
        _ = both.world
    for name, value in (("share", 0.1), ("backs_out_mm", 2.0), ("engine", "kirchhoff")):
        with pytest.raises(InputError, match=f"world: {name} = .*leave it out"):
            generate_dataset([patient], output=tmp_path / "no", device="workhorse-014", world=World(**{name: value}))
    assert not (tmp_path / "no").exists()
