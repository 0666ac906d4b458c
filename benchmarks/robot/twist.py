"""What a real robot's rotation does to the tip of its wire, beside the simulated one.

The public logs (Kweon et al., IEEE Access 2021) turn the wire in steps, between advances. Of each run of equal steps
without an advance: after how many the tip first moves, and after how many it snaps over. Then, in the part of each
episode that is predicted: to which side the tip lies, and which branch it takes.

    python examples/robot_phantom_logs.py FOLDER LOGS
    endopilot anatomy FOLDER/phantom2d-occupancy-dev-0.095mm-px.vtp --scale 1 -o PHANTOM
    python -m benchmarks robot-twist --logs LOGS --anatomy PHANTOM
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.io import read_anatomy
from endopilot.devices.device import read_wire
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.robot.log import RobotLog, read_log
from endopilot.robot.replay import EpisodeReplay, replay_log, usable_episodes
from endopilot.types import Anatomy

MOVES_MM, SNAPS_MM = 0.28, 0.57
"""The tip has moved when it is so far from where the run began, and has snapped when it moves so far in one step: 3 and
6 pixels of the public logs, whose tips at rest stay within one or two."""
PASSED_MM = 2.0
"""A tip has taken a branch when it is so far beyond the fork, mm."""
FEW_MM = 0.1
"""Advance that counts as one, mm."""
FAR_MM = 10.0
"""Advance after which a wire has unwound, if it twists under friction, mm."""
_PLAY_RAD = 5.65
"""Play of the rotation that would make the tip wait as long after a reversal, 0.9 turn, rad."""
_RESAMPLES = 2000


@dataclass(frozen=True)
class Run:
    """Steps of rotation the same way, without an advance between them.

    Attributes:
        first: command that begins it.
        steps: their number.
        reverses: whether the last rotation before it was the other way, and nothing was advanced since.
        advanced_mm: way that the drive has gone to and fro since the last rotation, mm.
    """

    first: int
    steps: int
    reverses: bool
    advanced_mm: float


def rotation_runs(command: Float[np.ndarray, "commands 2"]) -> list[Run]:
    """Return the runs of rotation in the positions that a drive was sent to, mm and rad, one after the other."""
    by = np.diff(command, axis=0, prepend=command[:1])
    way = np.where(np.abs(by[:, 0]) < FEW_MM, np.sign(np.round(by[:, 1], 6)), 0).astype(int)
    runs, last, advanced, first = [], 0, 0.0, 0
    while first < len(way):
        if way[first] == 0:
            advanced += float(abs(by[first, 0]))
            first += 1
            continue
        end = first + 1
        while end < len(way) and way[end] == way[first]:
            end += 1
        runs.append(
            Run(first, end - first, reverses=bool(last == -way[first]) and advanced < FEW_MM, advanced_mm=advanced)
        )
        last, advanced, first = way[first], 0.0, end
    return runs


def steps_to(events: Iterable[tuple[int, bool]]) -> tuple[float, float, float]:
    """Return the quartiles of the steps to an event, by Kaplan and Meier; NaN where too few runs have it.

    Args:
        events: of each run its steps to the event and True, or all its steps and False if there was none.
    """
    at = np.array([(step, seen) for step, seen in events], dtype=int).reshape(-1, 2)
    left, found = 1.0, [np.nan] * 3
    for step in range(1, int(at[:, 0].max(initial=0)) + 1):
        under_way = int((at[:, 0] >= step).sum())
        left *= 1 - ((at[:, 0] == step) & (at[:, 1] == 1)).sum() / max(1, under_way)
        reached = [left <= share for share in (0.75, 0.5, 0.25)]
        found = [float(step) if np.isnan(q) and past else q for q, past in zip(found, reached, strict=True)]
    return found[0], found[1], found[2]


def tip_in_run(run: Run, at_commands: Float[np.ndarray, "commands 3"]) -> Float[np.ndarray, "seen 3"]:
    """Return where the tip was before a run and after each of its steps, as long as it was seen, mm."""
    tips = at_commands[run.first : run.first + run.steps + 1]
    unseen = ~np.isfinite(tips).all(axis=1)
    return tips[: np.argmax(unseen)] if unseen.any() else tips


def dead_bands(
    runs: Sequence[tuple[Run, Float[np.ndarray, "seen 3"]]],
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Return quartiles of the steps until the tip moves and until it snaps, and the snaps a step."""
    moves, snaps, count, steps = [], [], 0, 0
    for _, tips in runs:
        if len(tips) < 2:
            continue
        last = len(tips) - 1
        far = np.flatnonzero(np.linalg.norm(tips - tips[0], axis=1) >= MOVES_MM)
        leaping = np.linalg.norm(np.diff(tips, axis=0), axis=1) >= SNAPS_MM
        leaps = np.flatnonzero(leaping & ~np.roll(np.append(leaping, False), 1)[:-1]) + 1  # a leap may take some steps
        moves.append((int(far[0]), True) if len(far) else (last, False))
        snaps.append((int(leaps[0]), True) if len(leaps) else (last, False))
        count, steps = count + len(leaps), steps + last
    return steps_to(moves), steps_to(snaps), count / max(1, steps)


class Sides:
    """To which side of the centerline points lie, as the camera sees them."""

    def __init__(self, anatomy: Anatomy, ray: Float[np.ndarray, "3"]) -> None:
        lines = [branch.centerline.points for branch in anatomy.tree.branches]
        self._points, self._ray = np.concatenate(lines), ray
        self._along = np.concatenate([np.gradient(line, axis=0) for line in lines])
        self._nearest = KDTree(self._points)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the signed distances, mm."""
        _, at = self._nearest.query(points)
        along = self._along[at] / np.linalg.norm(self._along[at], axis=1, keepdims=True)
        return np.cross(along, points - self._points[at]) @ self._ray


def correlation(
    pairs: Sequence[tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]],
) -> tuple[float, float, float]:
    """Return the correlation of two signals over episodes, and its bounds of 95 % if episodes are drawn anew."""

    def of(chosen: Iterable[int]) -> float:
        both = np.concatenate([np.stack(pairs[k]) for k in chosen], axis=1)
        return float(np.corrcoef(both)[0, 1]) if both.shape[1] > 2 else np.nan

    random = np.random.default_rng(0)
    drawn = [of(random.integers(0, len(pairs), len(pairs)).tolist()) for _ in range(_RESAMPLES)]
    return of(range(len(pairs))), float(np.nanpercentile(drawn, 2.5)), float(np.nanpercentile(drawn, 97.5))


def passages(replay: EpisodeReplay, anatomy: Anatomy) -> list[bool]:
    """Return whether the simulated tip took the real branch in time, of each fork in two that the real one passed.

    Of the predicted part. A simulated tip that is in none of the two when the real one has passed did not take it.
    """
    branches = anatomy.tree.branches
    inside: list[set[int]] = []
    for k in range(len(branches)):
        above, at = {k}, k
        while branches[at].parent >= 0:
            at = branches[at].parent
            above.add(at)
        inside.append(above)  # branches that lead to k, and itself
    taken = []
    real, simulated = replay.branch.astype(int).T
    for fork in range(len(branches)):
        ways = [k for k in range(len(branches)) if branches[k].parent == fork]
        if len(ways) != 2:
            continue
        begins = float(branches[ways[0]].centerline.abscissa[0])
        way = np.array([next((w for w in ways if w in inside[b]), -1) if b >= 0 else -1 for b in real])
        beyond = ~replay.given & (way >= 0) & (replay.abscissa[:, 0] > begins + PASSED_MM)
        before = ~replay.given & (replay.abscissa[:, 0] < begins)
        for at in np.flatnonzero(beyond[1:] & ~beyond[:-1]) + 1:
            if not before[:at].any():
                continue
            own = next((w for w in ways if w in inside[simulated[at]]), -1)
            taken.append(bool(own == way[at]))
            break
    return taken


def at_commands(log: RobotLog, time_s: Float[np.ndarray, "tips"], tips: Float[np.ndarray, "tips 3"]) -> np.ndarray:
    """Return the tip that was seen between each command and the next one, LPS mm; NaN where none was."""
    begins = log.time_s[log.commanded]
    of: Int[np.ndarray, "tips"] = np.searchsorted(begins, time_s, side="right") - 1
    found = np.full((len(begins), 3), np.nan)
    known: Bool[np.ndarray, "tips"] = of >= 0
    found[of[known]] = tips[known]
    return found


def drive_of(turns: str, friction: float, length_mm: float) -> RobotConfig:
    """Return the measured robot with its rotation lost in twist, in play, or not at all."""
    robot, play = read_robot("kweon-2021-2d"), _PLAY_RAD if turns == "play" else 0.0
    behind = Transmission(length_mm=length_mm, twist_friction_n_mm_mm=friction) if turns == "twist" else Transmission()
    return replace(robot, wire=replace(robot.wire, play_rad=play, transmission=behind))


def bench_twist(
    *,
    logs: Path,
    anatomy: Path | None = None,
    turns: Literal["twist", "play", "none"] = "twist",
    friction: float = 3.2e-4,
    length_mm: float = 1000.0,
    tip_deg: float = 45.0,
    tip_mm: float = 8.0,
    sessions: tuple[str, ...] = (),
) -> list[dict[str, Any]]:
    """Compare what rotation does to the tip of a real robot's wire with the simulator.

    Args:
        logs: folder of logs.
        anatomy: folder made by `endopilot anatomy` of the phantom; if not given, the real wire alone is described, and
            its tip as it moves in the picture.
        turns: where rotation is lost: in a wire that twists under friction, in play of 0.9 turn, or nowhere.
        friction: torque a length of the wire in its guiding catheter, N·mm/mm.
        length_mm: of the wire there, mm.
        tip_deg: angle by which the tip of the wire is bent, degrees.
        tip_mm: length over which it is bent, mm.
        sessions: parts of the names of the logs to take; all of them if not given.

    Returns:
        A row for each log and one for all: real and simulated.
    """
    paths = [p for p in sorted(logs.glob("*.csv")) if not sessions or any(part in p.name for part in sessions)]
    if not paths:
        raise InputError(f"{logs}: no log; convert the public ones with examples/robot_phantom_logs.py")
    if anatomy is None:
        return [{"log": path.stem, **real_figures(read_log(path))} for path in paths]
    patient, robot = read_anatomy(anatomy), drive_of(turns, friction, length_mm)
    stack = Stack(read_wire("workhorse-014").shaped(tip_deg, tip_mm))
    rows, everything = [], []
    for path in paths:
        log = read_log(path)
        episodes = usable_episodes([log], patient)
        replays = replay_log([log], patient, stack, robot=robot)
        everything += list(zip(episodes, replays, strict=True))
        rows.append({"log": path.stem, **figures(everything[-len(episodes) :], patient)})
    return [*rows, {"log": "all", **figures(everything, patient)}]


def figures(of: Sequence[tuple[RobotLog, EpisodeReplay]], anatomy: Anatomy) -> dict[str, Any]:
    """Return what is compared, of some episodes and their replays."""
    real, simulated, sides, forks, turn_steps = [], [], [], [], []
    for log, replay in of:
        command = log.command[log.commanded, 0]
        step = np.abs(np.diff(command[:, 1]))
        turn_steps += (2 * np.pi / step[step > 1e-6]).tolist()
        seen, made = (at_commands(log, replay.time_s, tips) for tips in (replay.seen, replay.simulated))
        for run in rotation_runs(command):
            real.append((run, tip_in_run(run, seen)))
            simulated.append((run, tip_in_run(run, np.where(np.isfinite(seen), made, np.nan))))
        ray = np.array([0.0, 0.0, 1.0]) if log.camera is None else log.camera.rays(np.zeros((1, 2)))[1][0]
        side = Sides(anatomy, ray)
        used = ~replay.given & (replay.branch[:, 0] == replay.branch[:, 1])
        if used.any():
            sides.append((side(replay.seen[used]), side(replay.simulated[used])))
        forks += passages(replay, anatomy)
    turn = float(np.median(turn_steps)) if turn_steps else np.nan
    found: dict[str, Any] = {"episodes": len(of)}
    for name, runs in (("real", real), ("simulated", simulated)):
        found |= _dead_bands_of(name, runs, turn)
    if sides:
        r, low, high = correlation(sides)
        found["side_r"] = f"{r:.2f} [{low:.2f}, {high:.2f}]"
    found["forks"] = len(forks)
    found["real_branch"] = round(float(np.mean(forks)), 2) if forks else None
    return found


def real_figures(log: RobotLog) -> dict[str, Any]:
    """Return what rotation does to the tip of a real wire in a picture, where the vessel is not known."""
    runs, steps, episodes = [], [], 0
    for episode in log.episodes():
        if not episode.seen.any():
            continue
        command, episodes = episode.command[episode.commanded, 0], episodes + 1
        step = np.abs(np.diff(command[:, 1]))
        steps += (2 * np.pi / step[step > 1e-6]).tolist()
        seen = episode.seen
        tips = episode.tip[seen] if log.camera is None else log.camera.rays(episode.pixel[seen])[0]
        tips = at_commands(episode, episode.time_s[seen], tips)
        runs += [(run, tip_in_run(run, tips)) for run in rotation_runs(command)]
    return {"episodes": episodes} | _dead_bands_of("real", runs, float(np.median(steps)) if steps else np.nan)


def _dead_bands_of(
    name: str, runs: Sequence[tuple[Run, Float[np.ndarray, "seen 3"]]], steps_a_turn: float
) -> dict[str, Any]:
    """Return the figures of the runs of one wire."""
    reversals = [each for each in runs if each[0].reverses]
    moves, snaps, per_step = dead_bands(reversals)
    return {
        f"reversals_{name}": len(reversals),
        f"moves_after_{name}": _span(moves),
        f"snaps_after_{name}": _span(snaps),
        f"moves_after_advance_{name}": _span(dead_bands([r for r in runs if r[0].advanced_mm >= FAR_MM])[0]),
        f"snaps_a_turn_{name}": round(per_step * steps_a_turn, 2),
    }


def _span(quartiles: tuple[float, float, float]) -> str:
    low, middle, high = ("-" if np.isnan(q) else f"{q:.0f}" for q in quartiles)
    return f"{middle} ({low}-{high})"
