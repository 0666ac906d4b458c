"""A robot and its wire from logs: what each constant is, how sure that is, and what a log does not tell.

Two fits, one after the other, with the same search (`candidates`). The drive: lag, gain and play of the translation,
from Δtip of the real tip, which follows the proximal end but for a constant in each episode. The wire: its bent tip,
friction, stiffness and the play of the rotation, from where the real tip lies in the vessel beside that of the rod core,
one world for each candidate, episode and rotation at the start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.progress import Advance, progress
from endopilot.robot.candidates import LEAST_EPISODES, Candidates, Estimate, estimates, search
from endopilot.devices.robot import RobotConfig
from endopilot.robot.log import RobotLog
from endopilot.robot.replay import (
    FAR_MM,
    EpisodeReplay,
    Prepared,
    ReplayConfig,
    prepare,
    replay_prepared,
    usable_episodes,
)
from endopilot.settings import OpenShare, Seed, Within, settings
from endopilot.types import Anatomy

DRIVE = MappingProxyType({"gain_translation": (0.8, 1.25), "play_mm": (0.0, 6.0), "latency_s": (0.0, 0.5)})
"""What is searched of the drive."""
WIRE = MappingProxyType(
    {
        "tip_bend_deg": (5.0, 90.0),
        "tip_bend_length_mm": (2.0, 12.0),
        "friction": (0.01, 0.4),
        "tip_stiffness_factor": (0.3, 3.0),
        "play_rad": (0.0, 9.0),
    }
)
"""What is searched of the wire, and of the drive's rotation."""
UNITS = MappingProxyType(
    {"play_mm": "mm", "latency_s": "s", "tip_bend_deg": "°", "tip_bend_length_mm": "mm", "play_rad": "rad"}
)
_TYPICAL_MM = 0.3
"""Errors of Δtip up to this count by their squares, larger ones by their size: a tip that snaps, mm."""
_LEVEL = 0.9
"""Share of episodes in which the band is to hold."""


@settings
class CalibrateConfig:
    """How logs are fitted."""

    given: OpenShare = 0.5
    """Share of each episode's tips that say where the wire lies; the rest is predicted."""
    wire_episodes: Annotated[int, Within(LEAST_EPISODES, 1000)] = 16
    """Episodes that the wire is fitted to, evenly chosen from all."""
    wire_rounds: Annotated[int, Within(0, 20)] = 2
    """Rounds of 32 wires each that are drawn after the first 64; with 0 the wire is not fitted."""
    seed: Seed = 0
    """Seed of both searches."""


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """What logs say of a robot and its wire.

    Attributes:
        robot: with lag, gain and plays as they were found.
        wire: with the tip, friction and stiffness that were found where they are identified.
        estimates: each constant with its interval.
        band_mm: half-width within which Δtip was predicted throughout 90 % of the episodes, mm; None with too few.
        replays: of the episodes that the wire was fitted to.
    """

    robot: RobotConfig
    wire: Wire
    estimates: dict[str, Estimate]
    band_mm: float | None
    replays: list[EpisodeReplay]


def calibrate(
    logs: Sequence[RobotLog],
    anatomy: Anatomy,
    device: Wire,
    robot: RobotConfig | None = None,
    config: CalibrateConfig | None = None,
) -> RobotCalibration:
    """Calibrate a robot and its wire.

    Args:
        logs: what the robot was asked for, and what was seen.
        anatomy: the vessel that it was driven through.
        device: the wire, as it is known.
        robot: what is known of the robot; the fields that are found are replaced.
        config: how they are fitted.

    Raises:
        InputError: too few episodes.
    """
    config, robot = config or CalibrateConfig(), robot or RobotConfig()
    episodes = usable_episodes(logs, anatomy)
    if len(episodes) < LEAST_EPISODES:
        raise InputError(
            f"{logs[0].name}: {len(episodes)} episodes that show the tip often enough; intervals need "
            f"{LEAST_EPISODES}: log more, or number them anew (`episode`) wherever the device was reset"
        )
    of = prepare(episodes, anatomy, config.given)
    found = fit_drive(of, seed=config.seed)
    told = estimates(found, DRIVE, [UNITS.get(name, "") for name in DRIVE])
    drive = replace(robot.wire, gain_translation=told["gain_translation"].value, play_mm=told["play_mm"].value)
    robot = replace(robot, latency_s=told["latency_s"].value, wire=drive)
    encoders = where_encoders_sit(logs)
    robot = replace(robot, encoders_at=encoders or robot.encoders_at)
    some = np.unique(np.linspace(0, len(episodes) - 1, min(config.wire_episodes, len(episodes))).round().astype(int))
    of = prepare([episodes[k] for k in some], anatomy, config.given)
    if config.wire_rounds:
        wires = fit_wire(of, device, robot, config)
        told |= estimates(wires, WIRE, [UNITS.get(name, "") for name in WIRE])
        known = {name: told[name].value for name in WIRE if told[name].identified}
        device, robot = with_found(device, robot, known)
    replays = replay_prepared(of, Stack(device), robot, ReplayConfig(given=config.given))
    return RobotCalibration(robot, device, told, band(replays), replays)


def fit_drive(of: Prepared, *, seed: int = 0) -> Candidates:
    """Return candidates of `DRIVE`, by how far Δtip of the real tip is from what the drive made of the commands."""
    unit = _units(of)

    def costs(values: Float[np.ndarray, "candidates 3"]) -> Float[np.ndarray, "candidates units"]:
        gain, play, latency = values.T
        least = np.full((len(values), len(of.logs)), np.inf)
        for start in (1.0, -1.0):  # nobody knows which way the drive went last before the log begins
            motion = of.courses.followed(
                0, at_s=of.courses.seen_s, latency_s=latency, gain=gain, play=play, start=start
            )
            error = of.abscissa - motion
            error -= np.nanmedian(error, axis=2, keepdims=True)
            size = 2 * (np.sqrt(1 + (error / _TYPICAL_MM) ** 2) - 1)
            least = np.minimum(least, np.nansum(size, axis=2))
        return _summed(least, unit)

    return search(costs, DRIVE, generations=15, rounds=3, draws=128, seed=seed)


def fit_wire(of: Prepared, device: Wire, robot: RobotConfig, config: CalibrateConfig) -> Candidates:
    """Return candidates of `WIRE`, by how far the simulated tip is from the real one, as the camera sees it."""
    replays, unit = ReplayConfig(given=config.given), _units(of)
    draws, first = 32, 64

    def costs(values: Float[np.ndarray, "candidates parameters"]) -> Float[np.ndarray, "candidates units"]:
        rows = []
        for row in values:
            wire, driven = with_found(device, robot, dict(zip(WIRE, row.tolist(), strict=True)))
            found = replay_prepared(of, Stack(wire), driven, replays)
            rows.append([np.minimum(np.linalg.norm(each.in_view, axis=1), FAR_MM).mean() for each in found])
            advance(1)
        return _summed(np.array(rows), unit)

    advance: Advance
    with progress("Fitting the wire", total=first + draws * config.wire_rounds) as advance:
        return search(costs, WIRE, generations=0, rounds=config.wire_rounds, draws=draws, first=first, seed=config.seed)


def with_found(device: Wire, robot: RobotConfig, found: Mapping[str, float]) -> tuple[Wire, RobotConfig]:
    """Return a wire and a robot with some constants of `WIRE` as they were found."""
    bend = math.degrees(device.tip_bend_rad)
    shaped = device.shaped(found.get("tip_bend_deg", bend), found.get("tip_bend_length_mm", device.tip_bend_length_mm))
    shaped = shaped.with_tip(bend_rad=shaped.tip_bend_rad, stiffness_factor=found.get("tip_stiffness_factor", 1.0))
    wire = replace(shaped, friction=found.get("friction", device.friction))
    drive = replace(robot.wire, play_rad=found.get("play_rad", robot.wire.play_rad))
    return wire, replace(robot, wire=drive)


def where_encoders_sit(logs: Sequence[RobotLog]) -> str | None:
    """Return where the wire's encoders sit: at the motor if they follow its commands back and forth; None without any.

    Behind a play they would rest after a reversal: their distance from the commands would spread as widely as it.
    """
    apart = []
    for log in (episode for each in logs for episode in each.episodes()):
        read, asked = np.isfinite(log.encoders[:, 0, 0]), log.commanded
        if read.sum() > 1 and asked.sum() > 1:
            last = np.searchsorted(np.flatnonzero(asked), np.flatnonzero(read)) - 1
            before = log.command[asked, 0, 0][np.maximum(last, 0)]
            apart.append(np.ptp(np.quantile(log.encoders[read, 0, 0] - before, [0.05, 0.95])))
    if not apart:
        return None
    return "motor" if float(np.median(apart)) < _SPREAD_MM else "wire"


_SPREAD_MM = 1.0


def band(replays: Sequence[EpisodeReplay], level: float = _LEVEL) -> float | None:
    """Return the half-width, mm, within which Δtip was predicted throughout a share of the episodes (conformal).

    Args:
        replays: of episodes.
        level: the share.
    """
    worst = np.sort([np.abs(np.diff(each.abscissa, axis=1)[~each.given, 0]).max() for each in replays])
    rank = math.ceil(level * (len(worst) + 1))
    return float(worst[rank - 1]) if rank <= len(worst) else None


def _units(of: Prepared) -> Int[np.ndarray, "episodes"]:
    """Return what each episode counts to: its log where there are enough, for logs differ more than their episodes."""
    names = [log.name for log in of.logs]
    logs = list(dict.fromkeys(names))
    return np.array([logs.index(name) for name in names]) if len(logs) >= LEAST_EPISODES else np.arange(len(names))


def _summed(
    costs: Float[np.ndarray, "candidates episodes"], unit: Int[np.ndarray, "episodes"]
) -> Float[np.ndarray, "candidates units"]:
    sums = np.zeros((len(costs), unit.max() + 1))
    np.add.at(sums.T, unit, costs.T)
    return sums
