"""A robot whose constants are known is calibrated blind, from what it logged; and the commands that do it."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import endopilot
from benchmarks.robot.blind import BlindRobot
from benchmarks.robot.synthetic import PERIOD_S, drawn, logged
from command import run
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.robot.calibrate import (
    LEFT_OUT,
    UNITS,
    CalibrateConfig,
    RobotCalibration,
    bands,
    calibrate,
    check_clockwise,
    fit_wire,
    gained,
    left_out_share,
)
from endopilot.robot.candidates import Candidates, Estimate, search
from endopilot.robot.replay import prepare, usable_episodes
from endopilot.tasks.task import reference_navigation

sys.path.append(str(Path(__file__).parents[2] / "examples"))

NO_WIRE = CalibrateConfig(wires=0)


ROBOTS = {
    "plain": BlindRobot(gain=1.08, play_mm=1.6, lag_s=0.12),
    "slips": BlindRobot(gain=0.97, play_mm=0.9, slips=0.1),
    "stalls": BlindRobot(gain=0.97, play_mm=1.4, drift_mm=0.1, stalls=0.25, loses=0.7),
}


def assert_held(found: RobotCalibration, truth: dict[str, float]) -> None:
    for name, value in truth.items():
        told = found.estimates[name]
        assert told.identified and told.low <= value <= told.high, f"{name}: {value} not in {told}"


@pytest.mark.parametrize("kind", ROBOTS)
def test_intervals_hold_the_constants_of_robots_with_kinematics_of_their_own(fork, wire, kind) -> None:
    robot = ROBOTS[kind]
    seconds = 7.0 if kind == "stalls" else 5.0  # which take longer to be told from a gain
    found = calibrate([robot.logged(fork, episodes=5, seconds=seconds, seed=3)], fork, wire, config=NO_WIRE)
    assert_held(found, robot.truth)
    assert abs(found.robot.wire.gain_translation / robot.gain - 1) < 0.05
    assert abs(found.robot.wire.play_mm - robot.truth["play_mm"]) < 0.3
    slip = found.estimates.get("slip")
    assert (kind == "slips") == (slip is not None and slip.low > 0.01)
    assert kind != "plain" or found.layers["slack"] == LEFT_OUT


def test_intervals_are_of_sessions_which_differ(fork, wire) -> None:
    """Three sessions whose gains differ by 4 %: the mean of all that may be is not known to 1 %."""
    logs = [
        replace(BlindRobot(gain=gain).logged(fork, episodes=3, seconds=4.0, seed=2 * k), name=f"session {k}")
        for k, gain in enumerate((0.97, 1.01, 0.96))
    ]
    gain = calibrate(logs, fork, wire, config=NO_WIRE).estimates["gain_translation"]
    assert gain.low < 0.96 and gain.high > 1.01


def test_intervals_hold_the_constants_of_the_robot_in_the_simulator(fork, wire) -> None:
    robot = drawn(1)
    found = calibrate([logged(fork, wire, robot, episodes=5, seconds=5.0, seed=1)], fork, wire, config=NO_WIRE)
    truth = {"gain_translation": robot.wire.gain_translation, "play_mm": robot.wire.play_mm}
    assert_held(found, truth | {"latency_s": robot.latency_s})
    assert found.robot.encoders_at == "motor"


@pytest.mark.parametrize("gain", [-1.0, 2.5])
def test_a_translation_counted_otherwise_is_refused(fork, wire, gain) -> None:
    log = BlindRobot(gain=gain).logged(fork, episodes=5, seconds=5.0, seed=0)
    with pytest.raises(
        InputError, match=f"^synthetic: translation_mm: the tip goes {gain}.* give mm, forward positive$"
    ):
        calibrate([log], fork, wire, config=NO_WIRE)


def test_a_rotation_counted_otherwise_is_refused(wire) -> None:
    anatomy, robot = reference_navigation().anatomy, drawn(1)
    log = logged(anatomy, wire, robot, episodes=9, seconds=8.0, seed=1)
    for sign in (1.0, -1.0):
        turned = replace(log, command=log.command * [1.0, sign])
        of = prepare(usable_episodes([turned], anatomy), anatomy, 0.5, robot)
        with nullcontext() if sign > 0 else pytest.raises(InputError, match=r"^synthetic: rotation_rad: clockwise"):
            check_clockwise(of, wire, robot, CalibrateConfig())


def test_intervals_of_the_wire_hold_the_truth(fork, wire) -> None:
    robot = drawn(4)
    log = logged(fork, wire, robot, episodes=5, seconds=5.0, seed=4)
    prepared = prepare(usable_episodes([log], fork), fork, 0.5, robot)
    tried = fit_wire(prepared, wire, robot, CalibrateConfig(wires=32, wire_episodes=5))
    found = tried[0].estimates(UNITS)
    truth = {
        "tip_bend_deg": np.degrees(wire.tip_bend_rad),
        "tip_bend_length_mm": wire.tip_bend_length_mm,
        "friction": wire.friction,
        "tip_stiffness_factor": 1.0,
        "play_rad": robot.wire.play_rad,
    }
    assert all(found[name].low <= value <= found[name].high for name, value in truth.items()), found
    assert not found["friction"].identified


def test_what_lies_at_the_end_of_what_was_searched_is_not_identified() -> None:
    assert not Estimate(2.0, 1.9, 2.0, (0.5, 2.0)).identified
    assert not Estimate(0.5, 0.5, 0.6, (0.5, 2.0)).identified
    assert Estimate(0.02, 0.0, 0.1, (0.0, 10.0)).identified  # no play is less than none


def test_too_few_episodes_are_refused(fork, wire) -> None:
    log = BlindRobot().logged(fork, episodes=2, seconds=5.0, seed=0)
    with pytest.raises(InputError, match=r"synthetic: 2 episodes .*; intervals need 5: log more"):
        calibrate([log], fork, wire, config=NO_WIRE)


def test_the_public_logs_have_the_play_that_was_measured_on_them(tmp_path) -> None:
    """Advance per drive 1.01 (quartiles 0.97 and 1.05); after a reversal in sight the tip rests for 2.95 to 3.1 mm."""
    folder = Path(__file__).parents[3] / "shared" / "data" / "robot_phantom"
    if not folder.is_dir():
        pytest.skip("the public logs are not here")
    from robot_phantom_logs import convert

    phantom = endopilot.extract_anatomy(next(folder.glob("phantom2d*.vtp")), config=endopilot.AnatomyConfig(scale=1.0))
    logs = [convert(path, tmp_path) for path in sorted(folder.glob("2D_phantom_Mid_M1*.csv"))]
    found = calibrate(logs, phantom, endopilot.read_wire("workhorse-014"), config=CalibrateConfig(wires=0, episodes=12))
    assert abs(found.robot.wire.gain_translation - 1.01) < 0.03
    assert abs(found.robot.wire.play_mm - 3.0) < 0.3
    assert np.median([each.errors["along"] for each in found.replays]) < 0.35


def test_a_band_for_another_session_is_wider_than_one_for_another_episode() -> None:
    """Sessions differ by a factor of their own; of 40 sets of 8, the band holds in nine of ten further sessions."""
    random, held, wider = np.random.default_rng(0), [], 0
    for _ in range(40):
        factor = np.exp(0.3 * random.standard_normal((9, 1)))
        errors = factor * np.exp(0.4 * random.standard_normal((9, 30)))
        logs = np.repeat(np.arange(8), 30).astype(str).tolist()
        another, one_more = bands(errors[:8].ravel(), logs)
        wider += another > 1.05 * one_more
        held.append((errors[8] <= another).mean())
    assert wider >= 36 and 0.86 < np.mean(held) < 0.96
    assert 0.86 < left_out_share(errors[:8].ravel(), logs) < 0.98
    assert bands(errors[0], ["log"] * 30)[0] is None and left_out_share(errors[0], ["log"] * 30) is None
    assert bands(errors[0, :8], ["log"] * 8) == (None, None)  # no band is surer than 8/9


def test_a_layer_tells_how_many_that_were_left_out_it_predicts_better() -> None:
    costs = np.array([0.3, -0.2, 0.1, -0.1])  # logarithms: their mean may be anything
    assert gained(costs, costs - [2.0, 3.0, 2.5, -0.1], 0.9) == "3 of 4 that were left out cost less"
    assert gained(costs, costs + np.array([1.0, -1.0, 1.0, -1.0]), 0.9) == "no gain, left out"


RANGES = {"slope": (0.0, 5.0), "nothing": (-1.0, 1.0)}


def found(seed: int):
    """Search in twelve episodes of y = 2 x + noise, whose cost knows nothing of the second parameter."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1, 1, (12, 30))
    y = 2.0 * x + 0.3 * random.standard_normal(x.shape)

    def costs(values):
        return ((y - values[:, 0, None, None] * x) ** 2).sum(axis=2)

    tried = search(costs, RANGES, first=64, rounds=3, draws=128, seed=seed)
    return tried.estimates({"slope": "mm"}), (x * y).sum() / (x**2).sum()


def test_the_least_cost_is_found_with_an_interval_as_long_as_the_noise_makes_it() -> None:
    held, widths = 0, []
    for seed in range(20):
        told, least_squares = found(seed)
        slope = told["slope"]
        assert abs(slope.value - least_squares) < 0.01
        held += slope.low <= 2.0 <= slope.high
        widths.append(slope.high - slope.low)
    standard_error = 0.3 / np.sqrt(12 * 30 / 3)  # of the slope, with x evenly drawn from -1 to 1
    assert held >= 17
    assert 0.6 < np.mean(widths) / (2 * 2.2 * standard_error) < 1.8  # a tenth of the candidates at least


def test_what_the_cost_does_not_depend_on_is_not_identified() -> None:
    told, _ = found(0)
    assert not told["nothing"].identified and told["slope"].identified
    assert str(told["nothing"]) == "not identifiable from this log"
    assert str(told["slope"]).endswith(" mm")


def test_an_episode_left_out_is_judged_by_the_candidate_of_all_others() -> None:
    costs = np.array([[0.0, 0.0, 9.0], [1.0, 1.0, 1.0]])
    assert Candidates({"x": (0.0, 1.0)}, np.zeros((2, 1)), costs).left_out.tolist() == [1.0, 1.0, 9.0]


@pytest.fixture(scope="module")
def log_file(fork, wire, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.csv"
    log = logged(fork, wire, drawn(5), episodes=5, seconds=6.0, seed=5)
    columns = {"time_s": log.time_s, "episode": log.episode}
    names = ("encoder_mm", "encoder_rad", "tip_x_mm", "tip_y_mm", "tip_z_mm")
    columns |= dict(zip(names, [*log.encoders[:, 0].T, *log.tip.T], strict=True))
    table, place = pd.DataFrame(columns), pd.DataFrame(log.command[::2, 0]).groupby(log.episode[::2])
    for k, name in enumerate(("translation_mm_s", "rotation_rad_s")):  # a command stands in every other row
        table.loc[::2, name] = (place[k].diff().fillna(place[k].transform("first")) / PERIOD_S).to_numpy()
    table.to_csv(path, index=False)
    return path


def test_a_robot_is_calibrated_and_its_log_replayed(vessel, log_file, tmp_path, capsys) -> None:
    options = ("--anatomy", vessel, "-o")
    found = run(capsys, "calibrate", log_file, *options, tmp_path / "robot.yaml", "--wires", 4)
    assert {"gain_translation", "play_mm", "latency_s"} <= found["estimates"].keys()
    robot, written = read_robot(tmp_path / "robot.yaml"), read_json(tmp_path / "robot.json")
    assert robot.wire.play_mm == found["estimates"]["play_mm"]["value"] and robot.encoders_at == "motor"
    assert any(line.startswith("play_mm: ") and "95 %" in line for line in robot.sources)
    assert written["estimates"] == found["estimates"] and written["inputs"]["log.csv"]
    for name, each in found["estimates"].items():
        (line,) = (line for line in robot.sources if line.startswith(f"{name}: "))
        assert ("not identifiable" in line) != each["identified"]
    assert found["layer_wire"] == "no gain, left out" and "friction" not in found["estimates"]  # of four wires
    assert read_wire(tmp_path / "robot.device.yaml").friction == read_wire("workhorse-014").friction

    made = tmp_path / "replay"
    files = ("--robot", tmp_path / "robot.yaml", "--device", tmp_path / "robot.device.yaml")
    replayed = run(capsys, "replay", log_file, *options, made, *files)
    assert replayed["episodes"] == 5 and replayed["error_along_mm"] < 0.5
    table, errors = pd.read_csv(made / "replay.csv"), pd.read_csv(made / "errors.csv")
    assert table.groupby("episode")["given"].mean().between(0.4, 0.6).all() and len(errors) == 5
    assert read_json(made / "manifest.json")["figures"] == replayed
    with Image.open(made / "replay.png") as picture:
        assert min(picture.size) > 400
