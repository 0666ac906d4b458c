"""Trajectories: driven again to the bit, thinned, written, read back and gathered; and their signals."""

from __future__ import annotations

import json
import re
import runpy
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import endopilot
from endopilot import _core
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.loader import Dataset
from endopilot.dataset.schema import OWN_COLUMNS, STATE
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.robots import Recorder
from endopilot.simulation.signals import SIGNALS, Outputs, table_columns
from endopilot.simulation.trajectory import Step, Trajectory, read_trajectory, trajectory_table
from endopilot.types import Anatomy, TipProjection
from toy_evaluation import make_trajectory

WIRE, CATHETER = read_wire("workhorse-014"), read_catheter("microcatheter-1.7f")
PAIR = Stack(WIRE, (CATHETER,))
SAMPLES = 6
BY_DEVICE = "worlds samples devices"


def drives(worlds: int, devices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and controls of random drives."""
    draw = np.random.default_rng(3)
    start = draw.uniform([0.0, -3.0], [40.0, 3.0], (worlds, devices, 2))
    return start, draw.uniform(-1, 1, (worlds, SAMPLES, devices, 2)) * [15.0, 3.0]


def driven(vessel: Anatomy, stack: Stack, **settings) -> Trajectory:
    start, control = drives(2, len(stack))
    friction = np.linspace(0.05, 0.2, 2 * len(stack)).reshape(2, -1)
    return endopilot.simulate(vessel, stack, control, initial=start, friction=friction, **settings)


@pytest.fixture(scope="module")
def wire_alone(vessel: Anatomy) -> Trajectory:
    return driven(vessel, Stack(WIRE))


@pytest.fixture(scope="module")
def moving_pair(vessel: Anatomy) -> Trajectory:
    """Return all that a trajectory can hold: two devices, motion, shapes, further signals and notes."""
    behind = (Transmission(length_mm=500.0, twist_friction_n_mm_mm=1e-4),) * 2
    stack = replace(PAIR, transmissions=behind)
    made = driven(vessel, stack, motion=Motion(), record_shape=True, config=SimulatorConfig(element_mm=1.0))
    return replace(made, columns={"exposed": np.arange(2 * SAMPLES).reshape(2, SAMPLES) % 3 == 0}, about={"seed": 3})


def arrays_of(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return every array of a trajectory, by name."""
    set_up, tip = trajectory.set_up, trajectory.tip
    found = {each.name: getattr(trajectory, each.name) for each in fields(trajectory)}
    found |= {f"tip_{name}": getattr(tip, name) for name in TipProjection.__dataclass_fields__}
    found |= {f"column.{name}": values for name, values in trajectory.columns.items()}
    found |= {"initial": set_up.initial, "friction": set_up.friction}
    return {name: values for name, values in found.items() if isinstance(values, np.ndarray)}


def assert_same(first: Trajectory, second: Trajectory) -> None:
    """Assert that two trajectories hold the same bits."""
    one, other = arrays_of(first), arrays_of(second)
    assert one.keys() == other.keys() and len(one) > 20
    for name, values in one.items():
        assert values.dtype == other[name].dtype, name
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    assert (first.period_s, first.about) == (second.period_s, second.about)


def test_friction_of_each_world_and_motion_are_those_of_the_recording(vessel, wire_alone, moving_pair) -> None:
    other = wire_alone.set_up.friction * [[1.0], [0.25]]  # of the second world alone
    changed = wire_alone.replay(friction=other)
    np.testing.assert_array_equal(changed.tip_position[0], wire_alone.tip_position[0])
    assert (changed.base_force[1] != wire_alone.base_force[1]).any()
    still = moving_pair.replay(motion=None)
    assert still.vessel_to_laboratory is None
    assert (still.base_force != moving_pair.base_force).any()


def test_a_recording_that_began_on_the_way_is_not_replayed(vessel) -> None:
    start, control = drives(2, 1)
    simulator = endopilot.Simulator(vessel, WIRE, worlds=2)
    simulator.reset(inserted_length=start[..., 0], rotation=start[..., 1])
    simulator.step(control[:, 0], 0.5)
    later = simulator.run(control[:, 1:])
    assert np.isnan(later.set_up.initial).all()
    with pytest.raises(InputError, match="a world was on its way when the recording began; record from its start"):
        later.replay()


def test_every_third_sample_has_the_means_and_sums_of_its_period(vessel) -> None:
    weak = replace(CATHETER, push_limit_n=0.03, pull_limit_n=0.02)
    fine = driven(vessel, Stack(WIRE, (weak,)), motion=Motion(), record_shape=True)
    assert np.abs(fine.slip).max() > 0
    coarse = fine.every(3)
    assert coarse.period_s == 1.5 and coarse.valid.shape == (2, 2)
    for name in ("inserted_length", "rotation", "tip_position", "base_force", "wall_force", "shape"):
        np.testing.assert_array_equal(getattr(coarse, name), getattr(fine, name)[:, [2, 5]])
    assert fine.vessel_to_laboratory is not None
    np.testing.assert_array_equal(coarse.vessel_to_laboratory, fine.vessel_to_laboratory[:, [2, 5]])
    np.testing.assert_array_equal(coarse.tip.abscissa, fine.tip.abscissa[:, [2, 5]])
    for name, take in (("command", np.mean), ("control", np.mean), ("iterations", np.mean)):
        fine_values = getattr(fine, name)
        parts = [take(fine_values[:, first : first + 3], axis=1) for first in (0, 3)]
        np.testing.assert_allclose(getattr(coarse, name), np.stack(parts, axis=1), rtol=1e-12, atol=1e-12)
    for name in ("slip", "rotation_slip", "node_iterations"):
        parts = [getattr(fine, name)[:, first : first + 3].sum(axis=1) for first in (0, 3)]
        np.testing.assert_allclose(getattr(coarse, name), np.stack(parts, axis=1), rtol=1e-12, atol=1e-12)
    moved = np.diff(coarse.proximal, axis=1, prepend=coarse.start[:, None])
    np.testing.assert_allclose(coarse.control * 1.5, moved, atol=1e-9)
    assert fine.every(4).valid.shape == (2, 1)  # a period that did not end is left out
    assert_same(fine.every(1), fine)


def test_a_file_gives_every_array_back_to_the_bit_and_is_replayed(vessel, moving_pair, tmp_path) -> None:
    moving_pair.write(tmp_path / "pair.npz")
    read = read_trajectory(tmp_path / "pair.npz", anatomy=vessel)
    assert_same(read, moving_pair)
    assert [each.identity for each in read.set_up.anatomies] == [vessel.identity] * 2
    for name in ("stacks", "actuation", "motion", "config"):
        assert getattr(read.set_up, name) == getattr(moving_pair.set_up, name)
    assert_same(read.replay(), moving_pair)
    read = read_trajectory(tmp_path / "pair.npz")
    assert_same(read, moving_pair)
    with pytest.raises(InputError, match="the vessel is not given; read the trajectory with its anatomy"):
        read.replay()


def test_a_file_says_what_its_arrays_mean(moving_pair, tmp_path) -> None:
    moving_pair.write(tmp_path / "pair.npz")
    with np.load(tmp_path / "pair.npz", allow_pickle=False) as stored:
        about = json.loads(str(stored["about"]))
        shapes = {name: stored[name].shape for name in stored.files if name != "about"}
    described = {name for name in shapes if not name.startswith("column.")}
    assert about["arrays"].keys() == described
    sizes = {"worlds": 2, "samples": SAMPLES, "devices": 2, "nodes": moving_pair.shape.shape[2]}
    for name, each in about["arrays"].items():
        axes = each["axes"].split()
        assert tuple(sizes.get(axis) or int(axis) for axis in axes) == shapes[name], name
        assert each["meaning"] and isinstance(each["unit"], str), name
    assert about["arrays"]["inserted_length"]["unit"] == "mm"
    assert about["arrays"]["base_torque"] == about["arrays"]["base_torque"] | {"axes": BY_DEVICE, "unit": "N·mm"}
    assert about["arrays"]["wall_force"]["axes"] == "worlds samples"


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_capital_letters_of_a_suffix_mean_the_same(wire_alone, tmp_path, suffix) -> None:
    for name in (f"wire{suffix}", f"WIRE{suffix.upper()}"):
        wire_alone.write(tmp_path / name)
    small, large = ((tmp_path / name).read_bytes() for name in (f"wire{suffix}", f"WIRE{suffix.upper()}"))
    assert small == large


def test_what_is_no_trajectory_of_the_vessel_is_refused_in_one_line(vessel, wire_alone, tmp_path) -> None:
    path = tmp_path / "wire.npz"
    wire_alone.write(path)
    with np.load(path) as stored:
        arrays = dict(stored)
    newer = json.loads(str(arrays["about"])) | {"version": 99}
    np.savez(tmp_path / "newer.npz", **(arrays | {"about": np.array(json.dumps(newer))}))  # pyright: ignore[reportArgumentType]
    older = {name: each for name, each in arrays.items() if name != "tip_twist"}
    np.savez(tmp_path / "older.npz", **older)  # pyright: ignore[reportArgumentType]
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    (tmp_path / "text.npz").write_text("nothing")
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "list.npz", about=np.array("[1]"))
    for name in ("none.npz", "other.npz", "text.npz", "array.npy", "list.npz"):
        _refused(tmp_path / name, vessel, "no trajectory")
    _refused(tmp_path / "newer.npz", vessel, "format version 99, not 1; simulate it again")
    _refused(tmp_path / "older.npz", vessel, "lacks tip_twist, which this version records; simulate it again")
    _refused(path, make_patient(AtlasConfig(count=2), 1), f"world 0 is of another vessel, '{vessel.name}'")
    _refused(path, [vessel], f"world 1 is of another vessel, '{vessel.name}'")
    with pytest.raises(InputError, match=r"written as \.parquet or \.csv or \.npz"):
        wire_alone.write(tmp_path / "wire.txt")


def _refused(path: Path, anatomy, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_trajectory(path, anatomy=anatomy)
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)


@pytest.mark.parametrize("stack", [Stack(WIRE), PAIR], ids=["wire", "pair"])
def test_a_recorder_gives_what_a_run_gives_to_the_bit(vessel, stack) -> None:
    """In a longer and a shorter vessel: nodes that neither needs are left out, those that one lacks are NaN."""
    vessels, (start, control) = [vessel, make_patient(AtlasConfig(count=2), 1)], drives(2, len(stack))

    def begun() -> endopilot.Simulator:
        simulator = endopilot.Simulator(vessels, [stack, stack], motion=Motion())
        simulator.reset(inserted_length=start[..., 0], rotation=start[..., 1])
        return simulator

    recorder = Recorder(simulator := begun(), 0.5, record_shape=True)
    for sample in range(SAMPLES):
        recorder.step(control[:, sample])
    gathered = recorder.trajectory()
    assert gathered.shape is not None and np.isnan(gathered.shape).any() and gathered.shape.shape[2] < simulator.nodes
    assert_same(gathered, begun().run(control, record_shape=True))
    assert_same(gathered.replay(), gathered)


def test_a_wire_alone_needs_no_axis_of_devices(vessel, wire_alone) -> None:
    start, control = drives(2, 1)
    without = endopilot.simulate(
        vessel, WIRE, control[:, :, 0], initial=start[:, 0], friction=wire_alone.set_up.friction[:, 0]
    )
    assert_same(without, wire_alone)
    simulator = endopilot.Simulator(vessel, WIRE, worlds=2)
    simulator.reset(inserted_length=start[:, 0, 0], rotation=start[:, 0, 1], friction=without.set_up.friction[:, 0])
    simulator.step(control[:, 0, 0], 0.5)
    np.testing.assert_array_equal(simulator.tip_position, wire_alone.tip_position[:, 0])


def test_a_stack_needs_its_axis_of_devices(vessel) -> None:
    start, control = drives(2, 2)
    with pytest.raises(InputError, match=r"^control: shape \(2, 6, 2\); give \(2, 6, 2, 2\)$"):
        endopilot.simulate(vessel, PAIR, control[:, :, 0])
    with pytest.raises(InputError, match=r"^initial: shape \(2, 2\); give \(2, 2, 2\)$"):
        endopilot.simulate(vessel, PAIR, control, initial=start[:, 0])
    with pytest.raises(InputError, match="device: stacks of 1 and of 2 devices; give worlds of one number"):
        endopilot.Simulator(vessel, [WIRE, PAIR])


RECORDED = {name: (of, numbers) for name, of, numbers, *_ in _core.OUTPUTS if of in ("device", "sample")}


def test_a_step_has_each_output_of_the_core_with_its_axes() -> None:
    types: dict[str, Any] = {each.name: each.type for each in fields(Step)}
    declared = {name: each.dim_str for name, each in types.items()}
    axes = {"device": "*each devices", "sample": "*each"}
    assert declared == {name: axes[of] + (f" {n}" if n > 1 else "") for name, (of, n) in RECORDED.items()}
    assert set(declared) <= {each.name for each in fields(Trajectory)}


def test_every_output_is_described_and_has_its_columns_in_tables_and_in_data_sets() -> None:
    table = trajectory_table(make_trajectory())
    for name in RECORDED:
        assert f"\n        {name}: {SIGNALS[name].meaning}" in (Trajectory.__doc__ or ""), name
        assert SIGNALS[name].columns and set(SIGNALS[name].columns) <= set(table.columns), name
    stored = {name for name, *_ in OWN_COLUMNS.values()} | set(STATE)
    assert stored >= {each.name for each in fields(Outputs)}
    columns = [column for each in SIGNALS.values() for column in each.columns]
    assert len(columns) == len(set(columns))


@pytest.mark.parametrize("kind", [Dataset, Trajectory])
def test_no_attribute_is_described_twice(kind) -> None:
    named = re.findall(r"^ {8}(\w+): ", kind.__doc__, re.MULTILINE)
    assert "valid" in named and len(named) == len({*named})


def test_columns_of_devices_come_one_device_after_the_other() -> None:
    position, force = np.arange(12.0).reshape(2, 2, 3), np.array([0.1, 0.2])
    found = table_columns({"wall_force": force, "tip_position": position})
    assert list(found) == [
        *(f"tip_{axis}_mm" for axis in "xyz"),
        *(f"catheter_1_tip_{axis}_mm" for axis in "xyz"),
        "wall_force_n",
    ]
    np.testing.assert_array_equal(found["catheter_1_tip_y_mm"], position[:, 1, 1])


def test_further_signals_are_columns_of_a_table_by_their_rows_or_their_own_name() -> None:
    made = make_trajectory(2)
    further = {"believed": np.arange(4.0).reshape(1, 2, 2), "mine": np.array([[5.0, 6.0]])}
    table = trajectory_table(replace(made, columns=further))
    expected = {"believed_tip_abscissa_mm": [0, 2], "believed_tip_offset_mm": [1, 3], "mine": [5, 6]}
    found = pd.DataFrame({name: table[name] for name in expected})
    pd.testing.assert_frame_equal(found, pd.DataFrame(expected, dtype=float))


def test_the_documentation_lists_the_signals() -> None:
    script = Path(__file__).parents[2] / "docs/signals.py"
    made = runpy.run_path(str(script))
    assert made["PAGE"].read_text(encoding="utf-8") == made["page"]()
