"""Calibrate simulated robots, whose constants are known, from what they logged.

python -m benchmarks robot-blind
"""

from __future__ import annotations

from typing import Any

from benchmarks.robot.synthetic import drawn, logged
from endopilot.devices.device import read_wire
from endopilot.robot.calibrate import CalibrateConfig, calibrate
from endopilot.tasks.task import reference_navigation

GAIN_BAR, PLAY_BAR_MM = 0.03, 0.3


def bench_blind(*, robots: int = 12, episodes: int = 8) -> list[dict[str, Any]]:
    """Calibrate drawn robots from their logs alone; exit with 1 where a gain errs by more than 3 % or a play by 0.3 mm.

    Args:
        robots: their number; gain, play, lag and the play of the rotation are drawn for each.
        episodes: of each log, of 12 s each, in the reference anatomy.
    """
    anatomy, wire, rows = reference_navigation().anatomy, read_wire("workhorse-014"), []
    for seed in range(robots):
        robot = drawn(seed)
        log = logged(anatomy, wire, robot, episodes=episodes, seed=seed)
        found = calibrate([log], anatomy, wire, config=CalibrateConfig(wires=0, seed=seed))
        drive, told = robot.wire, found.estimates
        row: dict[str, Any] = {"robot": seed}
        for name, true in (
            ("gain_translation", drive.gain_translation),
            ("play_mm", drive.play_mm),
            ("latency_s", robot.latency_s),
        ):
            each = told[name]
            row |= {name: round(true, 3), f"{name}_found": str(each), f"{name}_held": each.low <= true <= each.high}
        gain, play = (abs(told[name].value - row[name]) for name in ("gain_translation", "play_mm"))
        rows.append(row | {"passed": bool(gain / drive.gain_translation <= GAIN_BAR and play <= PLAY_BAR_MM)})
    return rows
