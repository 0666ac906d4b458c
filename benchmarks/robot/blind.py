"""Calibrate simulated robots, whose constants are known, from what they logged.

python -m benchmarks robot-blind
"""

from __future__ import annotations

from typing import Any

from benchmarks.figures import fill
from benchmarks.robot.synthetic import drawn, logged
from endopilot.devices.device import read_wire
from endopilot.robot.calibrate import CalibrateConfig, calibrate
from endopilot.tasks.task import reference_navigation

GAIN_BAR, PLAY_BAR_MM = 0.03, 0.3


def bench_blind(*, robots: int = 12, episodes: int = 8, write: bool = False) -> list[dict[str, Any]]:
    """Calibrate drawn robots from their logs alone; exit with 1 where a gain errs by more than 3 % or a play by 0.3 mm.

    Args:
        robots: their number; gain, play, lag and the play of the rotation are drawn for each.
        episodes: of each log, of 12 s each, in the reference anatomy.
        write: write the table of docs/evidence/reality.md.
    """
    anatomy, wire, rows = reference_navigation().anatomy, read_wire("workhorse-014"), []
    for seed in range(robots):
        robot = drawn(seed)
        log = logged(anatomy, wire, robot, episodes=episodes, seed=seed)
        found = calibrate([log], anatomy, wire, config=CalibrateConfig(wires=0, seed=seed))
        truth = {
            "gain_translation": robot.wire.gain_translation,
            "play_mm": robot.wire.play_mm,
            "latency_s": robot.latency_s,
        }
        row: dict[str, Any] = {"robot": seed}
        for name, true in truth.items():
            estimate = found.estimates[name]
            row |= {name: round(true, 3), f"{name}_found": round(estimate.value, 3)}
            row[f"{name}_held"] = estimate.low <= true <= estimate.high
        gain, play = (abs(found.estimates[name].value - truth[name]) for name in ("gain_translation", "play_mm"))
        rows.append(row | {"passed": gain <= GAIN_BAR * truth["gain_translation"] and play <= PLAY_BAR_MM})
    if write:
        fill("evidence/reality.md", "blind", _table(rows))
    return rows


def _table(rows: list[dict[str, Any]]) -> list[str]:
    """Return how far the best values are from the truth, and how often the intervals hold it."""
    lines = ["| constant | drawn | largest error | the interval holds the truth |", "|---|---|---|---|"]
    for name, unit in (("gain_translation", ""), ("play_mm", " mm"), ("latency_s", " s")):
        true, error = [row[name] for row in rows], [abs(row[f"{name}_found"] - row[name]) for row in rows]
        held = sum(row[f"{name}_held"] for row in rows)
        drawn_from = f"{min(true):.2f} to {max(true):.2f}{unit}"
        lines.append(f"| `{name}` | {drawn_from} | {max(error):.3f}{unit} | {held} of {len(rows)} |")
    return lines
