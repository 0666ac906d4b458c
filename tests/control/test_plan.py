"""Plans: what is written is read back, for the same vessel and wire alone; networks; limits; desired tips."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endopilot.anatomy.io import read_anatomy
from endopilot.control import network_plan
from endopilot.control import plan as plan_module
from endopilot.control.plan import plan, read_tips, within_limits
from endopilot.control.plan_config import PlanConfig
from endopilot.control.plan_file import read_plan, write_plan
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, OpenLoop
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import read_controls_csv
from endopilot.simulation.simulate import simulate

SLACK = 0.9


def test_a_plan_reaches_its_target_and_counts_its_cost(found):
    assert found.reached and found.config.method == "search"
    assert abs(found.arriving_tip.abscissa[-1] - 33.0) <= 2.0
    assert np.allclose(found.trajectory.proximal[0, -1, 0, 0], 2.0 + 0.5 * found.control[:, 0, 0].sum())
    terms, cost = found.cost_terms(), found.config.cost
    assert terms["time"] == pytest.approx(0.5 * len(found.control) * cost.time_weight)
    assert terms["end"] == pytest.approx(abs(found.arriving_tip.abscissa[-1] - 33.0))
    # each weight scales its own term and no other
    twice = replace(found.config, cost=replace(cost, tip_weight=2 * cost.tip_weight))
    dearer = replace(found, config=twice).cost_terms()
    assert dearer["tip"] == pytest.approx(2 * terms["tip"]) and terms["tip"] > 0
    assert {name: dearer[name] for name in terms if name != "tip"} == {n: v for n, v in terms.items() if n != "tip"}


def test_a_written_plan_is_read_back_and_drives_the_simulator(found, vessel, tmp_path):
    figures = write_plan(found, output=tmp_path / "plan")
    assert figures["reached"] is True
    assert {path.name for path in (tmp_path / "plan").iterdir()} == {
        "plan.csv",
        "plan.png",
        "trajectory.npz",
        "manifest.json",
    }
    anatomy, device = read_anatomy(vessel), found.navigation.device
    back = read_plan(tmp_path / "plan", anatomy, Stack(device))
    for name in ("control", "desired", "predicted", "force"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name), err_msg=name)
    assert np.array_equal(back.tip.branch, found.tip.branch)
    assert back.navigation.target == found.navigation.target and back.config == found.config
    again = back.trajectory.replay()
    for name in ("tip_position", "proximal", "base_force"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found.trajectory, name), err_msg=name)
    script = read_controls_csv(tmp_path / "plan" / "plan.csv")
    rollout = simulate(anatomy, device, script.control, initial=script.initial, config=SimulatorConfig(threads=1))
    assert np.allclose(rollout.tip_position, found.trajectory.tip_position, atol=1e-3)


def test_a_plan_whose_manifest_lacks_what_was_asked_is_refused(found, vessel, tmp_path):
    write_plan(found, output=tmp_path / "plan")
    path = tmp_path / "plan" / "manifest.json"
    record = read_json(path)
    assert record["seed"] == 4 and record["config"]["seconds"] == 30.0
    write_json(path, record | {"config": {"cost": record["config"]["cost"]}})
    with pytest.raises(InputError, match=r"manifest\.json: config: method: missing; .* plan anew"):
        read_plan(tmp_path / "plan", read_anatomy(vessel))


def test_a_path_that_does_not_arrive_in_the_rod_core_is_no_plan(vessel, monkeypatch):
    """The search believes that it arrived; the rod core at its own settings has the tip elsewhere."""
    still = np.zeros((4, 2)), np.full((4, 2), 33.0)
    monkeypatch.setattr(plan_module, "_search", lambda *_: still)
    with pytest.raises(InputError, match=r"target: not reached on the path .* ends at \d\.\d of 33\.0 mm"):
        plan(vessel, "0,0,33", config=PlanConfig(seconds=30.0))


def test_a_plan_of_another_method_says_that_it_breaks_the_force_limit(found, vessel, tmp_path):
    made = plan(vessel, "0,0,33", config=PlanConfig(method="forward", force_limit_n=1e-6))
    assert write_plan(made, output=tmp_path / "pushed")["within_force_limit"] is False
    assert read_json(tmp_path / "pushed" / "manifest.json")["within_force_limit"] is False
    assert write_plan(found, output=tmp_path / "found")["within_force_limit"] is True


def test_a_plan_for_another_vessel_or_wire_is_refused(found, vessel, tmp_path):
    folder = tmp_path / "plan"
    write_plan(found, output=folder)
    anatomy, device = read_anatomy(vessel), found.navigation.device
    values = anatomy.distance_map.values.copy()
    values[40, 10, 10] += 0.5
    other = replace(anatomy, distance_map=replace(anatomy.distance_map, values=values))
    with pytest.raises(InputError, match="another anatomy"):
        read_plan(folder, other)
    with pytest.raises(InputError, match="another device"):
        read_plan(folder, anatomy, Stack(replace(device, friction=0.2)))
    read_plan(folder, anatomy, Stack(replace(device, sources={})))  # the same wire with other sources
    path = folder / "trajectory.npz"
    replace(found.trajectory, period_s=0.4).write(path)
    with pytest.raises(InputError, match=r"trajectory\.npz.* differs"):
        read_plan(folder, anatomy)
    path.unlink()
    with pytest.raises(InputError, match=r"trajectory\.npz: is missing"):
        read_plan(folder, anatomy)


@dataclass
class Toy:
    """A predictor of a tip that lags behind: Δtip = 0.9 Δ, γtip = 0.5 mm. Its inverse knows that."""

    asked: int = 0

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        self.asked += len(episodes)
        proximal = episodes.proximal[:, WINDOW:]
        tip = np.stack([SLACK * proximal[..., 0], np.full(proximal.shape[:2], 0.5)], axis=-1)
        return OpenLoop(tip=tip, proximal=proximal, control=episodes.control[:, WINDOW:])

    def rollout_dual(self, episodes: Episodes) -> OpenLoop:
        wanted = episodes.tip[:, WINDOW:, 0] / SLACK
        before = np.concatenate([episodes.proximal[:, WINDOW - 1 : WINDOW, 0], wanted[:, :-1]], axis=1)
        control = np.stack([(wanted - before) / 0.5, np.zeros_like(wanted)], axis=-1)
        tip = np.stack([SLACK * wanted, np.full_like(wanted, 0.5)], axis=-1)
        return OpenLoop(tip=tip, proximal=np.zeros_like(tip), control=control)

    rollout_inverse = rollout_dual


@pytest.fixture
def run(found, tmp_path, monkeypatch):
    from dataclasses import asdict

    record = {"config": {}, "networks": {}, "patients": [], "device": asdict(found.navigation.device)}
    write_json(tmp_path / "run" / "manifest.json", record)
    monkeypatch.setattr(network_plan, "load_model", lambda _: Toy())
    return tmp_path / "run"


def test_the_inverse_network_is_asked_for_the_desired_tips(vessel, run):
    made = plan(vessel, "0,0,33", config=PlanConfig(method="inverse", seconds=30.0), model=run)
    assert np.allclose(made.predicted[:, 0], made.desired[:, 0])
    assert made.trajectory.proximal[0, -1, 0, 0] == pytest.approx(made.desired[-1, 0] / SLACK, abs=1e-6)


def test_a_simulated_wire_is_led_to_a_target_and_leaves_the_patients_folder_alone(vessel):
    before = sorted(vessel.parent.rglob("*"))
    made = plan(vessel, "0,0,33", config=PlanConfig(method="inverse", seconds=30.0), model=Path("wires"))
    assert made.reached and made.model is None
    assert np.abs(made.predicted[:, 0] - made.tip.abscissa[:, 0]).max() < 0.5
    assert sorted(vessel.parent.rglob("*")) == before


def test_a_model_of_another_wire_is_refused(vessel, run):
    with pytest.raises(InputError, match="trained with workhorse-014"):
        plan(vessel, "0,0,33", config=PlanConfig(method="inverse"), model=run, device="stiff-014")


def test_desired_tips_are_followed(vessel, tmp_path):
    path = tmp_path / "tips.csv"
    rows = [f"{0.5 * (k + 1)},{4 + 1.5 * k},0.6,{int(4 + 1.5 * k > 20)}" for k in range(14)]
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm,branch\n" + "\n".join(rows) + "\n")
    made = plan(vessel, str(path))
    assert len(made.control) == 14 and made.navigation.target.branch == 1
    assert np.abs(made.tip.abscissa[:, 0] - made.desired[:, 0]).max() < 0.5
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,5,0.1\n1.5,6,0.1\n")
    with pytest.raises(InputError, match=r"row 3: time_s = 1\.5"):
        read_tips(path, 40.0, 2.0)


NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(asked=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=30), start=st.floats(0.0, 60.0))
@settings(max_examples=150, deadline=None)
def test_planned_controls_are_finite_and_within_limits_whatever_a_model_asks(asked, start):
    limits = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.6, travel_mm=(0.0, 60.0))
    made = within_limits(np.array(asked), limits, start)
    assert np.isfinite(made).all() and (np.abs(made) <= [40.0, 12.6]).all()
    inserted = start + 0.5 * np.cumsum(made[:, 0])
    assert (inserted >= -1e-9).all() and (inserted <= 60.0 + 1e-9).all()
