"""Plans for a wire in a catheter: where both end, what is written and driven again, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.anatomy.io import read_anatomy
from endopilot.belief.bands import Calibration
from endopilot.cli import main
from endopilot.control.agent_config import CALIBRATIONS, read_agent_calibration
from endopilot.control.plan import plan
from endopilot.control.plan_config import Plan, PlanConfig
from endopilot.control.plan_file import read_plan, write_plan
from endopilot.control.plan_xray import plan_xray
from endopilot.devices.catheter import read_catheter
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import read_controls_csv
from endopilot.simulation.simulate import simulate

CATHETER = read_catheter("microcatheter-1.7f")
CONFIG = PlanConfig(arrives="catheter", seconds=40.0, tip="own")


@pytest.fixture(scope="module")
def pair(vessel) -> Plan:
    """Return a plan that brings the tip of a microcatheter along the vessel."""
    return plan(vessel, "0,0,25", config=CONFIG, device=Stack.of("workhorse-014", CATHETER))


def test_the_catheter_s_tip_arrives_with_the_wire_no_deeper_in_it_than_allowed(pair):
    assert pair.reached and pair.within_force_limit
    assert pair.control.shape == (len(pair.force), 2, 2)
    wire, catheter = pair.tip.abscissa.T
    assert np.array_equal(pair.arriving_tip.abscissa, catheter)
    assert abs(catheter[-1] - 25.0) <= 2.0 and wire[-1] >= catheter[-1] - 2.0
    assert pair.cost_terms()["end"] == pytest.approx(abs(catheter[-1] - 25.0))
    assert np.abs(pair.predicted[:, 0] - wire).mean() < 0.5
    assert pair.trajectory.proximal[0, -1] == pytest.approx([[2.0, 0.0], [0.0, 0.0]] + 0.5 * pair.control.sum(axis=0))


def test_a_written_plan_is_read_back_and_drives_both_devices(pair, vessel, tmp_path):
    figures = write_plan(pair, output=tmp_path / "plan")
    assert figures["tip_error_mm"] == pytest.approx(pair.cost_terms()["end"], abs=1e-3)
    anatomy, wire = read_anatomy(vessel), pair.navigation.device
    back = read_plan(tmp_path / "plan", anatomy, pair.navigation.stack)
    for name in ("command", "proximal", "tip_position", "contact_force_max"):
        np.testing.assert_array_equal(getattr(back.trajectory, name), getattr(pair.trajectory, name), err_msg=name)
    assert np.allclose(back.tip.abscissa, pair.tip.abscissa)
    assert back.navigation.arrives == "catheter" and back.navigation.catheters == (CATHETER,)
    script = read_controls_csv(tmp_path / "plan" / "plan.csv", devices=2)
    stack = pair.navigation.stack
    again = simulate(anatomy, stack, script.control, initial=script.initial, config=SimulatorConfig(threads=1))
    assert np.allclose(again.tip_position, pair.trajectory.tip_position, atol=1e-3)
    stiffer = replace(CATHETER, bore_friction=2 * CATHETER.bore_friction)
    for others in ((), (stiffer,)):
        with pytest.raises(InputError, match=r"\(workhorse-014 in microcatheter-1\.7f\), not for workhorse-014"):
            read_plan(tmp_path / "plan", anatomy, Stack(wire, others))


def test_the_agent_s_ensemble_forecasts_the_x_ray_of_both(pair):
    own = read_agent_calibration("assumed", 2)
    assert own == Calibration.read(CALIBRATIONS["assumed", 2]) != read_agent_calibration("assumed", 1)
    xray = plan_xray(pair)
    assert (xray.half_width > 0).all() and xray.exposure.sum() < len(pair.control) / 2


def test_the_commands_plan_and_simulate_take_a_catheter(vessel, tmp_path, capsys):
    both = ("--catheter", "microcatheter-1.7f")
    folder, table = str(tmp_path / "plan"), str(tmp_path / "again.csv")
    options = ("--target", "0,0,15", "--tip", "own", "--seconds", "40")
    for command in (
        ("plan", str(vessel), *options, *both, "-o", folder, "--json"),
        ("simulate", str(vessel), "--controls", folder, *both, "-o", table, "--json"),
    ):
        with pytest.raises(SystemExit) as leaving:
            main(list(command))
        assert leaving.value.code == 0, capsys.readouterr().err
    assert "catheter_1_translation_mm_s" in Path(table).read_text(encoding="utf-8").splitlines()[0]


@pytest.mark.parametrize(
    ("change", "others", "line"),
    [
        ({"config": replace(CONFIG, method="spin")}, {}, "method: spin; a wire in a catheter is planned by search"),
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
def test_what_cannot_be_planned_is_refused(vessel, change, others, line):
    asked = {"target": "0,0,25", "config": CONFIG} | change
    with pytest.raises(InputError, match=line):
        plan(
            vessel,
            asked["target"],
            config=asked["config"],
            **({"device": Stack.of("workhorse-014", CATHETER)} | others),
        )
