"""Calibrate blind robots of ten kinds, whose constants are known, from what they logged.

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
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.robot.calibrate import LEFT_OUT, CalibrateConfig, calibrate, worst
from endopilot.robot.log import RobotLog
from endopilot.robot.replay import replay_log
from endopilot.tasks.task import reference_navigation
from endopilot.types import Anatomy

KINDS = ("gain", "play", "lag", "offset", "negative", "slip", "wire", "stalls", "sticks", "sessions")
SESSIONS = 4
"""Logs of a robot whose constants drift between sessions; one more is predicted."""
GAIN_BAR, PLAY_BAR_MM = 0.03, 0.3
_FINE_S, _STALL_S = 0.002, 0.3
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
        slips: share of every push that is lost.
        tip_mm: standard deviation of a tip that is seen, mm.
        stalls: share of the time in which the wire loses some of its motion, forward and backward, 0.3 s at a time.
        loses: share of the motion that is lost then.
        sticks_mm: the tip rests until the wire behind it has gone so far, and then leaps after it: a play more.
        gain_sd, play_sd_mm, lag_sd_s: standard deviations of the constants between sessions.
    """

    gain: float = 1.0
    play_mm: float = 1.0
    lag_s: float = 0.1
    drift_mm: float = 0.0
    jumps: float = 0.0
    stalls_mm: float = np.inf
    slips: float = 0.0
    tip_mm: float = 0.05
    stalls: float = 0.0
    loses: float = 1.0
    sticks_mm: float = 0.0
    gain_sd: float = 0.0
    play_sd_mm: float = 0.0
    lag_sd_s: float = 0.0

    @property
    def truth(self) -> dict[str, float]:
        """What is to be found; a tip that sticks loses its rest where the drive reverses, beside the play."""
        return dict(zip(_NAMES, (self.gain, self.play_mm + self.sticks_mm, self.lag_s), strict=True))

    def of_a_session(self, seed: int) -> BlindRobot:
        """Return the robot with the constants of one session."""
        off = np.random.default_rng([seed, 14]).standard_normal(3) * [self.gain_sd, self.play_sd_mm, self.lag_sd_s]
        gain, play_mm, lag_s = np.array([self.gain, self.play_mm, self.lag_s]) + off
        return replace(self, gain=float(gain), play_mm=max(float(play_mm), 0.0), lag_s=max(float(lag_s), 0.0))

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
            "slip": {("stalls_mm", "slips")[seed % 2]: random.uniform(*((20.0, 30.0), (0.05, 0.3))[seed % 2])},
            "stalls": {"stalls": random.uniform(0.1, 0.3), "loses": random.uniform(0.6, 1.0)},
            "sticks": {"sticks_mm": random.uniform(0.1, 0.5)},
            "sessions": {"gain_sd": 0.02, "play_sd_mm": 0.15, "lag_sd_s": 0.01},
        }
        return replace(robot, **odd[kind])

    def course(
        self, velocity: Float[np.ndarray, "periods"], period_s: float, depth_mm: float, random: np.random.Generator
    ) -> Float[np.ndarray, "periods"]:
        """Return where the tip is at the end of each period, mm."""
        wire, slack, late = depth_mm, random.uniform(0.0, self.play_mm), round(self.lag_s / _FINE_S)
        fine = np.repeat(velocity, round(period_s / _FINE_S)) * _FINE_S
        fine = np.concatenate([np.zeros(late), fine])[: len(fine)]
        jumps, out, tip = random.random(len(fine)) < self.jumps / len(fine), [], depth_mm
        begins = random.random(len(fine)) < self.stalls / (1 - self.stalls) * _FINE_S / _STALL_S
        stalled = np.convolve(begins, np.ones(round(_STALL_S / _FINE_S)))[: len(fine)] > 0
        for step, jump in zip(self.gain * fine * (1 - self.loses * stalled), jumps, strict=True):
            slack += step  # of the play, between its two ends
            moved = max(slack - self.play_mm, 0.0) + min(slack, 0.0)
            slack = min(max(slack, 0.0), self.play_mm)
            moved *= 1 - self.slips * (moved > 0)
            if moved > 0 and wire > self.stalls_mm:
                moved *= max(0.0, 0.5 - (wire - self.stalls_mm) / 10.0)
            wire += moved + self.drift_mm * np.sqrt(abs(moved) / 10.0) * random.standard_normal()
            wire += random.choice([-1.0, 1.0]) * random.uniform(1.0, 4.0) if jump else 0.0
            tip = wire if abs(wire - tip) >= self.sticks_mm else tip
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
    negative to be refused. Of `sessions`, a band of 90 % is to hold in the episodes of a further session.

    Args:
        kinds: of robots; all ten if not given.
        robots: of each kind.
        first: seed of the first.
        episodes: of each log, of 12 s each, in the reference anatomy.
        write: write the table of docs/evidence/reality.md.
    """
    anatomy, wire, rows = reference_navigation().anatomy, read_wire("workhorse-014"), []
    for kind in kinds:
        for seed in range(first, first + robots):
            further = None
            if kind == "wire":
                robot = drawn(seed)
                truth = {"gain_translation": robot.wire.gain_translation, "play_mm": robot.wire.play_mm}
                truth["latency_s"], random = robot.latency_s, np.random.default_rng([seed, 13])
                other = wire.shaped(random.uniform(15, 70), random.uniform(3, 10))
                other = replace(other, friction=random.uniform(0.02, 0.3))
                logs = [logged(anatomy, other, robot, episodes=episodes, seed=seed)]
            else:
                blind, logs = BlindRobot.drawn(kind, seed), []
                for k in range(SESSIONS + 1 if kind == "sessions" else 1):
                    of_one, number = blind.of_a_session(100 * seed + k), seed if k == 0 else 1000 * (seed + 1) + 2 * k
                    number += (seed - number) % 2  # all by velocity, or none
                    log = of_one.logged(anatomy, episodes=episodes, seconds=12.0, seed=number)
                    logs.append(replace(log, name=f"session {k}" if kind == "sessions" else log.name))
                truth, further = blind.truth, logs.pop() if kind == "sessions" else None
            rows.append({"kind": kind, "robot": seed} | _judged(logs, further, anatomy, wire, truth))
    if write:
        fill("evidence/reality.md", "blind", _table(rows))
    return rows


def _judged(
    logs: list[RobotLog], further: RobotLog | None, anatomy: Anatomy, wire: Wire, truth: dict[str, float]
) -> dict[str, Any]:
    """Return what a calibration finds, beside the truth, and how often its band holds in a further session."""
    try:
        found = calibrate(logs, anatomy, wire, config=CalibrateConfig(wires=0))
    except InputError as error:
        return {"refused": str(error), "passed": truth["gain_translation"] < 0}
    row: dict[str, Any] = dict(found.layers)
    for name, true in truth.items():
        estimate = found.estimates[name]
        row |= {name: round(true, 3), f"{name}_found": round(estimate.value, 3)}
        row[f"{name}_half"] = round((estimate.high - estimate.low) / 2, 3)
        row[f"{name}_held"], row[f"{name}_known"] = estimate.low <= true <= estimate.high, estimate.identified
    if further is not None and found.band_mm and found.next_band_mm:
        alone = found.layers["slack"] == LEFT_OUT
        errors = worst(replay_log([further], anatomy, Stack(found.wire), robot=found.robot), alone=alone)
        row["band_holds"], row["next_band_holds"] = ((errors <= b).mean() for b in (found.band_mm, found.next_band_mm))
    gain, play = (abs(row[f"{name}_found"] - truth[name]) for name in _NAMES[:2])
    near = gain <= GAIN_BAR * abs(truth["gain_translation"]) and play <= PLAY_BAR_MM
    return row | {"passed": near and truth["gain_translation"] > 0}


def _table(rows: list[dict[str, Any]]) -> list[str]:
    """Return how far the best values are from the truth, and how often the intervals hold it, of each kind."""
    heads = "| kind | gain: largest error; holds | play, mm | lag, s | refused | band of a further session holds |"
    lines = [heads, "|---|---|---|---|---|---|"]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of = [row for row in rows if row["kind"] == kind]
        told = [row for row in of if "refused" not in row]
        cells = []
        for name in _NAMES:
            error = [abs(row[f"{name}_found"] - row[name]) for row in told]
            held = sum(row[f"{name}_held"] for row in told)
            cells.append(f"{max(error):.3f}; {held} of {len(told)}" if told else "-")
        bands = [row["band_holds"] for row in told if "band_holds" in row]
        cells += [f"{len(of) - len(told)} of {len(of)}", f"{np.mean(bands):.2f}" if bands else "-"]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    return lines
