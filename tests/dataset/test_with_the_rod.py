"""The dataset made with the real rod core."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import read_dataset
from endopilot.dataset.navigations import (
    PULL_BACK_MM,
    STOP_SHORT_MM,
    TIP_GROUP,
    patient_motion,
    simulate_navigations,
)
from endopilot.devices.device import read_wire
from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.evaluation.evaluate import Recorded
from endopilot.models.config import WINDOW
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import SimulationSetUp

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
