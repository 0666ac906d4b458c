"""ROS bags of a robot as tables: rosbag1 (.bag), rosbag2 (a folder, .mcap or .db3).

A topic holds each part of a log (`PARTS`). ROS counts in SI units (REP 103), a log in mm and N·mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import column_prefixes
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import reading
from endopilot.simulation.csv_file import Columns

_MM = 1000.0  # in a metre
_PAIRS = ((("translation_mm", _MM), ("rotation_rad", 1.0)), (("translation_mm_s", _MM), ("rotation_rad_s", 1.0)))
PARTS: Mapping[str, tuple[tuple[tuple[str, float], ...], ...]] = {
    "command": _PAIRS,
    "encoder": ((("encoder_mm", _MM), ("encoder_rad", 1.0)),),
    "load": ((("force_n", 1.0), ("torque_nmm", _MM)),),
    "tip": ((("tip_x_mm", _MM), ("tip_y_mm", _MM), ("tip_z_mm", _MM)),),
    "episode": ((("episode", 1.0),),),
}
"""Columns of a log that a topic may give, each with what ROS's unit is multiplied by; a command is a place or, in its
second row, a velocity."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag, by its suffix or, of a folder, by what rosbag2 writes into it."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def read_bag(path: Path, topics: Sequence[str] = ()) -> Columns:
    """Return a row of a log for each message, NaN where it says nothing; times are those of the messages' headers if
    all have one, else those at which the bag got them. `topics` are PART=TOPIC, or PART=TOPIC:JOINT,JOINT with joints
    of a JointState by name, translation and then rotation, the wire first; a part of `PARTS` that is not named is
    looked for in the topic of its name. InputError for no bag, or for a topic that it lacks, names those that it
    has."""
    with extra_named(f"{path}: a ROS bag"):
        from rosbags.highlevel import AnyReader, AnyReaderError  # pyright: ignore[reportMissingImports]
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
    said: list[tuple[str, int, int, Any]] = []  # part, time by the header (0: none) and the bag, ns; its numbers
    joints: dict[str, tuple[str, list[str]]] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
            kinds = {each.topic: each.msgtype for each in bag.connections}
            joints = _asked(path, topics, kinds)
            wanted = [each for each in bag.connections if each.topic in {topic for topic, _ in joints.values()}]
            for each, received, raw in bag.messages(wanted) if wanted else ():
                message = bag.deserialize(raw, each.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                at = 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec
                with reading(path, f"give a topic that holds the numbers of a {each.msgtype}"):
                    for part in (part for part, (topic, _) in joints.items() if topic == each.topic):
                        said.append((part, at, received, _numbers(path, part, message, joints[part])))
    except (AnyReaderError, FileNotFoundError) as error:
        raise InputError(
            f"{path}: no ROS bag that can be read ({error}); give a .bag, a .mcap or rosbag2's folder"
        ) from error
    if not any(part == "command" for part, *_ in said):
        raise InputError(f"{path}: no message commands the drive; name its topic: --topics command=TOPIC")
    by_header = all(at for _, at, _, _ in said)
    said.sort(key=lambda each: each[1] if by_header else each[2])
    return _table(path, said, np.array([each[1] if by_header else each[2] for each in said]))


def _asked(path: Path, topics: Sequence[str], kinds: Mapping[str, str]) -> dict[str, tuple[str, list[str]]]:
    """Return the topic of each part, and names of joints."""
    asked = {part: (f"/{part}", list[str]()) for part in PARTS if f"/{part}" in kinds}
    listed = ", ".join(f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(kinds.items()))
    for text in topics:
        part, _, place = text.partition("=")
        topic, _, names = place.partition(":")
        if part not in PARTS or topic not in kinds:
            raise InputError(f"{path}: topics: {text!r}; give {', '.join(PARTS)}=TOPIC, of the topics {listed}")
        asked[part] = topic, names.split(",") if names else []
    if "command" not in asked:
        raise InputError(f"{path}: which topic commands the drive? Give --topics command=TOPIC, of the topics {listed}")
    return asked


def _numbers(path: Path, part: str, message: Any, place: tuple[str, list[str]]) -> tuple[int, np.ndarray]:
    """Return which row of `PARTS` a message gives, and its numbers in ROS's units."""
    topic, names = place
    if part == "episode":
        return 0, np.array([float(message.data)])
    if part == "tip":
        inner = message
        for name in ("pose", "pose", "transform", "point", "position", "translation"):  # PoseWithCovariance has two
            inner = getattr(inner, name, inner)
        return 0, np.array([inner.x, inner.y, inner.z], dtype=float)
    if hasattr(message, "name"):  # a JointState
        fields = {"command": ("position", "velocity"), "encoder": ("position",), "load": ("effort",)}[part]
        row, values = next(((k, v) for k, f in enumerate(fields) if len(v := getattr(message, f))), (0, np.zeros(0)))
        missing = [name for name in names if name not in message.name]
        if missing:
            raise InputError(f"{path}: {topic}: has no joint {missing[0]} ({', '.join(message.name)}); name others")
        return row, values[[message.name.index(name) for name in names]] if names else values
    if hasattr(message, "data"):  # an array of numbers: places
        return 0, np.array(message.data, dtype=float)
    inner = getattr(message, "twist", getattr(message, "wrench", message))
    pair = (inner.linear, inner.angular) if part != "load" else (inner.force, inner.torque)
    parts = np.array([[v.x, v.y, v.z] for v in pair], dtype=float)
    if (parts != 0).any(axis=0).sum() > 1:
        raise InputError(f"{path}: {topic}: moves along several axes; give a message with one, the wire's")
    return (1 if part == "command" else 0), parts.sum(axis=1)


def _table(path: Path, said: Sequence[tuple[str, int, int, Any]], at: np.ndarray) -> Columns:
    values: dict[str, Float[np.ndarray, "rows"]] = {"time_s": (at - at[0]) * 1e-9}
    for k, (part, _, _, (row, numbers)) in enumerate(said):
        columns = PARTS[part][row]
        if len(numbers) % len(columns) or len(numbers) == 0:
            raise InputError(
                f"{path}: {part}: {len(numbers)} numbers in a message; give {len(columns)} for each device"
            )
        names = [(p + name, scale) for p in column_prefixes(len(numbers) // len(columns)) for name, scale in columns]
        for (name, scale), number in zip(names, numbers.tolist(), strict=True):
            values.setdefault(name, np.full(len(said), np.nan))[k] = scale * number
    if "episode" in values:  # holds until the next message
        last = np.maximum.accumulate(np.where(np.isfinite(values["episode"]), np.arange(len(said)), -1))
        values["episode"] = np.where(last < 0, 0.0, values["episode"][last])
    return Columns(path, values, np.arange(1, len(said) + 1), tuple(values))
