"""What a robot logged: `RobotLog`, and its file, a table that a spreadsheet or any robot's own program writes.

A CSV file with a row for each moment at which something was commanded, read or seen; docs/concepts/calibration.md lists
its columns. A cell is empty where a row says nothing of its column.

`Courses` is what a drive makes of the commands. A command moves the drive from where it is to the commanded position by
the time of the next one, and it begins `latency` later. The device follows by `gain` and through the play, as in the
simulated robot (`through_play`). Candidates are computed side by side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.devices.robot import DriveConfig, through_play
from endopilot.devices.stack import column_prefixes
from endopilot.errors import InputError, box_text
from endopilot.robot.bag import is_bag, read_bag
from endopilot.simulation.csv_file import Columns, read_columns
from endopilot.types import VesselTree
from endopilot.xray.camera import CAMERA_FILE, Camera, points_in_vessel, read_camera

_POSITION = ("translation_mm", "rotation_rad")
_VELOCITY = ("translation_mm_s", "rotation_rad_s")
_ENCODER = ("encoder_mm", "encoder_rad")
_LOAD = ("force_n", "torque_nmm")
_TIP = ("tip_x_mm", "tip_y_mm", "tip_z_mm")
_PIXEL = ("tip_column_px", "tip_row_px")
_MOST_DEVICES = 3
_BESIDE_MM = 20.0
"""Tips of which the middle one lies farther than this from all centerlines are of another frame, or unit, mm."""


@dataclass(frozen=True, eq=False)
class RobotLog:
    """What a robot was asked for, and what was seen of its wire, a row for each moment; NaN where it says nothing.

    The command is where the drive of each device was sent to, mm and rad, or, `by_velocity`, what its velocities sum up
    to; encoders read mm and rad, loads are N and N·mm. The wire's tip was seen in space, LPS mm, or by a camera as a
    pixel, column and row, and in space once the vessel is known (`in_vessel`); `used` says whether that counts.
    """

    name: str
    time_s: Float[np.ndarray, "rows"]
    episode: Int[np.ndarray, "rows"]
    command: Float[np.ndarray, "rows devices 2"]
    encoders: Float[np.ndarray, "rows devices 2"]
    load: Float[np.ndarray, "rows devices 2"]
    tip: Float[np.ndarray, "rows 3"]
    pixel: Float[np.ndarray, "rows 2"]
    used: Bool[np.ndarray, "rows"]
    camera: Camera | None = None
    by_velocity: bool = False

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_s)

    @property
    def commanded(self) -> Bool[np.ndarray, "rows"]:
        """Rows with a command."""
        return np.isfinite(self.command[:, 0, 0])

    @property
    def seen(self) -> Bool[np.ndarray, "rows"]:
        """Rows in which the tip was seen, and is to be used."""
        return self.used & (np.isfinite(self.tip).all(axis=1) | np.isfinite(self.pixel).all(axis=1))

    def in_vessel(self, tree: VesselTree) -> RobotLog:
        """Return the log with the tip of each pixel where its ray passes nearest to a vessel's centerlines; InputError
        where half of the tips lie beside the vessel: they are of another vessel, frame or unit."""
        vessel = KDTree(tree.line.points)

        def beside_mm(tips: Float[np.ndarray, "n 3"]) -> float:
            return float(np.median(vessel.query(tips)[0])) if len(tips) else 0.0

        tip = self.tip if self.camera is None else points_in_vessel(self.camera, self.pixel, tree)
        if (away_mm := beside_mm(tip[self.seen])) > _BESIDE_MM:
            mend = "give the anatomy that the wire was driven through, and tips in its coordinates, LPS mm"
            if self.camera is not None:
                mend = f"give the anatomy that it was driven through, and its {CAMERA_FILE}"
                if beside_mm(points_in_vessel(self.camera, self.pixel[self.seen, ::-1], tree)) < _BESIDE_MM:
                    mend = "with columns and rows exchanged they are there: exchange tip_column_px and tip_row_px"
            seen = f"tips were seen at {box_text(tip[self.seen])}, half of them {away_mm:.0f} mm or more from the"
            raise InputError(f"{self.name}: {seen} vessel at {box_text(tree.line.points)}; {mend}")
        return replace(self, tip=tip)

    def episodes(self) -> Iterator[RobotLog]:
        """Yield each episode as a log of its own, in the order of time."""
        for number in dict.fromkeys(self.episode.tolist()):
            yield self.rows(self.episode == number)

    def rows(self, chosen: Bool[np.ndarray, "rows"]) -> RobotLog:
        """Return the log with some of its rows."""
        arrays = {name: value[chosen] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **arrays)

    def from_first_tip(self) -> RobotLog:
        """Return the log of one episode from the last command at or before its first tip on, or from its first command;
        velocities are summed up from there."""
        commands, seen = np.flatnonzero(self.commanded), int(np.argmax(self.seen))
        before = max(0, np.searchsorted(commands, seen, side="right") - 1)
        rest = self.rows(np.arange(len(self)) >= (commands[before] if len(commands) else 0))
        return (
            replace(rest, command=rest.command - self.command[commands[before - 1]])
            if self.by_velocity and before
            else rest
        )


def read_log(path: Path | str, *, camera: Camera | None = None, topics: Sequence[str] = ()) -> RobotLog:
    """Read a robot's log, a CSV file, or a ROS bag, of which `topics` are PART=TOPIC (`robot.bag.read_bag`). The camera
    of its pixels is that of `camera.yaml` beside it if none is given. InputError for no such table, or no camera, names
    file, row, column and mend."""
    path = Path(path)
    prefixes = column_prefixes(_MOST_DEVICES)
    of_devices = [p + name for p in prefixes for name in (*_POSITION, *_VELOCITY, *_ENCODER, *_LOAD)]
    if is_bag(path):
        table = read_bag(path, topics)
    else:
        table = read_columns(path, ["time_s"], ["episode", "flag"], sparse=[*of_devices, *_TIP, *_PIXEL])
    driven = [k for k, p in enumerate(prefixes) if {p + _POSITION[0], p + _VELOCITY[0]} & table.values.keys()]
    if 0 not in driven:
        raise InputError(
            f"{path}: is no log of a robot: column translation_mm, or translation_mm_s, is missing, where the drive is "
            f"sent; it has {', '.join(table.header[:8])}{' …' if len(table.header) > 8 else ''}"
        )
    prefixes = prefixes[: driven[-1] + 1]
    table.ascends("time_s", by="time")
    time_s, episode = table.values["time_s"], table.whole("episode")
    command = np.stack([_command(table, p, time_s, episode) for p in prefixes], axis=1)
    if not np.isfinite(command[:, 0, 0]).any():
        raise InputError(f"{path}: translation_mm: holds no command; give one")
    pixel = _group(table, "", _PIXEL)
    if np.isfinite(pixel).any() and camera is None:
        if not path.with_name(CAMERA_FILE).exists():
            raise InputError(
                f"{path}: tip_column_px: pixels need {CAMERA_FILE} beside the log; write mm_per_pixel, "
                "origin_mm, columns and rows of a camera above a plane, or a C-arm's matrix"
            )
        camera = read_camera(path.with_name(CAMERA_FILE))
    return RobotLog(
        name=path.stem,
        time_s=time_s,
        episode=episode,
        command=command,
        encoders=np.stack([_group(table, p, _ENCODER) for p in prefixes], axis=1),
        load=np.stack([_group(table, p, _LOAD) for p in prefixes], axis=1),
        tip=_group(table, "", _TIP),
        pixel=pixel,
        used=table.whole("flag") == 0,
        camera=camera if np.isfinite(pixel).any() else None,
        by_velocity=_VELOCITY[0] in table.values,
    )


def _group(table: Columns, prefix: str, names: tuple[str, ...]) -> Float[np.ndarray, "rows n"]:
    """Return columns that belong together, NaN where they are not there; all of them, or none."""
    there = [name for name in names if prefix + name in table.values]
    if there and len(there) < len(names) and names in (_TIP, _PIXEL):
        absent = next(name for name in names if name not in there)
        raise InputError(f"{table.path}: column {absent} is missing where {there[0]} is there; give all, or none")
    nothing = np.full(len(table.lines), np.nan)
    values = np.column_stack([table.values.get(prefix + name, nothing) for name in names])
    half = np.flatnonzero(np.isfinite(values).any(axis=1) & ~np.isfinite(values).all(axis=1))
    if len(half) and len(there) == len(names):
        row = int(half[0])
        name = names[int(np.argmin(np.isfinite(values[row])))]
        raise InputError(f"{table.path}: row {table.lines[row]}: {prefix}{name} is empty; give all, or none")
    return values


def _command(
    table: Columns, prefix: str, time_s: Float[np.ndarray, "rows"], episode: Int[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows 2"]:
    """Return positions that a drive was sent to; velocities are summed up from 0 at the start of each episode."""
    position, velocity = _group(table, prefix, _POSITION), _group(table, prefix, _VELOCITY)
    if np.isfinite(position).any() and np.isfinite(velocity).any():
        raise InputError(f"{table.path}: holds {prefix}translation_mm and {prefix}translation_mm_s; give one of them")
    if np.isfinite(velocity).any():
        for number in np.unique(episode):
            rows = np.flatnonzero((episode == number) & np.isfinite(velocity).all(axis=1))
            holds = np.diff(time_s[rows], append=time_s[rows[-1:]])
            position[rows] = np.cumsum(velocity[rows] * holds[:, None], axis=0)
    elif prefix + _POSITION[0] in table.values and prefix + _POSITION[1] not in table.values:
        position[:, 1] = np.where(np.isfinite(position[:, 0]), 0.0, np.nan)
    return position


@dataclass(frozen=True, eq=False)
class Courses:
    """The commands of episodes, and the times at which the tip was seen, padded to one length: times from the start of
    each episode at which the drive reaches what was commanded (`knot_s`), mm and rad from the first command, and those
    at which the tip was seen (`seen_s`), of which `seen` are no padding."""

    knot_s: Float[np.ndarray, "episodes knots"]
    command: Float[np.ndarray, "episodes knots 2"]
    seen_s: Float[np.ndarray, "episodes tips"]
    seen: Bool[np.ndarray, "episodes tips"]

    @staticmethod
    def of(episodes: Sequence[RobotLog], drive: DriveConfig) -> Courses:
        """Take them from logs of one episode each, with a command and a tip at least. A drive that is sent along by
        velocity ramps from one to the next, and stays behind by what a ramp costs; one that is sent to a position gets
        there."""
        acceleration = np.array([drive.max_acceleration_mm_s2, drive.max_acceleration_rad_s2])
        knots = max(int(log.commanded.sum()) for log in episodes) + 1
        tips = max(int(log.seen.sum()) for log in episodes)
        knot_s, command = np.zeros((len(episodes), knots)), np.zeros((len(episodes), knots, 2))
        seen_s, seen = np.zeros((len(episodes), tips)), np.zeros((len(episodes), tips), dtype=bool)
        for k, log in enumerate(episodes):
            asked, at = log.command[log.commanded, 0], log.time_s[log.commanded] - log.time_s[0]
            period = float(np.median(np.diff(at))) if len(at) > 1 else 0.1
            count, looks = len(at), log.time_s[log.seen] - log.time_s[0]
            knot_s[k, 0], knot_s[k, 1 : count + 1] = at[0], [*at[1:], at[-1] + period]
            knot_s[k, count + 1 :] = knot_s[k, count] + 1e-3 * np.arange(1, knots - count)
            place = np.concatenate([asked[:1], asked])
            if log.by_velocity:
                place[0] = 0.0
                velocity = np.diff(place, axis=0) / np.diff(knot_s[k, : count + 1])[:, None]
                change = np.diff(velocity, axis=0, prepend=0.0)
                place[1:] -= np.cumsum(change * np.abs(change) / (2 * acceleration), axis=0)
            command[k, : count + 1], command[k, count + 1 :] = place - place[0], place[-1] - place[0]
            seen_s[k, : len(looks)], seen_s[k, len(looks) :] = looks, looks[-1]
            seen[k, : len(looks)] = True
        return Courses(knot_s, command, seen_s, seen)

    def followed(
        self,
        axis: int,
        *,
        at_s: Float[np.ndarray, "episodes times"],
        latency_s: Float[np.ndarray, "candidates"],
        gain: Float[np.ndarray, "candidates"],
        play: Float[np.ndarray, "candidates"],
        start: float | Float[np.ndarray, "*candidates episodes"] = 0.0,
    ) -> Float[np.ndarray, "candidates episodes times"]:
        """Return where the device's proximal end is at times of each episode, from where it was at the first command,
        mm (axis 0) or rad (axis 1), by latency, gain, and the play that is lost where the drive reverses, in which each
        begins at `start`: -1 it was pushed last, 1 it was pulled last."""
        drive = gain[:, None, None] * self.command[None, :, :, axis]
        half = play[:, None] / 2
        ahead = np.empty_like(drive)  # of the device
        ahead[:, :, 0] = -np.clip(start, -1.0, 1.0) * half
        for k in range(1, drive.shape[2]):
            ahead[:, :, k], _ = through_play(ahead[:, :, k - 1], drive[:, :, k] - drive[:, :, k - 1], half)
        result = np.empty((len(gain), *at_s.shape))
        for e, knots in enumerate(self.knot_s):
            since = np.clip(at_s[e] - latency_s[:, None], knots[0], knots[-1])
            before = np.minimum(np.searchsorted(knots, since, side="right") - 1, len(knots) - 2)
            share = (since - knots[before]) / (knots[before + 1] - knots[before])
            left, right, led = (
                np.take_along_axis(each[:, e], at, axis=1)
                for each, at in ((drive, before), (drive, before + 1), (ahead, before))
            )
            driven = share * (right - left)
            result[:, e] = left + driven - through_play(led, driven, half)[0]
        return result
