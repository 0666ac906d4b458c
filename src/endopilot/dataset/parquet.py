"""The Parquet files of a dataset: trajectories to tables, tables to files and back, and statistics over all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from endopilot.dataset import schema
from endopilot.errors import InputError
from endopilot.files import regular, write_whole
from endopilot.progress import Advance
from endopilot.simulation.trajectory import Trajectory, trajectory_signals

_KEY = b"endopilot_key"
_LEVEL = 5  # of Zstandard; higher ones take longer and save next to nothing
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)  # those that LeRobot 0.4 normalises by
_FEW_VALUES = {"timestamp"}  # columns that repeat their values: a dictionary is the smallest


def sample_columns(trajectory: Trajectory, first_episode: int) -> dict[str, pa.Array]:
    """Return the columns of a trajectory's samples, one episode after the other."""
    worlds, samples = trajectory.valid.shape
    signals = trajectory_signals(trajectory)
    columns = {
        "index": first_episode * samples + np.arange(worlds * samples),
        "episode_index": np.repeat(first_episode + np.arange(worlds), samples),
        "frame_index": np.tile(np.arange(samples), worlds),
        "task_index": np.zeros(worlds * samples, dtype=np.int64),
        # LeRobot's clock starts at 0 with the first recorded sample.
        "timestamp": np.tile(np.arange(samples) * trajectory.period_s, worlds),
        "action": trajectory.command,
        "velocity": trajectory.control,
        "observation.state": np.stack([signals[name] for name in schema.STATE], axis=-1),
        **{own: signals[name] for own, (name, *_) in schema.OWN_COLUMNS.items()},
    }
    columns |= trajectory.columns
    by_robot = set(schema.OF_ROBOT) <= set(trajectory.columns)
    described = schema.features(trajectory.set_up.actuation, trajectory.devices, by_robot=by_robot)
    kinds = {name: (described[name]["dtype"], described[name]["names"]) for name in columns if name in described}
    return {name: column(columns[name], *kind) for name, kind in kinds.items()}


def write_tables(
    folder: Path, number: int, key: str, *, episodes: Mapping[str, Any], samples: Mapping[str, Any]
) -> None:
    """Write the files of the `number`-th block of episodes: its episodes, then its samples, which mark both as whole;
    both are marked with the dataset's key."""
    samples_path, episodes_path = schema.paths_of_file(folder, number)
    for path, columns in ((episodes_path, episodes), (samples_path, samples)):
        table = pa.table(dict(columns)).replace_schema_metadata({_KEY: key.encode()})
        write_whole(path, _parquet_bytes(table))


def _parquet_bytes(table: pa.Table) -> bytes:
    """Return a table as a Parquet file in memory, so that a full disk shows as an ordinary OSError on writing."""
    sink = pa.BufferOutputStream()
    floats = {
        field.name for field in table.schema if pa.float32() in (field.type, getattr(field.type, "value_type", None))
    } - _FEW_VALUES
    counters = {name for name in ("index", "episode_index") if name in table.column_names}
    leaf = {name: name if table.schema.field(name).type == pa.float32() else f"{name}.list.element" for name in floats}
    write: Any = pq.write_table  # whose types do not know lists of columns
    write(
        table,
        sink,
        compression="zstd",
        compression_level=_LEVEL,
        use_dictionary=[name for name in table.column_names if name not in floats | counters],
        # Bytes of like significance side by side compress best; counters by their differences.
        column_encoding={leaf[name]: "BYTE_STREAM_SPLIT" for name in floats}
        | dict.fromkeys(counters, "DELTA_BINARY_PACKED"),
        write_statistics=list(schema.INDEX_COLUMNS),
    )
    return sink.getvalue().to_pybytes()


def read_table(path: Path, key: str) -> pa.Table:
    """Read a Parquet file that has this key; InputError for another's, another version's or a damaged one."""
    try:
        table = pq.ParquetFile(regular(path)).read()
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


def read_tables(paths: Sequence[Path], key: str) -> pa.Table:
    """Read Parquet files of one dataset as one table."""
    return pa.concat_tables([read_table(path, key) for path in paths])


def column_values(table: pa.Table, name: str) -> np.ndarray:
    """Return a column as an array, (rows,) for scalars and (rows, components) for vectors."""
    values = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(values.type):
        return values.flatten().to_numpy(zero_copy_only=False).reshape(len(values), -1)
    return values.to_numpy(zero_copy_only=False)


def statistics(
    described: Mapping[str, Any], paths: Iterable[Path], key: str, advance: Advance
) -> tuple[dict[str, dict[str, list[float]]], dict[str, float]]:
    """Return the content of `meta/stats.json` (min, max, mean, std, count and quantiles of every numeric signal's valid
    samples), and the share of each of the wire's manoeuvres in what was driven."""
    sums, count, driven = Sums(), 0, np.zeros(len(schema.MANOEUVRES))
    for path in paths:
        table = read_table(path, key)
        valid = column_values(table, "valid")
        count += int(valid.sum())
        velocity = column_values(table, "velocity" if "velocity" in described else "action")[valid]
        driven += np.bincount(schema.manoeuvres(velocity), minlength=len(driven))
        for name in schema.signals_in(described):
            if described[name]["dtype"] != "bool" and valid.any():
                sums.add(name, column_values(table, name)[valid])
        advance()
    return sums.stats(), dict(zip(schema.MANOEUVRES, (driven / max(count, 1)).tolist(), strict=True))


class Sums:
    """What the statistics of columns are made of, part by part; quantiles are the mean of the parts', as LeRobot's."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[int, list[np.ndarray]]] = {}

    def add(self, name: str, values: np.ndarray) -> None:
        """Take values of a column, a row a sample."""
        rows = values.astype(np.float64).reshape(len(values), -1)
        parts = [rows.min(axis=0), rows.max(axis=0), rows.sum(axis=0), (rows**2).sum(axis=0)]
        parts.append(len(rows) * np.quantile(rows, _QUANTILES, axis=0))
        count, before = self._of.get(name, (0, None))
        if before is not None:
            joined = (np.minimum, np.maximum, np.add, np.add, np.add)
            parts = [join(*pair) for join, *pair in zip(joined, before, parts, strict=True)]
        self._of[name] = count + len(rows), parts

    def stats(self) -> dict[str, dict[str, list[float]]]:
        """Return min, max, mean, std, count and quantiles of each column."""
        return {
            name: {
                "min": low.tolist(),
                "max": high.tolist(),
                "mean": (total / count).tolist(),
                "std": np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0)).tolist(),
                "count": [count],
                **{f"q{100 * q:02.0f}": each.tolist() for q, each in zip(_QUANTILES, sums / count, strict=True)},
            }
            for name, (count, (low, high, total, squares, sums)) in self._of.items()
        }


def column(values: np.ndarray, dtype: str, names: list[str] | None) -> pa.Array:
    """Return values as a column of a type, with a vector a row if its components have names."""
    flat = pa.array(np.ascontiguousarray(values, dtype=dtype).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, len(names)) if names else flat
