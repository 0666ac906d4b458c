"""A robot and its wire from logs: what each constant is, how sure that is, and what a log does not tell.

Two fits, one after the other, with the same search (`candidates`). The drive: lag, gain and play of the translation,
from Δtip of the real tip, which follows the proximal end but for a constant in each episode. The wire: its bent tip,
friction, stiffness and the play of the rotation, from where the real tip lies beside that of the rod core and from the
drive's force where the log has it, with a world for each candidate, episode and rotation at the start.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.device import Wire
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError, Remark
from endopilot.progress import Advance, progress
from endopilot.robot.candidates import LEAST_EPISODES, Candidates, Estimate, estimates, search
from endopilot.robot.log import STARTS, Courses, RobotLog
from endopilot.robot.replay import (
    FAR_MM,
    EpisodeReplay,
    Prepared,
    ReplayConfig,
    prepare,
    replay_prepared,
    usable_episodes,
)
from endopilot.settings import OpenShare, Seed, Within, public, settings
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
RESOLUTION = MappingProxyType({"gain_translation": 0.005, "play_mm": 0.1, "latency_s": 0.01})
"""Least half-widths of intervals. A command lasts for 0.05 to 0.2 s and moves the wire by some 0.3 mm; what it does
within that, and how the wire lies in a vessel that is known to 0.1 mm, no log tells."""
_TYPICAL_MM = 0.3
"""Errors of Δtip up to this count by their squares, larger ones by their size: a tip that snaps, mm."""
_TIMES = 2
"""Fits of the drive with the slack that the rod core has by the fit before."""
_LEVEL = 0.9
"""Share of episodes in which the band is to hold."""


@settings
class CalibrateConfig:
    """How logs are fitted."""

    given: OpenShare = 0.5
    """Share of each episode's tips that say where the wire lies; the rest is predicted."""
    episodes: Annotated[int, Within(LEAST_EPISODES, 10000)] = 96
    """Episodes that the drive is fitted to at most, evenly chosen from all."""
    wire_episodes: Annotated[int, Within(LEAST_EPISODES, 1000)] = 16
    """Episodes that the wire is fitted to at most, likewise."""
    wires: Annotated[int, Within(0, 10000)] = 128
    """Wires that are tried: half of them from all that may be, the others around the best; with 0 it is not fitted."""
    seed: Seed = 0
    """Seed of both searches."""


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """What logs say of a robot and its wire.

    Attributes:
        robot: with lag, gain and plays as they were found.
        wire: with the tip, friction and stiffness of the best candidate, those too that are not identified: they belong
            together.
        estimates: each constant with its interval.
        band_mm: half-width within which Δtip was predicted throughout 90 % of the episodes, mm; None with too few.
        band_share: share of the episodes of each log in which the band of the other logs holds; None with one log.
        replays: of the episodes that the drive was fitted to.
    """

    robot: RobotConfig
    wire: Wire
    estimates: dict[str, Estimate]
    band_mm: float | None
    band_share: float | None
    replays: list[EpisodeReplay]


@public
def calibrate(
    logs: Sequence[RobotLog],
    anatomy: Anatomy,
    device: Wire,
    *,
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
    replays = ReplayConfig(given=config.given)
    of = prepare(_evenly(episodes, config.episodes), anatomy, config.given, robot)
    drives, estimated = fit_drive(of, seed=config.seed), {}
    robot = _driven(robot, drives)
    robot = replace(robot, encoders_at=where_encoders_sit(of.logs, robot) or robot.encoders_at)
    if config.wires:
        some = prepare(_evenly(episodes, config.wire_episodes), anatomy, config.given, robot)
        wires = fit_wire(some, device, robot, config)
        estimated = estimates(wires, WIRE, UNITS, RESOLUTION)
        device, robot = with_found(device, robot, {name: estimated[name].value for name in WIRE})
    for _ in range(_TIMES):
        slack = _slack(of, replay_prepared(of, Stack(device), robot, replays))
        drives = fit_drive(of, slack, seed=config.seed)
        robot = _driven(robot, drives)
    estimated = estimates(drives, DRIVE, UNITS, RESOLUTION) | estimated
    doubt_ends(logs[0].name, estimated)
    found = replay_prepared(of, Stack(device), robot, replays)
    held = left_out_share(found, [log.name for log in of.logs])
    return RobotCalibration(robot, device, estimated, band(found), held, found)


def doubt_ends(log: str, found: Mapping[str, Estimate]) -> None:
    """Warn (`Remark`) of constants of the drive that fit best at an end of what was searched, as no robot's should."""
    at_ends = [
        name
        for name, (least, most) in DRIVE.items()
        if found[name].identified and (found[name].low <= least > 0 or found[name].high >= most)
    ]
    if at_ends:
        warnings.warn(
            f"{log}: the best fit has {', '.join(at_ends)} at the end of what was searched; check that forward is "
            "counted positive, and that times are in s",
            Remark,
            stacklevel=3,
        )


def _evenly(episodes: list[RobotLog], most: int) -> list[RobotLog]:
    """Return so many of some episodes at most, evenly chosen."""
    return [episodes[k] for k in np.unique(np.linspace(0, len(episodes) - 1, most).round().astype(int))]


def _driven(robot: RobotConfig, found: Candidates) -> RobotConfig:
    """Return a robot with the best candidate of `DRIVE`."""
    gain, play, latency = found.values[found.best].tolist()
    return replace(robot, latency_s=latency, wire=replace(robot.wire, gain_translation=gain, play_mm=play))


def _slack(of: Prepared, found: Sequence[EpisodeReplay]) -> Float[np.ndarray, "episodes tips"]:
    """Return how much farther than its proximal end each tip went in the rod core, mm; NaN beyond an episode's tips."""
    slack = np.full(of.abscissa.shape, np.nan)
    for row, each in zip(slack, found, strict=True):
        row[: len(each.driven)] = each.abscissa[:, 1] - each.driven
    return slack


def fit_drive(of: Prepared, slack: Float[np.ndarray, "episodes tips"] | float = 0.0, *, seed: int = 0) -> Candidates:
    """Return candidates of `DRIVE`, by how far Δtip of the real tip is from what the drive made of the commands.

    Args:
        of: episodes.
        slack: how much farther than its proximal end the tip went in the rod core, mm.
        seed: of the search.
    """
    unit, abscissa = _units(of), of.abscissa - slack

    def costs(values: Float[np.ndarray, "candidates 3"]) -> Float[np.ndarray, "candidates units"]:
        gain, play, latency = values.T
        least = np.full((len(values), len(of.logs)), np.inf)
        for start in STARTS:
            motion = of.courses.followed(
                0, at_s=of.courses.seen_s, latency_s=latency, gain=gain, play=play, start=start
            )
            error = abscissa - motion
            error -= np.nanmedian(error, axis=2, keepdims=True)
            size = 2 * (np.sqrt(1 + (error / _TYPICAL_MM) ** 2) - 1)
            least = np.minimum(least, np.nansum(size, axis=2))
        return _summed(least, unit)

    return search(costs, DRIVE, generations=12, rounds=3, draws=256, seed=seed)


def fit_wire(of: Prepared, device: Wire, robot: RobotConfig, config: CalibrateConfig) -> Candidates:
    """Return candidates of `WIRE`, by how far the simulated tip is from the real one, as the camera sees it."""
    replays, unit = ReplayConfig(given=config.given), _units(of)
    first, draws = config.wires // 2, config.wires // 4

    def costs(values: Float[np.ndarray, "candidates parameters"]) -> Float[np.ndarray, "candidates units"]:
        rows = []
        for row in values:
            wire, driven = with_found(device, robot, dict(zip(WIRE, row.tolist(), strict=True)))
            found = replay_prepared(of, Stack(wire), driven, replays)
            rows.append([_cost(each, robot) for each in found])
            advance(1)
        return _summed(np.array(rows), unit)

    advance: Advance
    with progress("Fitting the wire", total=first + 2 * draws) as advance:
        return search(costs, WIRE, generations=0, rounds=2, draws=draws, first=first, seed=config.seed)


def _cost(episode: EpisodeReplay, robot: RobotConfig) -> float:
    """Return what a wire costs in an episode: errors of the tip, and of the drive's force where it was measured."""
    tip = float(np.minimum(np.linalg.norm(episode.in_view, axis=1), FAR_MM).mean()) / _TYPICAL_MM
    if not len(episode.force):
        return tip
    error = np.diff(episode.force, axis=1) / max(3 * robot.wire.load_sd_n, 1e-3)
    return tip + float((2 * (np.sqrt(1 + error**2) - 1)).mean())


def with_found(device: Wire, robot: RobotConfig, found: Mapping[str, float]) -> tuple[Wire, RobotConfig]:
    """Return a wire and a robot with some constants of `WIRE` as they were found."""
    bend = math.degrees(device.tip_bend_rad)
    shaped = device.shaped(found.get("tip_bend_deg", bend), found.get("tip_bend_length_mm", device.tip_bend_length_mm))
    shaped = shaped.with_tip(bend_rad=shaped.tip_bend_rad, stiffness_factor=found.get("tip_stiffness_factor", 1.0))
    wire = replace(shaped, friction=found.get("friction", device.friction))
    drive = replace(robot.wire, play_rad=found.get("play_rad", robot.wire.play_rad))
    return wire, replace(robot, wire=drive)


def where_encoders_sit(episodes: Sequence[RobotLog], robot: RobotConfig) -> str | None:
    """Return where the wire's encoders sit: "motor" if they follow its commands, "wire" if they follow gain and play.

    Args:
        episodes: logs of one episode each.
        robot: with lag, gain and play as they were found.

    Returns:
        None where no log has readings.
    """
    far = {"motor": [], "wire": []}
    for log in episodes:
        read = np.isfinite(log.encoders[:, 0, 0])
        if read.sum() < 2:
            continue
        courses, at_s = Courses.of([log], robot.wire), (log.time_s[read] - log.time_s[0])[None]
        late = np.array([robot.latency_s])
        for place, gain, play in (("motor", 1.0, 0.0), ("wire", robot.wire.gain_translation, robot.wire.play_mm)):
            motion = courses.followed(0, at_s=at_s, latency_s=late, gain=np.array([gain]), play=np.array([play]))
            far[place].append(float(np.std(log.encoders[read, 0, 0] - motion[0, 0])))
    if not far["motor"]:
        return None
    return min(far, key=lambda place: np.median(far[place]))


def band(replays: Sequence[EpisodeReplay]) -> float | None:
    """Return the half-width, mm, within which Δtip was predicted throughout most of the episodes (conformal).

    Returns:
        None with too few episodes.
    """
    rank = math.ceil(_LEVEL * (len(replays) + 1))
    return float(np.sort(_worst(replays))[rank - 1]) if rank <= len(replays) else None


def left_out_share(replays: Sequence[EpisodeReplay], logs: Sequence[str]) -> float | None:
    """Return in which share of the episodes the band holds that is made of all other logs; None where none is."""
    worst, held = _worst(replays), []
    for name in dict.fromkeys(logs):
        others = [each for each, log in zip(replays, logs, strict=True) if log != name]
        width = band(others)
        if width is not None:
            held += [bool(far <= width) for far, log in zip(worst, logs, strict=True) if log == name]
    return float(np.mean(held)) if held and len(set(logs)) > 1 else None


def _worst(replays: Sequence[EpisodeReplay]) -> Float[np.ndarray, "episodes"]:
    """Return the largest error of Δtip in what was predicted of each episode, mm."""
    return np.array([np.abs(np.diff(each.abscissa, axis=1)[~each.given, 0]).max() for each in replays])


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
