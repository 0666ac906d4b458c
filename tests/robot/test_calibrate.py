"""A robot whose constants are known is calibrated blind, from what it logged."""

from __future__ import annotations

import pytest
from synthetic_robot import drawn, logged

from endopilot.robot.calibrate import CalibrateConfig, calibrate

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
    assert found.robot.encoders_at == "motor"
