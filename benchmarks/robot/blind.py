"""Calibrate blind robots of seven kinds, whose constants are known, from what they logged.

A blind robot shares no code with the package: its own kinematics lead a tip along the vessel's centerline. One kind is
the house's simulated robot instead, with another wire than the one that the calibration is told of.

python -m benchmarks robot-blind
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.figures import fill
from benchmarks.robot.synthetic import drawn, log_of, logged
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.robot.calibrate import CalibrateConfig, calibrate
from endopilot.robot.log import RobotLog
from endopilot.tasks.task import reference_navigation
from endopilot.types import Anatomy

KINDS = ("gain", "play", "lag", "offset", "negative", "slip", "wire")
GAIN_BAR, PLAY_BAR_MM = 0.03, 0.3
_FINE_S = 0.002
_NAMES: tuple[str, ...] = ("gain_translation", "play_mm", "latency_s")


@dataclass(frozen=True)
class BlindRobot:
    """A robot of its own kinematics.

    Attributes:
        gain: mm of the wire for each mm of the drive.
        play_mm: mm that are lost where the drive reverses.
        lag_s: s from a command to its motion.
        drift_mm: standard deviation of what the tip gains or loses on 10 mm of travel, mm.
        jumps: how often the tip jumps in an episode, by 1 to 4 mm, on average.
        stalls_mm: depth at which the wire begins to slip in its grip: half of a push is lost there, and all of it 5 mm
            deeper.
        tip_mm: standard deviation of a tip that is seen, mm.
    """

    gain: float = 1.0
    play_mm: float = 1.0
    lag_s: float = 0.1
    drift_mm: float = 0.0
    jumps: float = 0.0
    stalls_mm: float = np.inf
    tip_mm: float = 0.05

    @staticmethod
    def drawn(kind: str, seed: int) -> BlindRobot:
        """Draw a robot that is odd in one way, and in all others as robots are."""
        random = np.random.default_rng([seed, KINDS.index(kind), 11])
        robot = BlindRobot(
            gain=random.uniform(0.95, 1.05),
            play_mm=random.uniform(0.3, 2.0),
            lag_s=random.uniform(0.02, 0.15),
            drift_mm=random.choice([0.0, 0.1, 0.3]),
            tip_mm=random.uniform(0.03, 0.1),
        )
        odd: dict[str, dict[str, float]] = {
            "gain": {"gain": random.uniform(0.8, 1.25)},
            "play": {"play_mm": random.uniform(2.0, 5.0)},
            "lag": {"lag_s": random.uniform(0.15, 0.5)},
            "offset": {"drift_mm": random.uniform(0.3, 0.8), "jumps": random.uniform(0.5, 2.0)},
            "negative": {"gain": -random.uniform(0.85, 1.15)},
            "slip": {"stalls_mm": random.uniform(20.0, 30.0)},
        }
        return replace(robot, **odd[kind])

    def course(
        self, velocity: Float[np.ndarray, "periods"], period_s: float, depth_mm: float, random: np.random.Generator
    ) -> Float[np.ndarray, "periods"]:
        """Return where the tip is at the end of each period, mm."""
        tip, slack, late = depth_mm, random.uniform(0.0, self.play_mm), round(self.lag_s / _FINE_S)
        fine = np.repeat(velocity, round(period_s / _FINE_S)) * _FINE_S
        fine = np.concatenate([np.zeros(late), fine])[: len(fine)]
        jumps, out = random.random(len(fine)) < self.jumps / len(fine), []
        for step, jump in zip(self.gain * fine, jumps, strict=True):
            slack += step  # of the play, between its two ends
            moved = max(slack - self.play_mm, 0.0) + min(slack, 0.0)
            slack = min(max(slack, 0.0), self.play_mm)
            if moved > 0 and tip > self.stalls_mm:
                moved *= max(0.0, 0.5 - (tip - self.stalls_mm) / 10.0)
            tip += moved + self.drift_mm * np.sqrt(abs(moved) / 10.0) * random.standard_normal()
            tip += random.choice([-1.0, 1.0]) * random.uniform(1.0, 4.0) if jump else 0.0
            out.append(tip)
        return np.array(out).reshape(len(velocity), -1)[:, -1]

    def logged(self, anatomy: Anatomy, *, episodes: int, seconds: float, seed: int) -> RobotLog:
        """Drive to and fro at random along the longest path, and log positions commanded, velocities by odd seeds."""
        random, rows = np.random.default_rng([seed, 12]), []
        line, period_s = anatomy.tree.longest_path(), float(random.choice([0.06, 0.1, 0.14]))
        far = float(line.abscissa[-1])
        for episode in range(episodes):
            depth = random.uniform(8.0, 12.0) if self.gain > 0 else far / 2
            velocity, at = np.zeros(round(seconds / period_s)), depth
            way = 0.0
            for k in range(len(velocity)):
                if k % max(1, round(1.0 / period_s)) == 0:  # a manoeuvre takes a second
                    way = random.uniform(-6.0, 8.0)
                if not 8.0 < at + way < far - 12.0:
                    way = -way
                velocity[k] = way
                at += way * period_s
            tip = np.clip(self.course(velocity, period_s, depth, random), 0.0, far)
            for k, here in enumerate(tip):
                point = [np.interp(here, line.abscissa, column) for column in line.points.T]
                seen = np.array(point) + self.tip_mm * random.standard_normal(3)
                rows.append((episode, k * period_s, np.array([velocity[k], 0.0]), seen, (np.nan,) * 2, (np.nan,) * 2))
        return log_of(rows, period_s=period_s, by_velocity=seed % 2 == 1)


def bench_blind(
    *, kinds: tuple[str, ...] = KINDS, robots: int = 4, first: int = 0, episodes: int = 8, write: bool = False
) -> list[dict[str, Any]]:
    """Calibrate drawn robots from their logs alone; exit with 1 where a bar is missed.

    Intervals of 95 % are to hold, a gain to err by 3 % at most and a play by 0.3 mm, and a robot whose forward is
    negative to be refused.

    Args:
        kinds: of robots; all seven if not given.
        robots: of each kind.
        first: seed of the first.
        episodes: of each log, of 12 s each, in the reference anatomy.
        write: write the table of docs/evidence/reality.md.
    """
    anatomy, wire, rows = reference_navigation().anatomy, read_wire("workhorse-014"), []
    for kind in kinds:
        for seed in range(first, first + robots):
            if kind == "wire":
                robot = drawn(seed)
                truth = {"gain_translation": robot.wire.gain_translation, "play_mm": robot.wire.play_mm}
                truth["latency_s"], random = robot.latency_s, np.random.default_rng([seed, 13])
                other = wire.shaped(random.uniform(15, 70), random.uniform(3, 10))
                other = replace(other, friction=random.uniform(0.02, 0.3))
                log = logged(anatomy, other, robot, episodes=episodes, seed=seed)
            else:
                blind = BlindRobot.drawn(kind, seed)
                truth = dict(zip(_NAMES, (blind.gain, blind.play_mm, blind.lag_s), strict=True))
                log = blind.logged(anatomy, episodes=episodes, seconds=12.0, seed=seed)
            rows.append({"kind": kind, "robot": seed} | _judged(log, anatomy, wire, truth, seed))
    if write:
        fill("evidence/reality.md", "blind", _table(rows))
    return rows


def _judged(log: RobotLog, anatomy: Anatomy, wire: Any, truth: dict[str, float], seed: int) -> dict[str, Any]:
    """Return what a calibration finds, beside the truth."""
    try:
        found = calibrate([log], anatomy, wire, config=CalibrateConfig(wires=0, seed=seed))
    except InputError as error:
        return {"refused": str(error), "passed": truth["gain_translation"] < 0}
    row: dict[str, Any] = dict(found.layers)
    for name, true in truth.items():
        estimate = found.estimates[name]
        row |= {name: round(true, 3), f"{name}_found": round(estimate.value, 3)}
        row[f"{name}_half"] = round((estimate.high - estimate.low) / 2, 3)
        row[f"{name}_held"], row[f"{name}_known"] = estimate.low <= true <= estimate.high, estimate.identified
    gain, play = (abs(row[f"{name}_found"] - truth[name]) for name in _NAMES[:2])
    near = gain <= GAIN_BAR * abs(truth["gain_translation"]) and play <= PLAY_BAR_MM
    return row | {"passed": near and truth["gain_translation"] > 0}


def _table(rows: list[dict[str, Any]]) -> list[str]:
    """Return how far the best values are from the truth, and how often the intervals hold it, of each kind."""
    heads = "| kind | gain: largest error; holds | play, mm | lag, s | refused |"
    lines = [heads, "|---|---|---|---|---|"]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of = [row for row in rows if row["kind"] == kind]
        told = [row for row in of if "refused" not in row]
        cells = []
        for name in _NAMES:
            error = [abs(row[f"{name}_found"] - row[name]) for row in told]
            held = sum(row[f"{name}_held"] for row in told)
            cells.append(f"{max(error):.3f}; {held} of {len(told)}" if told else "-")
        lines.append(f"| {kind} | {' | '.join(cells)} | {len(of) - len(told)} of {len(of)} |")
    return lines
