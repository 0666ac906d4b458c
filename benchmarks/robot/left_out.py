"""Predict each session of a real robot's logs by what all others teach, beside simpler models.

    python examples/robot_phantom_logs.py FOLDER LOGS
    endopilot anatomy FOLDER/phantom2d-occupancy-dev-0.095mm-px.vtp --scale 1 -o PHANTOM
    python -m benchmarks robot-left-out --logs LOGS --anatomy PHANTOM

The first half of each episode says where the wire lies, the second half is predicted from its commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.figures import fill, markdown_table
from benchmarks.robot.paper_pair import States, predict_left_out
from benchmarks.robot.twist import Sides, correlation, passages
from endopilot.anatomy.io import read_anatomy
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.robot.calibrate import bands, worst
from endopilot.robot.kinematics import NAMES, fit_drive, led
from endopilot.robot.log import RobotLog, read_log
from endopilot.robot.replay import EpisodeReplay, Prepared, ReplayConfig, prepare, replay_prepared, usable_episodes
from endopilot.types import Anatomy

REVERSES_MM, TURNS_RAD = 1.0, np.pi
"""A half counts as one that reverses where the drive goes so far both ways, and as one that turns where it turns so
far."""
MODELS = ("an offset", "play alone", "kinematics", "rod core", "replay", "the paper's pair")
_RESAMPLES = 2000


@dataclass(frozen=True, eq=False)
class LeftOut:
    """An episode of a session that was left out.

    Attributes:
        log: of the episode.
        replay: by the rod core.
        along: error of Δtip by each of `MODELS`, mm, in the predicted half.
        in_plane: distance from the real tip, as the camera sees it, mm; kinematics have the tip on the centerline of
            the real branch, `replay` beside it in the core's, by what tips before were.
        reverses: whether the drive reverses in that half.
        turns: whether it turns.
        states: of the episode, as the paper's pair takes them.
    """

    log: RobotLog
    replay: EpisodeReplay
    along: dict[str, Float[np.ndarray, "tips"]]
    in_plane: dict[str, Float[np.ndarray, "tips"]]
    reverses: bool
    turns: bool
    states: States


def calibrated(logs: Sequence[RobotLog], anatomy: Anatomy, known: RobotConfig, episodes: int) -> RobotConfig:
    """Return a robot with the kinematics of logs, fitted to so many episodes at most, evenly chosen."""
    usable = usable_episodes(logs, anatomy)
    chosen = np.unique(np.linspace(0, len(usable) - 1, episodes).round().astype(int))
    of = prepare([usable[k] for k in chosen], anatomy, 0.5, known)
    names = [log.name for log in of.logs]
    unit = np.unique(names, return_inverse=True)[1]
    values = dict(zip(NAMES, fit_drive(of, unit).values.tolist(), strict=True))
    wire = replace(known.wire, gain_translation=values["gain_translation"], play_mm=values["play_mm"])
    return replace(known, latency_s=values["latency_s"], wire=wire)


def predicted(of: Prepared, robot: RobotConfig, wire: Wire) -> list[LeftOut]:
    """Predict the second halves of episodes by all models."""
    replays = replay_prepared(of, Stack(wire), robot, ReplayConfig())
    plain = replace(robot.wire, gain_translation=1.0, play_mm=0.0)
    robots = {
        "an offset": replace(robot, latency_s=0.0, wire=plain),
        "play alone": replace(robot, latency_s=0.0, wire=replace(plain, play_mm=robot.wire.play_mm)),
        "kinematics": robot,
    }
    tracks = replace(of, abscissa=np.where(of.given, of.abscissa, np.nan))
    simple = {name: led(tracks, each)[0] for name, each in robots.items()}
    at_tips = {"at_s": of.courses.seen_s, "latency_s": np.zeros(1), "gain": np.ones(1), "play": np.zeros(1)}
    drives = np.stack([of.courses.followed(axis, **at_tips)[0] for axis in (0, 1)], axis=-1)
    found = []
    for k, (log, replay) in enumerate(zip(of.logs, replays, strict=True)):
        rest, count = ~replay.given, len(replay.given)
        lines = {branch: of.anatomy.tree.path(int(branch)) for branch in np.unique(replay.branch[:, 0])}
        along = {name: np.abs(replay.abscissa[:, 0] - each[k, :count])[rest] for name, each in simple.items()}
        along["rod core"] = np.abs(np.diff(replay.abscissa, axis=1)[rest, 0])
        _, ray = log.camera.rays(np.zeros((1, 2))) if log.camera else (None, np.zeros((1, 3)))
        along["replay"] = along["kinematics"]
        in_plane = {"rod core": replay.core_mm[rest], "replay": np.linalg.norm(replay.in_view, axis=1)[rest]}
        for name, each in simple.items():
            apart = -replay.seen
            for branch, line in lines.items():
                there = replay.branch[:, 0] == branch
                on = [np.interp(each[k, :count][there], line.abscissa, column) for column in line.points.T]
                apart[there] += np.column_stack(on)
            in_plane[name] = np.linalg.norm(apart - (apart * ray).sum(axis=1, keepdims=True) * ray, axis=1)[rest]
        drive = log.command[log.commanded & (log.time_s >= replay.time_s[rest][0]), 0]
        there = [(drive[:, 0] - np.minimum.accumulate(drive[:, 0])).max(initial=0.0)]
        back = [(np.maximum.accumulate(drive[:, 0]) - drive[:, 0]).max(initial=0.0)]
        turned = float(np.ptp(drive[:, 1])) if len(drive) else 0.0
        reverses = min(there[0], back[0]) > REVERSES_MM
        place = drives[k, :count] + [replay.abscissa[0, 0] - drives[k, 0, 0], log.command[log.commanded, 0, 1][0]]
        tip = np.column_stack([replay.abscissa[:, 0], Sides(of.anatomy, _ray(log))(replay.seen)])
        states = States(log.name, tip, place, int(replay.given.sum()))
        found.append(LeftOut(log, replay, along, in_plane, bool(reverses), turned > TURNS_RAD, states))
    return found


def taught(
    logs: Sequence[RobotLog], count: int, anatomy: Anatomy, known: RobotConfig, wire: Wire, episodes: int, epochs: int
) -> list[LeftOut]:
    """Return the episodes of each session, predicted by what the next so many others in order teach."""
    found, teachers = list[LeftOut](), dict[str, list[str]]()
    for k, log in enumerate(logs):
        teachers[log.name] = [logs[(k + 1 + more) % len(logs)].name for more in range(count)]
        robot = calibrated([each for each in logs if each.name in teachers[log.name]], anatomy, known, episodes)
        found += predicted(prepare(usable_episodes([log], anatomy), anatomy, 0.5, known), robot, wire)
    pairs = predict_left_out([each.states for each in found], teachers, epochs=epochs)
    for one, made in zip(found, pairs, strict=True):
        off, name = (made - one.states.tip)[~one.replay.given], MODELS[-1]
        one.along[name], one.in_plane[name] = np.abs(off[:, 0]), np.linalg.norm(off, axis=1)
    return found


def bench_left_out(
    *,
    logs: Path,
    anatomy: Path,
    robot: str = "kweon-2021-2d",
    device: str = "workhorse-014",
    episodes: int = 96,
    sessions: tuple[str, ...] = ("2D",),
    epochs: int = 1,
    teachers: tuple[int, ...] = (),
    write: bool = False,
) -> list[dict[str, Any]]:
    """Predict each session by what all others teach, beside an offset, play alone and kinematics alone.

    Args:
        logs: folder of logs.
        anatomy: folder made by `endopilot anatomy` of the phantom.
        robot: the robot as it is known; the others' logs give its gain, play and lag.
        device: the wire, as it is shipped.
        episodes: that each calibration is fitted to at most.
        sessions: parts of the names of the logs to take.
        epochs: that the paper's forward network is trained for.
        teachers: numbers of other sessions that teach, the next ones in order, for a learning curve, in place of all.
        write: write the tables of docs/evidence/reality.md, or that of the learning curve.

    Returns:
        A row for each session and model, and for all sessions.
    """
    paths = [path for path in sorted(logs.glob("*.csv")) if any(part in path.name for part in sessions)]
    if len(paths) < 3:
        raise InputError(f"{logs}: {len(paths)} logs of {', '.join(sessions)}; a band for another one needs 3")
    patient, known, wire = read_anatomy(anatomy), read_robot(robot), read_wire(device)
    read = [read_log(path) for path in paths]
    if too_many := [count for count in teachers if not 0 < count < len(read)]:
        raise InputError(f"teachers: {too_many[0]}; there are 1 to {len(read) - 1} other sessions")

    setting = patient, known, wire, episodes, epochs
    if teachers:
        curve = [{"sessions that teach": str(count)} | _learned(taught(read, count, *setting)) for count in teachers]
        if write:
            fill("evidence/reality.md", "learning-curve", markdown_table(curve[0], (each.values() for each in curve)))
        return curve
    everything = taught(read, len(read) - 1, *setting)
    of = {log.name: [one for one in everything if one.states.session == log.name] for log in read}
    tables = []
    for name, each in of.items():
        others = [(one, other) for other, some in of.items() if other != name for one in some]
        width, _ = bands(_largest([one for one, _ in others]), [other for _, other in others])
        held = _largest(each) <= (np.inf if width is None else width)
        tables.append((name, held, _figures(each, patient)))
    tables.append(("all", np.concatenate([held for _, held, _ in tables]), _figures(everything, patient)))
    if write:
        fill("evidence/reality.md", "left-out", _table(tables))
    return [
        {"session": name, "model": model} | {key: cells[model] for key, cells in figures["errors"].items()}
        | {"band_holds": f"{held.mean():.2f} of {len(held)}"} | figures["of_the_core"]
        for name, held, figures in tables
        for model in MODELS
    ]  # fmt: skip


def _learned(of: Sequence[LeftOut]) -> dict[str, str]:
    """Return medians of the errors of what learns from other sessions, mm."""
    learned = "kinematics", "the paper's pair"
    return {
        f"{model}, {title}": _with_bounds([float(np.median(getattr(each, what)[model])) for each in of])
        for what, title in (("along", "along"), ("in_plane", "in plane"))
        for model in learned
    }


def _ray(log: RobotLog) -> Float[np.ndarray, "3"]:
    return log.camera.rays(np.zeros((1, 2)))[1][0] if log.camera else np.array([0.0, 0.0, 1.0])


def _largest(of: Sequence[LeftOut]) -> Float[np.ndarray, "episodes"]:
    """Return the largest error of kinematics in each episode, mm."""
    return worst([each.replay for each in of], alone=True)


def _figures(of: Sequence[LeftOut], anatomy: Anatomy) -> dict[str, Any]:
    """Return medians of errors in all halves and in those that reverse or turn, and which branches were taken."""
    groups: dict[str, Bool[np.ndarray, "episodes"]] = {
        "all": np.ones(len(of), dtype=bool),
        "reversing": np.array([each.reverses for each in of]),
        "turning": np.array([each.turns for each in of]),
    }
    errors: dict[str, dict[str, str]] = {}
    for what in ("along", "in_plane"):
        for group, chosen in groups.items():
            some = [each for each, takes in zip(of, chosen, strict=True) if takes]
            errors[f"{what}, {group} ({len(some)})"] = {
                model: _with_bounds([float(np.median(getattr(each, what)[model])) for each in some]) for model in MODELS
            }
    taken = [taken for each in of for taken in passages(each.replay, anatomy)]
    ends = [each.replay.branch[-1, 0] == each.replay.branch[-1, 1] for each in of]
    pairs = []
    for each in of:
        side, used = (
            Sides(anatomy, _ray(each.log)),
            ~each.replay.given & (each.replay.branch[:, 0] == each.replay.branch[:, 1]),
        )
        if used.any():
            pairs.append([side(tip[used]) for tip in (each.replay.seen, each.replay.simulated, each.replay.predicted)])
    r = [correlation([(one[0], one[k]) for one in pairs]) if pairs else (np.nan,) * 3 for k in (1, 2)]
    of_the_core = {
        "passages": f"{np.mean(taken):.2f} of {len(taken)}" if taken else "-",
        "ends_in_it": f"{np.mean(ends):.2f}",
        "side_r": "{:.2f} [{:.2f}, {:.2f}]".format(*r[0]),
        "side_r_of_replay": "{:.2f} [{:.2f}, {:.2f}]".format(*r[1]),
    }
    return {"errors": errors, "of_the_core": of_the_core}


def _with_bounds(sizes: Sequence[float]) -> str:
    """Return the median, and its bounds of 95 % if episodes are drawn anew."""
    if not sizes:
        return "-"
    drawn = np.random.default_rng(0).choice(sizes, (_RESAMPLES, len(sizes)))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return f"{np.median(sizes):.2f} [{low:.2f}, {high:.2f}]"


def _table(tables: list[tuple[str, Bool[np.ndarray, "episodes"], dict[str, Any]]]) -> list[str]:
    """Return the figures of all sessions, a row for each model."""
    _, held, figures = tables[-1]
    errors, core = figures["errors"], figures["of_the_core"]
    lines = [f"| median error, mm [95 %] | {' | '.join(errors)} |".replace("_", " "), "|---" * 7 + "|"]
    lines += [f"| {model} | {' | '.join(cells[model] for cells in errors.values())} |" for model in MODELS]
    by_session = ", ".join(f"{each.mean():.2f}" for _, each, _ in tables[:-1])
    lines += [
        "",
        "| of all sessions together | real | predicted |",
        "|---|---|---|",
        f"| the band of 90 % of the others holds throughout an episode, kinematics ({by_session} by session) | | "
        f"{held.mean():.2f} of {len(held)} |",
        f"| the real branch, of forks in two, passed in time, rod core | | {core['passages']} |",
        f"| episodes that end in the real branch, rod core | | {core['ends_in_it']} of {len(held)} |",
        f"| side of the tip, correlation, rod core | | {core['side_r']} |",
        f"| side of the tip, correlation, replay | | {core['side_r_of_replay']} |",
    ]
    return lines
