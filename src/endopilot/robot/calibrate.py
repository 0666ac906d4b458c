"""A robot and its wire from logs: what each constant is, how sure that is, and what a log does not tell.

docs/concepts/calibration.md says how: the drive's kinematics first, then layers that must earn their place on episodes
left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from endopilot.devices.device import Wire
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.progress import Advance, progress
from endopilot.robot.candidates import LEAST_EPISODES, Candidates, Estimate, search
from endopilot.robot.kinematics import NAMES, RANGES, DriveFit, Tracks, earns, evenly, fit_drive
from endopilot.robot.log import Courses, RobotLog
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

DRIVE = MappingProxyType(dict(zip(NAMES, ((0.5, 2.0), *RANGES[1:]), strict=False)))
"""What may be of the drive: gains as a robot's file takes them."""
WIRE = MappingProxyType(
    {
        "tip_bend_deg": (5.0, 90.0),
        "tip_bend_length_mm": (2.0, 12.0),
        "friction": (0.01, 0.4),
        "tip_stiffness_factor": (0.3, 3.0),
        "play_rad": (0.0, 9.0),
        "twist_friction_n_mm_mm": (0.0, 8e-4),
        "grip_n": (0.05, 1.0),
    }
)
"""What is searched of the wire, and of the drive's rotation and grip."""
UNITS = MappingProxyType(
    {"play_mm": "mm", "latency_s": "s", "tip_bend_deg": "°", "tip_bend_length_mm": "mm", "play_rad": "rad"}
    | {"twist_friction_n_mm_mm": "N·mm/mm", "grip_n": "N"}
)
RESOLUTION = MappingProxyType({"gain_translation": 0.005, "play_mm": 0.1, "latency_s": 0.015})
"""Least half-widths of intervals. A command lasts for 0.05 to 0.2 s and moves the wire by some 0.3 mm; what it does
within that, and how the wire lies in a vessel that is known to 0.1 mm, no log tells."""
_BEHIND_MM = 1000.0
"""Length behind the ostium over which a wire twists, if the robot names none, mm: only m L² / 2 GJ tells in a log."""
_AT_ONCE = 1e6
"""Acceleration of a drive that takes no time to speed up, as the robot `ideal` has it, mm/s²."""
LEFT_OUT = "no gain, left out"
_TYPICAL_MM = 0.3
"""What a tip may be off by, mm: errors are counted in it."""
_LEVEL, _LEAST_LOGS = 0.9, 3
"""Share of episodes in which the band is to hold, and logs whose differences say how much another one differs."""
_BETTER, _BETTER_WIRE, _SURE = 0.5, 0.95, 0.999
"""Levels at which episodes left out must cost less: for a share that is fitted with its uncertainty, on average; for a
wire, chosen from many; for the other sign of an axis, as a log is refused."""


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
        robot: with lag, gain and plays as they were found; what is not identified is as it was known.
        wire: with the constants of the best candidate, which belong together, identified or not; as it was known where
            the layer was left out.
        estimates: each constant with its interval.
        layers: what slip, a simulated wire's slack and the wire gained on episodes left out, or that it was left out.
        band_mm: half-width within which Δtip is predicted throughout nine of ten episodes of another session (log), mm,
            by the drive alone where the slack was left out; None with too few sessions.
        next_band_mm: the same of one more episode of these sessions, mm; None with too few episodes.
        band_share: share of the episodes of each log in which the band of the other logs holds; None with few logs.
        replays: of the episodes that the drive was fitted to.
    """

    robot: RobotConfig
    wire: Wire
    estimates: dict[str, Estimate]
    layers: dict[str, str]
    band_mm: float | None
    next_band_mm: float | None
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
    """Calibrate a robot and its wire, as they are known, by logs of driving the wire through a vessel; the fields that
    are found are replaced. InputError for too few episodes, or an axis counted the other way round, or in another
    unit."""
    config, robot = config or CalibrateConfig(), robot or RobotConfig()
    episodes = usable_episodes(logs, anatomy)
    if len(episodes) < LEAST_EPISODES:
        raise InputError(
            f"{logs[0].name}: {len(episodes)} episodes that show the tip often enough; intervals need "
            f"{LEAST_EPISODES}: log more, or number them anew (`episode`) wherever the device was reset"
        )
    chosen = [episodes[k] for k in evenly(len(episodes), config.episodes)]
    of, layers = prepare(chosen, anatomy, config.given, robot), {}
    drive = fit_drive(of, _units(of))
    if of.logs[0].by_velocity:  # what is lost as a drive speeds up, if it needs time for that, is never caught up
        at_once = replace(robot, wire=replace(robot.wire, max_acceleration_mm_s2=_AT_ONCE))
        others = replace(of, courses=Courses.of(of.logs, at_once.wire))
        other = fit_drive(others, drive.unit)
        if earns(drive.left_out, other.left_out, _BETTER):
            of, robot, drive = others, at_once, other
    drive, layers["slip"] = _with_layer("slip", of, drive)
    check_forward(logs[0].name, drive)
    robot = _driven(robot, drive)
    robot = replace(robot, encoders_at=where_encoders_sit(of.logs, robot) or robot.encoders_at)
    of_wire: dict[str, Estimate] = {}
    if config.wires:
        chosen = [episodes[k] for k in evenly(len(episodes), config.wire_episodes)]
        some = prepare(chosen, anatomy, config.given, robot)
        check_clockwise(some, device, robot, config)
        tried, as_known = fit_wire(some, device, robot, config)
        layers["wire"] = gained(as_known, tried.left_out, _BETTER_WIRE)
        if layers["wire"] != LEFT_OUT:
            of_wire = tried.estimates(UNITS)
            device, robot = with_found(device, robot, {name: of_wire[name].value for name in WIRE})
    replays = ReplayConfig(given=config.given)
    found = replay_prepared(of, Stack(device), robot, replays)
    drive, layers["slack"] = _with_layer("slack", replace(of, slack=_slack(of, found)), drive)
    if layers["slack"] != LEFT_OUT:
        robot = _driven(robot, drive)
        found = replay_prepared(of, Stack(device), robot, replays)
    names, errors = [log.name for log in of.logs], worst(found, alone=layers["slack"] == LEFT_OUT)
    (another, one_more), share = bands(errors, names), left_out_share(errors, names)
    return RobotCalibration(robot, device, of_drive(drive) | of_wire, layers, another, one_more, share, found)


def _with_layer(name: str, tracks: Tracks, fit: DriveFit) -> tuple[DriveFit, str]:
    """Return a fit with one more layer, if that earns its place, and what it gained."""
    tried = fit_drive(tracks, fit.unit, fit, name)
    said = gained(fit.left_out, tried.left_out, _BETTER)
    return (fit if said == LEFT_OUT else tried), said


def of_drive(fit: DriveFit) -> dict[str, Estimate]:
    """Return the constants of the drive that were fitted, with their intervals."""
    found = {}
    for k in np.flatnonzero(fit.free):
        name, value = NAMES[k], float(fit.values[k])
        half, (least, most) = max(float(fit.half_width[k]), RESOLUTION.get(name, 0.0)), DRIVE[name]
        low, high = max(value - half, least), min(value + half, most)
        found[name] = Estimate(value, low, high, (least, most), UNITS.get(name, ""))
    return found


def check_forward(log: str, fit: DriveFit) -> None:
    """Raise InputError where the tip goes back as the translation grows, or much farther or less."""
    gain, half = float(fit.values[0]), float(fit.half_width[0])
    least, most = DRIVE["gain_translation"]
    if gain + half < least or gain - half > most:
        said = f"the tip goes {gain:.2f} mm for each mm, not {least:g} to {most:g}; give mm, forward positive"
        raise InputError(f"{log}: translation_mm: {said}")


def check_clockwise(of: Prepared, device: Wire, robot: RobotConfig, config: CalibrateConfig) -> None:
    """Raise InputError where a rotation that is turned predicts episodes better; in a flat vessel it does as well."""
    other = [replace(log, command=log.command * [1.0, -1.0]) for log in of.logs]
    turned = replace(of, logs=other, courses=Courses.of(other, robot.wire))
    as_it_is, better = (_wire_costs(each, device, robot, config) for each in (of, turned))
    if earns(as_it_is, better, _SURE):
        raise InputError(
            f"{of.logs[0].name}: rotation_rad: clockwise is counted negative: with the other sign tips are predicted "
            "better; change it"
        )


def gained(without: Float[np.ndarray, "units"], costs: Float[np.ndarray, "units"], level: float) -> str:
    """Return how many units that were left out a layer predicts better, or that the layer is left out."""
    if not earns(without, costs, level):
        return LEFT_OUT
    return f"{np.sum(costs < without)} of {len(costs)} that were left out cost less"


def _driven(robot: RobotConfig, fit: DriveFit) -> RobotConfig:
    """Return a robot with what is identified of its drive."""
    found = {name: each.value for name, each in of_drive(fit).items() if each.identified}
    latency_s = found.pop("latency_s", robot.latency_s)
    of_wire = {name: value for name, value in found.items() if name in ("gain_translation", "play_mm")}
    return replace(robot, latency_s=latency_s, wire=replace(robot.wire, **of_wire))


def _slack(of: Prepared, found: Sequence[EpisodeReplay]) -> Float[np.ndarray, "episodes tips"]:
    """Return how much farther than its proximal end each tip went in the rod core, mm; NaN beyond an episode's tips."""
    slack = np.full(of.abscissa.shape, np.nan)
    for row, each in zip(slack, found, strict=True):
        row[: len(each.driven)] = each.abscissa[:, 1] - each.driven
    return slack


def fit_wire(
    of: Prepared, device: Wire, robot: RobotConfig, config: CalibrateConfig
) -> tuple[Candidates, Float[np.ndarray, "units"]]:
    """Return candidates of `WIRE`, by how far simulated tips are from real ones, and what the wire as known costs."""

    def costs(values: Float[np.ndarray, "candidates parameters"]) -> Float[np.ndarray, "candidates units"]:
        rows = []
        for row in values:
            rows.append(_wire_costs(of, *with_found(device, robot, dict(zip(WIRE, row.tolist(), strict=True))), config))
            advance(1)
        return np.array(rows) @ of_unit

    first, draws, of_unit = config.wires // 2, config.wires // 4, np.eye(_units(of).max() + 1)[_units(of)]
    advance: Advance
    with progress("Fitting the wire", total=first + 2 * draws) as advance:
        tried = search(costs, WIRE, first=first, rounds=2, draws=draws, seed=config.seed)
    return tried, _wire_costs(of, device, robot, config) @ of_unit


def _wire_costs(
    of: Prepared, device: Wire, robot: RobotConfig, config: CalibrateConfig
) -> Float[np.ndarray, "episodes"]:
    """Return what a wire costs in each episode."""
    found = replay_prepared(of, Stack(device), robot, ReplayConfig(given=config.given))
    return np.array([_cost(each, robot) for each in found])


def _cost(episode: EpisodeReplay, robot: RobotConfig) -> float:
    """Return what a wire costs in an episode: errors of the tip, and of the drive's force where it was measured."""
    tip = float(np.minimum(episode.core_mm, FAR_MM).mean()) / _TYPICAL_MM
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
    behind = robot.wire.transmission
    if twist := found.get("twist_friction_n_mm_mm"):
        behind = Transmission(length_mm=behind.length_mm or _BEHIND_MM, twist_friction_n_mm_mm=twist)
    play_rad, grip_n = found.get("play_rad", robot.wire.play_rad), found.get("grip_n", robot.wire.grip_n)
    return wire, replace(robot, wire=replace(robot.wire, play_rad=play_rad, grip_n=grip_n, transmission=behind))


def where_encoders_sit(episodes: Sequence[RobotLog], robot: RobotConfig) -> str | None:
    """Return "motor" if the wire's encoders follow its commands, "wire" if gain and play too; None without readings."""
    far, drive, late = [], robot.wire, np.full(2, robot.latency_s)
    gain, play = np.array([[1.0, drive.gain_translation], [0.0, drive.play_mm]])
    for log in episodes:
        read = np.isfinite(log.encoders[:, 0, 0])
        if read.sum() > 1:
            course, at_s = Courses.of([log], drive), (log.time_s[read] - log.time_s[0])[None]
            motion = course.followed(0, at_s=at_s, latency_s=late, gain=gain, play=play)[:, 0]
            far.append(np.std(log.encoders[read, 0, 0] - motion, axis=1))
    return ("motor", "wire")[int(np.argmin(np.median(far, axis=0)))] if far else None


def bands(errors: Float[np.ndarray, "episodes"], logs: Sequence[str]) -> tuple[float | None, float | None]:
    """Return half-widths that hold throughout nine of ten episodes, of another log and of one more of these, mm, by the
    largest error of Δtip in each episode and the name of its log; None where there are too few logs, or episodes.

    The logarithm of an error is its log's median and a rest, which is drawn from all rests, each log counting the same.
    A log that is not known yet adds the variance between logs, by Student's t.
    """
    size, log = np.log(np.maximum(errors, 1e-6)), np.unique(np.asarray(logs), return_inverse=True)[1]
    count = np.bincount(log)
    middle = np.array([np.median(size[log == k]) for k in range(len(count))])
    rest, weight = size - middle[log], 1 / count[log]

    def width(more: Float[np.ndarray, "draws"]) -> float:
        drawn = (rest[:, None] + more).ravel()
        order, weights = np.argsort(drawn), np.repeat(weight, len(more))
        at = np.searchsorted(np.cumsum(weights[order]), _LEVEL * (1 + 1 / len(size)) * weights.sum())
        return math.exp(middle.mean() + drawn[order[min(at, len(order) - 1)]])

    one_more = width(np.zeros(1)) if len(size) + 1 >= 1 / (1 - _LEVEL) else None
    if len(count) < _LEAST_LOGS or one_more is None:
        return None, one_more
    own = np.pi / 2 * np.bincount(log, rest**2) / count**2  # variance of a median
    between = max(0.0, float(middle.var(ddof=1) - own.mean()))
    t = stdtrit(len(count) - 1, (np.arange(200) + 0.5) / 200)
    return max(one_more, width(t * math.sqrt(between * (1 + 1 / len(count))))), one_more


def left_out_share(errors: Float[np.ndarray, "episodes"], logs: Sequence[str]) -> float | None:
    """Return in which share of the episodes the band holds that is made of all other logs; None where none is."""
    of, held = np.asarray(logs), []
    for name in dict.fromkeys(logs):
        width, _ = bands(errors[of != name], of[of != name].tolist())
        held += [] if width is None else (errors[of == name] <= width).tolist()
    return float(np.mean(held)) if held else None


def worst(replays: Sequence[EpisodeReplay], *, alone: bool) -> Float[np.ndarray, "episodes"]:
    """Return the largest error of Δtip in what was predicted of each episode, mm, by the drive alone or the core."""
    made = [each.driven if alone else each.abscissa[:, 1] for each in replays]
    return np.array([np.abs(e.abscissa[:, 0] - own)[~e.given].max() for e, own in zip(replays, made, strict=True)])


def _units(of: Prepared) -> Int[np.ndarray, "episodes"]:
    """Return what each episode counts to: its log where there are enough, for logs differ more than their episodes."""
    names = [log.name for log in of.logs]
    logs = list(dict.fromkeys(names))
    return np.array([logs.index(name) for name in names]) if len(logs) >= _LEAST_LOGS else np.arange(len(names))
