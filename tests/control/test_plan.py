"""Plans: what is written is read back, for the same vessel and devices alone; networks; limits; desired tips; X-ray."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from endopilot.anatomy.io import read_anatomy
from endopilot.control.plan import plan, read_tips, within_limits
from endopilot.control.plan_config import Plan, PlanConfig
from endopilot.control.plan_file import read_plan, write_plan
from endopilot.control.plan_xray import plan_xray
from endopilot.devices.catheter import read_catheter
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
CATHETER = read_catheter("microcatheter-1.7f")
PAIR = Stack.of("workhorse-014", CATHETER)
CONFIG = PlanConfig(arrives="catheter", seconds=40.0, tip="own")


@pytest.fixture(scope="module")
def pair(vessel) -> Plan:
    """Return a plan that brings the tip of a microcatheter along the vessel."""
    return plan(vessel, "0,0,25", config=CONFIG, device=PAIR)


def test_the_catheter_s_tip_arrives_with_the_wire_no_deeper_in_it_than_allowed(pair):
    assert pair.reached and pair.within_force_limit
    assert pair.control.shape == (len(pair.force), 2, 2)
    wire, catheter = pair.tip.abscissa.T
    assert pair.end_mm == catheter[-1] == pytest.approx(25.0, abs=2.0) and wire[-1] >= catheter[-1] - 2.0
    assert np.abs(pair.predicted[:, 0] - wire).mean() < 0.5
    assert pair.trajectory.proximal[0, -1] == pytest.approx([[2.0, 0.0], [0.0, 0.0]] + 0.5 * pair.control.sum(axis=0))


@pytest.mark.parametrize("devices", [1, 2])
def test_a_written_plan_is_read_back_and_drives_the_simulator(found, pair, devices, vessel, tmp_path):
    made, anatomy = (found, pair)[devices - 1], read_anatomy(vessel)
    figures, device = write_plan(made, output=tmp_path / "plan"), made.navigation.stack
    assert figures["reached"] is True and figures["tip_error_mm"] <= 2.0
    files = {path.name for path in (tmp_path / "plan").iterdir()}
    assert files == {"plan.csv", "plan.png", "trajectory.npz", "manifest.json"}
    again = read_plan(tmp_path / "plan", anatomy, device).replay()
    for name in ("command", "tip_position", "proximal", "base_force", "contact_force_max"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made.trajectory, name), err_msg=name)
    np.testing.assert_array_equal(again.columns["predicted"][0], made.predicted)
    script = read_controls_csv(tmp_path / "plan" / "plan.csv", devices=devices)
    rollout = simulate(anatomy, device, script.control, initial=script.initial, config=SimulatorConfig(threads=1))
    assert np.allclose(rollout.tip_position, made.trajectory.tip_position, atol=1e-3)


def test_a_plan_says_that_it_breaks_the_force_limit(vessel, tmp_path):
    made = plan(vessel, "0,0,33", config=PlanConfig(method="inverse", force_limit_n=1e-6))
    assert write_plan(made, output=tmp_path / "pushed")["within_force_limit"] is False
    assert read_json(tmp_path / "pushed" / "manifest.json")["within_force_limit"] is False


def test_a_plan_for_another_vessel_or_devices_and_a_damaged_one_are_refused(pair, vessel, tmp_path):
    folder = tmp_path / "plan"
    write_plan(pair, output=folder)
    anatomy, wire = read_anatomy(vessel), pair.navigation.device
    other = replace(anatomy.distance_map, values=anatomy.distance_map.values + 0.01)
    with pytest.raises(InputError, match="another anatomy"):
        read_plan(folder, replace(anatomy, distance_map=other))
    stiffer = replace(CATHETER, bore_friction=2 * CATHETER.bore_friction)
    for stack in (Stack(wire), Stack(wire, (stiffer,)), Stack(replace(wire, friction=0.2), (CATHETER,))):
        with pytest.raises(InputError, match=r"\(workhorse-014 in microcatheter-1\.7f\), not for workhorse-014"):
            read_plan(folder, anatomy, stack)
    read_plan(folder, anatomy, Stack(replace(wire, sources={}, tip_bend_rad=0.1), (CATHETER,)))  # a tip is shaped
    path = folder / "trajectory.npz"
    replace(pair.trajectory, period_s=0.4).write(path)
    with pytest.raises(InputError, match=r"trajectory\.npz: is missing or differs"):
        read_plan(folder, anatomy)
    write_json(folder / "manifest.json", {"config": {}})
    with pytest.raises(InputError, match=r"manifest\.json: catheter_axis: missing; make one with `endopilot plan`"):
        read_plan(folder, anatomy)


class Toy:
    """A predictor of a tip that lags behind: Δtip = 0.9 Δ, γtip = 0.5 mm. Its inverse knows that."""

    def rollout_dual(self, episodes: Episodes) -> OpenLoop:
        wanted = episodes.tip[:, WINDOW:, 0] / SLACK
        before = np.concatenate([episodes.proximal[:, WINDOW - 1 : WINDOW, 0], wanted[:, :-1]], axis=1)
        control = np.stack([(wanted - before) / 0.5, np.zeros_like(wanted)], axis=-1)
        tip = np.stack([SLACK * wanted, np.full_like(wanted, 0.5)], axis=-1)
        return OpenLoop(tip=tip, control=control)


def test_the_inverse_network_of_the_wire_is_asked_for_the_desired_tips(found, vessel, tmp_path, monkeypatch):
    record = {"config": {}, "networks": {}, "patients": [], "device": asdict(found.navigation.device)}
    write_json(tmp_path / "run" / "manifest.json", record)
    monkeypatch.setattr("endopilot.models.checkpoint.load_model", lambda _: Toy())
    inverse, run = PlanConfig(method="inverse", seconds=30.0), tmp_path / "run"
    made = plan(vessel, "0,0,33", config=inverse, model=run)
    desired = made.trajectory.columns["desired"][0]
    assert np.allclose(made.predicted[:, 0], desired[:, 0])
    assert made.trajectory.proximal[0, -1, 0, 0] == pytest.approx(desired[-1, 0] / SLACK, abs=1e-6)
    with pytest.raises(InputError, match="trained with workhorse-014"):
        plan(vessel, "0,0,33", config=inverse, model=run, device="stiff-014")
    with pytest.raises(InputError, match=r"tip: 75/5; .* was trained with the wire's own tip"):
        plan(vessel, "0,0,33", config=replace(inverse, tip="75/5"), model=run)


def test_a_simulated_wire_is_led_to_a_target_and_leaves_the_patients_folder_alone(vessel):
    before = sorted(vessel.parent.rglob("*"))
    made = plan(vessel, "0,0,33", config=PlanConfig(method="inverse", seconds=30.0), model=Path("wires"))
    assert made.reached and made.model is None
    assert np.abs(made.predicted[:, 0] - made.tip.abscissa[:, 0]).max() < 0.5
    assert sorted(vessel.parent.rglob("*")) == before


def test_desired_tips_are_followed(vessel, tmp_path):
    path = tmp_path / "tips.csv"
    rows = [f"{0.5 * (k + 1)},{4 + 1.5 * k},0.6,{int(4 + 1.5 * k > 20)}" for k in range(14)]
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm,branch\n" + "\n".join(rows) + "\n")
    made = plan(vessel, str(path))
    assert len(made.control) == 14 and made.navigation.target.branch == 1
    assert np.abs(made.tip.abscissa[:, 0] - made.trajectory.columns["desired"][0, :, 0]).max() < 0.5
    with pytest.raises(InputError, match=r"force_limit_n: 1e-06 N is exceeded on the path found"):
        plan(vessel, str(path), config=PlanConfig(force_limit_n=1e-6))
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,3,0.1\n1.0,35,0.1\n")  # faster than any wire comes on
    with pytest.raises(InputError, match=r"target: not reached on the path .* ends at \d+\.\d of 35\.0 mm"):
        plan(vessel, str(path))
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,5,0.1\n1.5,6,0.1\n")
    with pytest.raises(InputError, match=r"row 3: time_s = 1\.5"):
        read_tips(path, 40.0, 2.0)


@pytest.mark.parametrize("wild", [np.nan, np.inf, -np.inf, 1e300, -1e300, 12.0])
def test_planned_controls_are_finite_and_within_limits_whatever_a_model_asks(wild):
    limits = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.6, travel_mm=(0.0, 60.0))
    asked = np.array([(5.0, 1.0), (wild, 0.0), (0.0, wild), (wild, wild)] * 4)
    made = within_limits(asked, limits, 30.0)
    assert np.isfinite(made).all() and (np.abs(made) <= [40.0, 12.6]).all()
    inserted = 30.0 + 0.5 * np.cumsum(made[:, 0])
    assert (inserted >= -1e-9).all() and (inserted <= 60.0 + 1e-9).all() and made[0].tolist() == [5.0, 1.0]


@pytest.mark.parametrize(
    ("change", "others", "line"),
    [
        (
            {"config": replace(CONFIG, method="inverse")},
            {},
            "method: inverse; a wire in a catheter is planned",
        ),
        ({"target": "tips.csv"}, {}, "desired tips are followed by a wire alone"),
        ({}, {"model": "a-run"}, "--model a-run: models are of a wire alone"),
        ({}, {"device": Stack.of("workhorse-014", CATHETER, "straight-5f")}, "catheter: 2; the search drives one"),
        ({}, {"device": None}, "arrives: catheter; there is none"),
        (
            {"config": replace(CONFIG, seconds=4.7, speed_mm_s=5.0)},
            {},
            r"s are too few .* in microcatheter-1\.7f; give",
        ),
        ({"config": replace(CONFIG, force_limit_n=1e-6)}, {}, "no path found to branch"),
    ],
)
def test_what_cannot_be_planned_for_a_pair_is_refused(vessel, change, others, line):
    asked = {"target": "0,0,25", "config": CONFIG} | change
    with pytest.raises(InputError, match=line):
        plan(vessel, asked["target"], config=asked["config"], **({"device": PAIR} | others))


@pytest.mark.parametrize("devices", [1, 2])
def test_the_agent_s_wires_foresee_the_x_ray_and_it_is_written_beside_the_plan(found, pair, devices, vessel, tmp_path):
    made = (found, pair)[devices - 1]
    xray = plan_xray(made)
    assert (xray.half_width > 0).all() and xray.exposure.sum() < len(made.control) / 2
    due = np.flatnonzero(xray.exposure)
    assert (np.diff(due) >= 2).all()  # not sooner than 1 s after the last
    assert (xray.half_width[due[:-1] + 1, 0] < xray.half_width[due[:-1], 0]).all()  # an exposure narrows the band
    exposure = np.arange(len(made.control)) % 3 == 1  # whenever it is due
    figures = write_plan(made, output=tmp_path / "plan", xray=replace(xray, exposure=exposure))
    table = pd.read_csv(tmp_path / "plan" / "plan.csv")
    assert (
        figures["xray_due_s"]
        == table.time_s[table.xray == 1].tolist()
        == (0.5 * (1 + np.flatnonzero(exposure))).tolist()
    )
    np.testing.assert_allclose(table[["band_tip_abscissa_mm", "band_tip_offset_mm"]], xray.half_width)
    assert read_plan(tmp_path / "plan", read_anatomy(vessel)).about["exposures_s"] == figures["xray_due_s"]
    assert "xray_due_s" not in write_plan(made, output=tmp_path / "plan")
