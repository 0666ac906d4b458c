"""A small version of `python -m benchmarks robustness`, and that it counts what it says it counts."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.core import robustness
from benchmarks.core.manoeuvres import MANOEUVRES, paired_controls, robust_controls, stacks_of
from benchmarks.core.robustness import RobustnessConfig, measure_robustness
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.device_files import list_wires
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import read_json

DEVICE = read_wire("workhorse-014")


def small(folder: Path) -> RobustnessConfig:
    return RobustnessConfig(rollouts=20, anatomies=1, seconds=6.0, seed=3, threads=1, folder=folder)


@pytest.fixture(scope="module")
def patient():
    return make_patient(AtlasConfig(seed=3), 0)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate chunks here: a process takes seconds to start."""
    monkeypatch.setattr(robustness._Worker, "run", lambda worker, *chunk: robustness.run_chunk(*chunk))


def test_a_small_run_holds_its_bars_and_goes_on_where_it_stopped(tmp_path: Path, in_this_process) -> None:
    measured = measure_robustness(small(tmp_path / "run"))
    figures = {row["figure"]: row for row in measured["figures"]}
    assert measured["rollouts"] == 20
    assert set(measured["by_device"]) == set(list_wires()) and set(measured["by_manoeuvre"]) == set(MANOEUVRES)
    for name in ("invalid worlds, share", "non-finite numbers in valid worlds", "crashes"):
        assert figures[name]["value"] == 0 and figures[name]["passed"], measured
    depth = figures["penetration, 99.9th percentile, mm"]
    assert depth["value"] == measured["penetration_p999_mm"] > 0
    assert depth["passed"] == (depth["value"] <= 0.05)

    folder = tmp_path / "run"
    lost = folder / "0000-j-035"
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir() if path.stem != lost.name}
    lost.with_suffix(".json").unlink()
    again = measure_robustness(small(folder))
    assert {path: path.stat().st_mtime_ns for path in before} == before  # whole chunks are kept
    assert {k: v for k, v in again.items() if k != "realtime_factor"} == {
        k: v for k, v in measured.items() if k != "realtime_factor"
    }
    with pytest.raises(InputError, match=r"was begun with config\.seed = 3, now it is 4"):
        measure_robustness(replace(small(folder), seed=4))


def test_the_manoeuvres_push_beyond_the_end_and_pull_fully_out(patient) -> None:
    initial, control = robust_controls(patient, DEVICE, rollouts=8, samples=120, seed=0)
    inserted = initial[:, :1] + 0.5 * np.cumsum(control[..., 0], axis=1)
    longest = patient.tree.longest_path().abscissa[-1]
    assert inserted.min() > -1e-9
    assert inserted[::4].max() <= longest + 1e-9  # within
    assert (inserted[2::4].max(axis=1) > 1.2 * longest).all()  # against the end
    for kind in (2, 3):
        np.testing.assert_allclose(inserted[kind::4, -1], 0, atol=1e-9)  # pulled fully out
    assert np.ptp(control[..., 1], axis=1).min() > 1  # all turn too


def test_wire_and_catheter_have_manoeuvres_of_their_own_and_go_in_again(patient) -> None:
    stack = Stack(DEVICE, (read_catheter("microcatheter-2.4f"),))
    initial, control = paired_controls(patient, stack, rollouts=16, samples=120, seed=0)
    assert initial.shape == (16, 2, 2) and control.shape == (16, 120, 2, 2)
    inserted = initial[:, None, :, 0] + 0.5 * np.cumsum(control[..., 0], axis=1)
    assert inserted.min() > -1e-9
    out = (inserted[:, 101] < 1e-9) & (inserted[:, -1] > 10)  # pulled out, and in again
    np.testing.assert_array_equal(out.sum(axis=0), [8, 8])
    assert (out.all(axis=1)).any() and (out[:, 0] != out[:, 1]).any()
    ahead = inserted[..., 0] > inserted[..., 1]
    assert (ahead.any(axis=1) & ~ahead.all(axis=1)).sum() > 8  # their ends cross


def test_pairs_are_driven_and_told_by_name(tmp_path: Path, in_this_process) -> None:
    config = replace(small(tmp_path / "run"), rollouts=5, seconds=5.0, catheters=True)
    measured = measure_robustness(config)
    assert measured["rollouts"] + len(measured["did_not_fit"]) == 5 and measured["invalid"] == 0
    pairs = {" in ".join(device.name for device in stack.devices) for stack in stacks_of(0, seed=3, catheters=True)}
    assert set(measured["by_device"]) <= pairs and measured["largest_push_n"] > 0


class Fatal(Wire):
    """Ends the process that unpickles it."""

    def __reduce__(self):
        return os._exit, (3,)


def test_a_crash_is_counted_and_survived(tmp_path: Path, vessel) -> None:
    config = replace(small(tmp_path), given=(vessel,))
    with robustness._Worker() as worker:
        worker.run(tmp_path / "0.npz", config, 0, Stack(Fatal(**vars(DEVICE))), 1)
        worker.run(tmp_path / "2.npz", replace(config, seconds=5.0), 0, Stack(DEVICE), 1)
    assert "the process died" in read_json(tmp_path / "0.json")["crash"]
    assert read_json(tmp_path / "2.json") == {"anatomy": "fork", "invalid": []}


def test_a_crash_and_an_invalid_world_miss_their_bars(tmp_path: Path) -> None:
    config = replace(small(tmp_path), rollouts=1)
    chunk = robustness.Chunk(
        penetration_mm=np.array([[0.1, 0.2, 0.3, 0.3]], dtype=np.float32),
        base_force_n=np.array([[0.3, -0.4, -9.0, 9.0]], dtype=np.float32),
        base_torque_n_mm=np.array([[0.1, -0.2, 9.0, 9.0]], dtype=np.float32),
        over_limit=np.array([[1.0, 1.07, 9.0, 9.0]], dtype=np.float32),
        wall_force_n=np.array([[0.1, 0.8, 9.0, 9.0]], dtype=np.float32),
        wedged=np.array([[False, True, True, True]]),
        valid=np.array([[True, True, False, False]]),
        non_finite=np.array([2]),
        seconds=1.0,
    )
    first, second = (tmp_path / f"0000-{name}.npz" for name in list_wires()[:2])
    np.savez(first, **vars(chunk))
    robustness.write_json(first.with_suffix(".json"), {"anatomy": "rca", "invalid": ["did not converge"]})
    robustness.write_json(second.with_suffix(".json"), {"anatomy": "rca", "crash": "patient 0: the process died"})
    measured = robustness._summarise(config)
    assert [row["value"] for row in measured["figures"]] == pytest.approx([1.0, 0.2, 2, 1], rel=1e-3)
    assert not any(row["passed"] for row in measured["figures"])
    assert measured["invalid_worlds"] == ["did not converge"]
    assert measured["crashed"] == ["patient 0: the process died"]
    # the largest loads of valid samples, and a world that presses the wall with 0.8 N
    row = measured["by_anatomy"]["rca"]
    assert [row[f"largest_{name}"] for name in ("push_n", "pull_n", "torque_n_mm")] == [0.3, 0.4, 0.2]
    assert (row["drive_over_limit_max"], row["share_over_limit_by_6_percent"]) == (1.07, 0.5)
    assert (row["penetration_p999_where_devices_fit_mm"], row["wedged_share"]) == (0.1, 0.5)
    assert (row["largest_wall_force_n"], row["wall_force_worlds"], row["invalid"]) == (0.8, 1, 1)
