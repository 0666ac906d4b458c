"""The columns of a dataset on disk: LeRobot v3, with what a guidewire adds.

The layout is that of `LeRobotDataset` v3.0 (https://huggingface.co/docs/lerobot/lerobot-dataset-v3): samples of many
episodes in one Parquet file, an episode table that says where each lies, and JSON files that describe both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from endopilot.errors import InputError
from endopilot.progress import Advance
from endopilot.types import SAMPLE_PERIOD_S, Rollout

LEROBOT_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO_PATH = "meta/info.json"
STATS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
MANIFEST_PATH = "meta/manifest.json"
TASK = "random navigation"
_KEY = b"endopilot_key"

INDEX_COLUMNS = ("index", "episode_index", "frame_index", "task_index")
"""Integer columns that LeRobot asks for; `timestamp` (s, float32) is the fifth."""

SIGNALS: dict[str, tuple[str, list[str] | None]] = {
    "action": ("float32", ["translation_mm_s", "rotation_rad_s"]),
    "observation.state": ("float32", ["inserted_length_mm", "rotation_rad", "tip_abscissa_mm", "tip_offset_mm"]),
    "tip_position_mm": ("float32", ["x", "y", "z"]),
    "tip_direction": ("float32", ["x", "y", "z"]),
    "branch": ("int64", None),
    "lumen_radius_mm": ("float32", None),
    "contact_force_max_n": ("float32", None),
    "contact_force_sum_n": ("float32", None),
    "base_force_n": ("float32", None),
    "base_torque_nmm": ("float32", None),
    "valid": ("bool", None),
}
"""Name of each simulated column, its type, and the names of its components if it is a vector."""


def features() -> dict[str, dict[str, Any]]:
    """Return the `features` entry of `meta/info.json`: type, shape and component names of every column."""
    described = {"timestamp": {"dtype": "float32", "shape": [1], "names": None}}
    described |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in INDEX_COLUMNS}
    for name, (dtype, names) in SIGNALS.items():
        described[name] = {"dtype": dtype, "shape": [len(names) if names else 1], "names": names}
    return described


def paths_of_file(folder: Path, number: int) -> tuple[Path, Path]:
    """Return the data file and the episode file that hold the `number`-th block of episodes."""
    chunk, file = divmod(number, FILES_PER_CHUNK)
    where = {"chunk_index": chunk, "file_index": file}
    return folder / DATA_PATH.format(**where), folder / EPISODES_PATH.format(**where)


def sample_table(rollout: Rollout, first_episode: int, key: str) -> pa.Table:
    """Return the samples of a rollout as rows, one episode after the other.

    Args:
        rollout: one world for each episode.
        first_episode: index in the dataset of the rollout's first world.
        key: marks the dataset that the file belongs to.
    """
    worlds, samples = rollout.valid.shape
    state = (rollout.inserted_length, rollout.rotation, rollout.tip.abscissa, rollout.tip.offset)
    columns = {
        "index": first_episode * samples + np.arange(worlds * samples),
        "episode_index": np.repeat(first_episode + np.arange(worlds), samples),
        "frame_index": np.tile(np.arange(samples), worlds),
        "task_index": np.zeros(worlds * samples, dtype=np.int64),
        # LeRobot's clock starts at 0 with the first recorded sample.
        "timestamp": np.tile(np.arange(samples) * rollout.sample_period_s, worlds),
        "action": rollout.control,
        "observation.state": np.stack(state, axis=-1),
        "tip_position_mm": rollout.tip_position,
        "tip_direction": rollout.tip_direction,
        "branch": rollout.tip.branch,
        "lumen_radius_mm": rollout.tip.radius,
        "contact_force_max_n": rollout.contact_force_max,
        "contact_force_sum_n": rollout.contact_force_sum,
        "base_force_n": rollout.base_force,
        "base_torque_nmm": rollout.base_torque,
        "valid": rollout.valid,
    }
    arrays = {name: _column(name, values) for name, values in columns.items()}
    return pa.table(arrays).replace_schema_metadata({_KEY: key.encode()})


def episode_table(columns: Mapping[str, Any], key: str) -> pa.Table:
    """Return rows of the episode table, marked with the dataset's key."""
    return pa.table(dict(columns)).replace_schema_metadata({_KEY: key.encode()})


def parquet_bytes(table: pa.Table) -> bytes:
    """Return a table as a Parquet file in memory, so that a full disk shows as an ordinary OSError on writing."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def read_table(path: Path, key: str) -> pa.Table:
    """Read a Parquet file of the dataset that has this key.

    Raises:
        InputError: the file is missing or damaged, or belongs to another dataset or version.
    """
    try:
        table = pq.ParquetFile(path).read()
    except FileNotFoundError as error:
        raise InputError(f"{path}: missing from the dataset; run the same `endopilot dataset` command again") from error
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: damaged ({error}); delete it and run `endopilot dataset` again") from error
    if (table.schema.metadata or {}).get(_KEY) != key.encode():
        raise InputError(
            f"{path}: written by another version or with other settings than the rest of the dataset; "
            "delete it and run `endopilot dataset` again"
        )
    return table


def column_values(table: pa.Table, name: str) -> np.ndarray:
    """Return a column as an array, (rows,) for scalars and (rows, components) for vectors."""
    column = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


def info(episodes: int, samples_per_episode: int) -> dict[str, Any]:
    """Return the content of `meta/info.json`.

    LeRobot's `splits` are ranges of episodes, which ours are not: they stand in the episode table, column `split`.
    """
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": "endovascular guidewire",
        "total_episodes": episodes,
        "total_frames": episodes * samples_per_episode,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "fps": round(1 / SAMPLE_PERIOD_S),
        "splits": {},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features(),
    }


def statistics(paths: Iterable[Path], key: str, advance: Advance) -> dict[str, dict[str, list[float]]]:
    """Return the content of `meta/stats.json`: min, max, mean, std and count of every numeric signal's valid samples.

    Args:
        paths: the data files.
        key: key of the dataset.
        advance: called once for each file that has been read.
    """
    sums: dict[str, list[np.ndarray]] = {}
    count = 0
    for path in paths:
        table = read_table(path, key)
        valid = column_values(table, "valid")
        count += int(valid.sum())
        for name, (dtype, _) in SIGNALS.items():
            if dtype == "bool" or not valid.any():
                continue
            values = column_values(table, name)[valid].astype(np.float64).reshape(int(valid.sum()), -1)
            parts = [values.min(axis=0), values.max(axis=0), values.sum(axis=0), (values**2).sum(axis=0)]
            before = sums.get(name, parts)
            sums[name] = (
                parts
                if before is parts
                else [
                    np.minimum(before[0], parts[0]),
                    np.maximum(before[1], parts[1]),
                    before[2] + parts[2],
                    before[3] + parts[3],
                ]
            )
        advance()
    return {
        name: {
            "min": low.tolist(),
            "max": high.tolist(),
            "mean": (total / count).tolist(),
            "std": np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0)).tolist(),
            "count": [count],
        }
        for name, (low, high, total, squares) in sums.items()
    }


def _column(name: str, values: np.ndarray) -> pa.Array:
    dtype, names = SIGNALS.get(name, ("float32" if name == "timestamp" else "int64", None))
    flat = pa.array(np.ascontiguousarray(values, dtype=dtype).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, len(names)) if names else flat
