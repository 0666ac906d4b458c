"""The columns of a dataset on disk: those of a guidewire in the layout of `LeRobotDataset` v3.0
(https://huggingface.co/docs/lerobot/lerobot-dataset-v3): samples of many episodes in a Parquet file, an episode table,
and JSON files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.devices.stack import column_prefixes
from endopilot.simulation.config import Actuation
from endopilot.simulation.signals import SIGNALS, UNIT_SUFFIXES, Outputs
from endopilot.types import SAMPLE_PERIOD_S

LEROBOT_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO_PATH = "meta/info.json"
STATS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
MANIFEST_PATH = "meta/manifest.json"
DESCRIPTION = (INFO_PATH, STATS_PATH, TASKS_PATH, MANIFEST_PATH)  # in the order in which they are written
TASK = "random navigation"

INDEX_COLUMNS = ("index", "episode_index", "frame_index", "task_index")  # LeRobot's; with `timestamp`, s, float32

VELOCITY = list(SIGNALS["control"].columns)
LOAD = ["drive_force_n", "drive_torque_nmm"]
STATE = ("inserted_length", "rotation", "tip_abscissa", "tip_offset")  # signals that `observation.state` is made of
_TYPES = {"slip": "float64", "rotation_slip": "float64", "tip_branch": "int64", "valid": "bool"}
"""Of columns that are not float32."""


def _own_column(name: str) -> tuple[str, tuple[str, str, list[str] | None]]:
    """Return a signal's column, the signal, the column's type, and the names of its components if it is a vector."""
    signal, kind = SIGNALS[name], _TYPES.get(name, "float32")
    if len(signal.columns) == 1:
        return signal.columns[0], (name, kind, None)
    return name + UNIT_SUFFIXES[signal.unit], (name, kind, list("xyz"))


OWN_COLUMNS = dict(
    _own_column(name)
    for name in (*(each.name for each in fields(Outputs)), "tip_branch", "tip_radius")
    if name not in STATE
)
"""Signals that have a column of their own: by the column, the signal, its type and the names of its components."""
OF_ROBOT = ("decided", "encoders", "load")  # what a dataset's robot was commanded, and what it measured
MANOEUVRES = ("insertion", "retraction", "spin", "pause")
_MOVES_MM_S, _TURNS_RAD_S = 0.1, 0.02  # below these a drive rests: mm/s, rad/s


def features(actuation: Actuation, devices: int = 1, *, by_robot: bool = False) -> dict[str, dict[str, Any]]:
    """Return the `features` entry of `meta/info.json`: type, shape and component names of every column. `action` is
    what the drives were commanded, with all digits; under force control, `velocity` is what resulted. Components of
    catheter k are named `catheter_k_...`; a robot adds `decided`, `encoders` and `load`."""
    vectors: dict[str, tuple[str, list[str] | None]] = {
        "action": ("float64", LOAD if actuation == "force" else VELOCITY),
        **({"velocity": ("float32", VELOCITY)} if actuation == "force" else {}),
        "observation.state": ("float32", [SIGNALS[name].columns[0] for name in STATE]),
    }
    if by_robot:
        vectors |= {name: ("float32", list(SIGNALS[name].columns)) for name in OF_ROBOT}
    found = {"timestamp": ("float32", None)} | dict.fromkeys(INDEX_COLUMNS, ("int64", None))
    found |= {column: (kind, _components(names, devices)) for column, (kind, names) in vectors.items()}
    for column, (name, kind, names) in OWN_COLUMNS.items():
        found[column] = (kind, _components(names, devices) if SIGNALS[name].of_devices else names)
    return {
        name: {"dtype": dtype, "shape": [len(names) if names else 1], "names": names}
        for name, (dtype, names) in found.items()
    }


def signals_in(described: Mapping[str, Any]) -> list[str]:
    """Return the columns of signals among those that `meta/info.json` describes: neither indices nor the clock."""
    return [name for name in described if name not in (*INDEX_COLUMNS, "timestamp")]


def _components(names: list[str] | None, devices: int) -> list[str] | None:
    if names is None:
        return None if devices == 1 else ["wire", *(prefix[:-1] for prefix in column_prefixes(devices)[1:])]
    return [prefix + name for prefix in column_prefixes(devices) for name in names]


def manoeuvres(velocity: np.ndarray) -> np.ndarray:
    """Return the wire's manoeuvre in each row of velocities (mm/s, rad/s), as an index of `MANOEUVRES`. A wire that
    advances is inserted, whether it turns or not; slower than 0.1 mm/s and 0.02 rad/s it rests."""
    along, turn = velocity[..., 0], np.abs(velocity[..., 1])
    return np.select([along > _MOVES_MM_S, along < -_MOVES_MM_S, turn > _TURNS_RAD_S], [0, 1, 2], 3)


def paths_of_file(folder: Path, number: int) -> tuple[Path, Path]:
    """Return the data file and the episode file that hold the `number`-th block of episodes."""
    chunk, file = divmod(number, FILES_PER_CHUNK)
    where = {"chunk_index": chunk, "file_index": file}
    return folder / DATA_PATH.format(**where), folder / EPISODES_PATH.format(**where)


def info(described: Mapping[str, Any], *, episodes: int, samples: int, tasks: int = 1) -> dict[str, Any]:
    """Return the content of `meta/info.json`. LeRobot's `splits` are ranges of episodes, which ours are not: they are
    in the episode table, column `split`."""
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": "endovascular guidewire",
        "total_episodes": episodes,
        "total_frames": samples,
        "total_tasks": tasks,
        "chunks_size": FILES_PER_CHUNK,
        "fps": round(1 / SAMPLE_PERIOD_S),
        "splits": {},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": dict(described),
    }
