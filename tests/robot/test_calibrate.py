"""A robot whose constants are known is calibrated blind, from what it logged."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import endopilot
from benchmarks.robot.synthetic import drawn, logged
from endopilot.errors import InputError, Remark
from endopilot.robot.calibrate import (
    RESOLUTION,
    UNITS,
    WIRE,
    CalibrateConfig,
    band,
    calibrate,
    doubt_ends,
    fit_wire,
    left_out_share,
)
from endopilot.robot.candidates import Estimate, estimates
from endopilot.robot.replay import EpisodeReplay, prepare, usable_episodes

sys.path.append(str(Path(__file__).parents[2] / "examples"))

NO_WIRE = CalibrateConfig(wires=0)


@pytest.mark.parametrize("seed", [1, 2])
def test_intervals_of_the_drive_hold_the_truth(fork, wire, seed) -> None:
    robot = drawn(seed)
    found = calibrate([logged(fork, wire, robot, episodes=8, seed=seed)], fork, wire, config=NO_WIRE)
    truth = {
        "gain_translation": robot.wire.gain_translation,
        "play_mm": robot.wire.play_mm,
        "latency_s": robot.latency_s,
    }
    for name, value in truth.items():
        told = found.estimates[name]
        assert told.identified and told.low <= value <= told.high, f"{name}: {value} not in {told}"
    assert abs(found.robot.wire.gain_translation / robot.wire.gain_translation - 1) < 0.03
    assert abs(found.robot.wire.play_mm - robot.wire.play_mm) < 0.3
    assert found.robot.encoders_at == "motor"


def test_intervals_of_the_wire_hold_the_truth(fork, wire) -> None:
    robot = drawn(4)
    log = logged(fork, wire, robot, episodes=5, seconds=5.0, seed=4)
    prepared = prepare(usable_episodes([log], fork), fork, 0.5, robot)
    tried = fit_wire(prepared, wire, robot, CalibrateConfig(wires=32, wire_episodes=5))
    found = estimates(tried, WIRE, UNITS, RESOLUTION)
    truth = {
        "tip_bend_deg": np.degrees(wire.tip_bend_rad),
        "tip_bend_length_mm": wire.tip_bend_length_mm,
        "friction": wire.friction,
        "tip_stiffness_factor": 1.0,
        "play_rad": robot.wire.play_rad,
    }
    assert all(found[name].low <= value <= found[name].high for name, value in truth.items()), found
    assert found["play_rad"].identified and not found["friction"].identified


def test_a_drive_that_fits_best_at_the_end_of_what_was_searched_is_doubted(recwarn) -> None:
    """As of a log in which forward is counted negative."""
    sure = {"gain_translation": Estimate(1.01, 0.99, 1.03, (0.8, 1.25)), "play_mm": Estimate(0.1, 0.0, 0.2, (0.0, 6.0))}
    known, unknown = Estimate(0.05, 0.0, 0.1, (0.0, 0.5)), Estimate(0.4, 0.0, 0.5, (0.0, 0.5))
    doubt_ends("log", sure | {"latency_s": known})
    doubt_ends("log", sure | {"latency_s": unknown})  # the table says so
    assert not recwarn.list
    with pytest.warns(Remark, match="^log: the best fit has latency_s at the end .* forward is counted positive"):
        doubt_ends("log", sure | {"latency_s": Estimate(0.48, 0.47, 0.5, (0.0, 0.5))})
    with pytest.warns(Remark, match="^log: the best fit has gain_translation at the end"):
        doubt_ends("log", sure | {"latency_s": known, "gain_translation": Estimate(0.8, 0.8, 0.805, (0.8, 1.25))})


def test_too_few_episodes_are_refused(fork, wire) -> None:
    log = logged(fork, wire, drawn(1), episodes=2, seconds=5.0)
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


def test_a_band_holds_throughout_nine_of_ten_episodes() -> None:
    random = np.random.default_rng(0)

    def replay(size: float) -> EpisodeReplay:
        error = np.array([9.0, size, size / 2])  # the first tip was given
        return EpisodeReplay(
            number=0,
            time_s=np.arange(3.0),
            given=np.array([True, False, False]),
            seen=np.zeros((3, 3)),
            simulated=np.zeros((3, 3)),
            abscissa=np.column_stack([error, np.zeros(3)]),
            driven=np.zeros(3),
            in_view=np.zeros((3, 3)),
            along=np.zeros((3, 3)),
            branch=np.zeros((3, 2)),
            force=np.zeros((0, 2)),
            rotation_rad=0.0,
            rotation_known_rad=np.nan,
        )

    sizes = random.permutation(np.arange(1.0, 20.0))
    assert band([replay(size) for size in sizes]) == 18.0  # of 19, the 18th
    assert band([replay(size) for size in sizes[:8]]) is None  # no band is surer than 8/9
    others = [replay(size) for size in random.exponential(size=400)]
    assert 0.87 < left_out_share(others, [f"log {k % 4}" for k in range(400)]) < 0.93
    assert left_out_share(others, ["log"] * 400) is None
