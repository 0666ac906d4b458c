"""Wires with catheters around them: files, fit, drives, and the same bits however worlds are stepped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bend
import numpy as np
import pytest

import endopilot
from endopilot.devices.catheter import Catheter, list_catheters, read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack, lines_from_tips
from endopilot.errors import InputError
from endopilot.simulation.controls import read_controls_csv
from endopilot.types import Anatomy


@pytest.fixture(scope="module")
def catheter() -> Catheter:
    return read_catheter("microcatheter-1.7f")


def random_drives(worlds: int, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    start = np.column_stack([draw.uniform(0, 40, worlds), draw.uniform(-3, 3, worlds)])
    start = np.column_stack([start, draw.uniform(0, 40, worlds), draw.uniform(-3, 3, worlds)])
    control = draw.uniform(-1, 1, (worlds, samples, 4)) * [15.0, 3.0, 15.0, 3.0]
    return start.reshape(worlds, 2, 2), control.reshape(worlds, samples, 2, 2)


@pytest.mark.parametrize("name", list_catheters())
def test_shipped_catheters_are_whole(name: str) -> None:
    catheter = read_catheter(name)
    assert catheter.name == name
    assert 0 < catheter.inner_diameter_mm < catheter.diameter_mm
    assert all(len(source) > 7 for source in catheter.sources.values())
    assert catheter.turned(np.array([0.0, 1e3]))[1] == pytest.approx(sum(angle for _, angle in catheter.shape))


def test_what_is_too_wide_is_refused(vessel: Anatomy, catheter: Catheter) -> None:
    control = np.zeros((1, 1, 2, 2))
    with pytest.raises(
        InputError, match=r"diameter_mm = 0\.89 is too wide for the bore of catheter microcatheter-1\.7f"
    ):
        endopilot.simulate(vessel, Stack(read_wire("j-035"), (catheter,)), control)
    wide = replace(catheter, diameter_mm=9.0)
    with pytest.raises(InputError, match="wider than the"):
        endopilot.simulate(vessel, Stack(read_wire("workhorse-014"), (wide,)), control)
    with pytest.raises(InputError, match=r"inner_diameter_mm: 0\.6; give less than the outer diameter, 0\.57 mm"):
        replace(catheter, inner_diameter_mm=0.6)
    with pytest.raises(InputError, match="catheter 'none'"):
        read_catheter("none")
    with pytest.raises(InputError, match="'force' with catheters"):
        endopilot.simulate(vessel, Stack(read_wire("workhorse-014"), (catheter,)), control, actuation="force")


def test_a_withdrawn_wire_leaves_the_catheter_where_it_is(vessel: Anatomy, catheter: Catheter) -> None:
    # and the foremost tip is then the catheter's
    start = np.array([[[40.0, 0.0], [30.0, 0.0]]])
    control = np.zeros((1, 10, 2, 2))
    control[0, :8, 0, 0] = -10.0
    stack = Stack(read_wire("workhorse-014"), (catheter,))
    trajectory = endopilot.simulate(vessel, stack, control, initial=start)
    assert trajectory.valid.all()
    assert trajectory.inserted_length[0, -1, 0] == pytest.approx(0.0, abs=1e-9)
    assert trajectory.inserted_length[0, :, 1] == pytest.approx(np.full(10, 30.0))
    moved = np.linalg.norm(trajectory.tip_position[0, -1, 1] - trajectory.tip_position[0, 0, 1])
    assert moved < 1.5  # it leans on the wall as its own stiffness has it


def test_drives_keep_their_limits(vessel: Anatomy, catheter: Catheter) -> None:
    weak = replace(catheter, push_limit_n=0.02, pull_limit_n=0.02, torque_limit_n_mm=2e-4)
    start = np.array([[[60.0, 0.0], [20.0, 0.0]]])
    control = np.zeros((1, 16, 2, 2))
    control[0, :, 1] = 8.0, 2.0
    wire = read_wire("workhorse-014")
    free = endopilot.simulate(vessel, Stack(wire, (catheter,)), control, initial=start)
    held = endopilot.simulate(vessel, Stack(wire, (weak,)), control, initial=start)
    assert free.base_force[..., 1].max() > 0.03 and np.abs(free.base_torque[..., 1]).max() > 3e-4
    assert np.abs(free.slip[..., 1]).max() == 0
    assert held.base_force[..., 1].max() < 0.025  # a drive behind the lead is slowed down after it met its limit
    assert np.abs(held.base_torque[..., 1]).max() <= 2e-4 * (1 + 1e-3)
    made = start[0, 1, 0] + 8.0 * 8.0 - held.slip[0, :, 1].sum()
    assert held.inserted_length[0, -1, 1] == pytest.approx(made) and held.slip[..., 1].sum() > 1.0


def test_neither_drive_passes_its_limit_where_both_meet_an_obstacle() -> None:
    # Rough devices in a bend with a blind end, pushed together, in turn and against each other. Friction
    # between them turns within 0.04 mm and moves load from one drive to the other.
    limit = {"push_limit_n": 0.3, "pull_limit_n": 0.3}
    wire = replace(read_wire("workhorse-014"), friction=0.3, **limit)
    catheter = read_catheter("microcatheter-1.7f")
    catheter = replace(catheter, bore_friction=0.3, friction=0.3, **limit)
    control = np.zeros((2, 43, 2, 2))
    phases = (
        ((14, 6, 0), (14, 0, 6), (8, 0, -8), (7, -8, 8)),
        ((10, 8, 0), (12, -6, 12), (12, 12, -6), (9, -10, -10)),
    )
    for world, made in enumerate(phases):
        speeds = np.concatenate([np.tile([a, b], (count, 1)) for count, a, b in made])
        control[world, : len(speeds), :, 0] = speeds
    start = np.tile([[40.0, 0.0], [20.0, 0.0]], (2, 1, 1))
    trajectory = endopilot.simulate(bend.vessel(), Stack(wire, (catheter,)), control, initial=start)
    assert trajectory.valid.all()
    assert (np.abs(trajectory.slip).sum(axis=1) > 5).any(axis=0).all()
    for device in range(2):
        assert 0.9 * 0.3 < np.abs(trajectory.base_force[..., device]).max() < 1.1 * 0.3


def test_a_trajectory_written_as_csv_is_simulated_again(vessel: Anatomy, catheter: Catheter, tmp_path: Path) -> None:
    start, control = random_drives(2, 4, 8)
    stack = Stack(read_wire("workhorse-014"), (catheter,))
    first = endopilot.simulate(vessel, stack, control, initial=start)
    first.write(tmp_path / "trajectory.csv")
    script = read_controls_csv(tmp_path / "trajectory.csv", devices=2)
    second = endopilot.simulate(vessel, stack, script.control, initial=script.initial, period_s=script.period_s)
    assert second.tip_position[:, :, 1] == pytest.approx(first.tip_position[:, :, 1], abs=1e-3)
    with pytest.raises(InputError, match="column catheter_2_translation_mm_s is missing"):
        read_controls_csv(tmp_path / "trajectory.csv", devices=3)


@pytest.mark.parametrize(("wire_mm", "catheter_mm"), [(30.0, 12.3), (12.3, 30.0), (20.0, 20.0)])
def test_the_line_that_devices_share_is_cut_at_each_tip(vessel, catheter, wire_mm, catheter_mm) -> None:
    simulator = endopilot.Simulator(vessel, Stack(read_wire("workhorse-014"), (catheter,)))
    simulator.reset(inserted_length=[[wire_mm, catheter_mm]], rotation=[[0.0, 0.0]])
    lines = lines_from_tips(simulator.position[0], simulator.inserted_length[0])
    for device, line in enumerate(lines):
        np.testing.assert_allclose(line[0], simulator.tip_position[0, device], atol=0.01)
        np.testing.assert_array_equal(line[-1], simulator.position[0, -1])
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).min() > 0
