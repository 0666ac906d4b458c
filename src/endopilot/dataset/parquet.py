"""The Parquet files of a dataset: rollouts to tables, tables to files and back, and statistics over all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from endopilot.dataset.schema import INDEX_COLUMNS, MANOEUVRES, OF_CATHETER, manoeuvres, signals
from endopilot.errors import InputError
from endopilot.progress import Advance
from endopilot.simulation.config import Actuation
from endopilot.types import CatheterMotion, Rollout, TipProjection

_KEY = b"endopilot_key"
_LEVEL = 5
"""Of Zstandard; higher ones take longer and save next to nothing."""
_FEW_VALUES = {"timestamp"}
"""Columns that repeat their values: a dictionary is the smallest."""


def sample_table(
    rollout: Rollout,
    applied: np.ndarray,
    actuation: Actuation,
    first_episode: int,
    key: str,
    catheter_tip: TipProjection | None = None,
) -> pa.Table:
    """Return the samples of a rollout as rows, one episode after the other.

    Args:
        rollout: one world for each episode.
        applied: control of each world and sample, where it is a load (N, N·mm).
        actuation: what the control is.
        first_episode: index in the dataset of the rollout's first world.
        key: marks the dataset that the file belongs to.
        catheter_tip: where the catheters' tips lie (worlds, samples, catheters), if there are any.
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
        "action": applied if actuation == "force" else rollout.control,
        "velocity": rollout.control,
        "observation.state": np.stack(state, axis=-1),
        "tip_position_mm": rollout.tip_position,
        "tip_direction": rollout.tip_direction,
        "branch": rollout.tip.branch,
        "lumen_radius_mm": rollout.tip.radius,
        "contact_force_max_n": rollout.contact_force_max,
        "contact_force_sum_n": rollout.contact_force_sum,
        "base_force_n": rollout.base_force,
        "base_torque_nmm": rollout.base_torque,
        "drive_force_n": rollout.drive_force,
        "drive_torque_nmm": rollout.drive_torque,
        "slip_mm": rollout.slip,
        "rotation_slip_rad": rollout.rotation_slip,
        "valid": rollout.valid,
    }
    count = 0
    if rollout.catheters is not None and catheter_tip is not None:
        count = rollout.catheters.rotation.shape[2]
        for k in range(count):
            _add_catheter(columns, k, rollout.catheters, catheter_tip)
        _add_exact_slip(columns, applied, rollout.sample_period_s)
    kinds = dict.fromkeys(INDEX_COLUMNS, ("int64", None)) | {"timestamp": ("float32", None)}
    kinds |= signals(actuation, count)
    arrays = {name: _column(columns[name], *kinds[name]) for name in columns if name in kinds}
    return pa.table(arrays).replace_schema_metadata({_KEY: key.encode()})


def _add_catheter(columns: dict[str, np.ndarray], k: int, motion: CatheterMotion, tip: TipProjection) -> None:
    """Add what catheter k did to the samples' columns."""
    state = (motion.inserted_length, motion.rotation, tip.abscissa, tip.offset)
    columns["action"] = np.concatenate([columns["action"], motion.control[:, :, k]], axis=-1)
    added = np.stack([values[:, :, k] for values in state], axis=-1)
    columns["observation.state"] = np.concatenate([columns["observation.state"], added], axis=-1)
    own = (
        motion.tip_position,
        tip.branch,
        motion.base_force,
        motion.base_torque,
        motion.drive_force,
        motion.drive_torque,
        motion.slip,
        motion.rotation_slip,
    )
    for name, values in zip(OF_CATHETER, own, strict=True):
        columns[f"catheter_{k + 1}_{name}"] = values[:, :, k]


def _add_exact_slip(columns: dict[str, np.ndarray], applied: np.ndarray, sample_period_s: float) -> None:
    """Put slips in place of the recorded ones that give the commands back to the bit, whatever float32 makes of motion.

    A drive that is asked to rest beside one that moves is often carried along: it then slips more than it is asked.
    """
    slip = sample_period_s * (applied - columns["action"].astype(np.float32))
    for k in range(applied.shape[2] // 2):
        prefix = f"catheter_{k}_" if k else ""
        columns[f"{prefix}slip_mm"], columns[f"{prefix}rotation_slip_rad"] = slip[..., 2 * k], slip[..., 2 * k + 1]


def episode_table(columns: Mapping[str, Any], key: str) -> pa.Table:
    """Return rows of the episode table, marked with the dataset's key."""
    return pa.table(dict(columns)).replace_schema_metadata({_KEY: key.encode()})


def parquet_bytes(table: pa.Table) -> bytes:
    """Return a table as a Parquet file in memory, so that a full disk shows as an ordinary OSError on writing."""
    sink = pa.BufferOutputStream()
    floats = {field.name for field in table.schema if _is_float(field.type)} - _FEW_VALUES
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
        write_statistics=list(INDEX_COLUMNS),
    )
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


def _is_float(kind: pa.DataType) -> bool:
    return kind == pa.float32() or (pa.types.is_fixed_size_list(kind) and kind.value_type == pa.float32())


def column_values(table: pa.Table, name: str) -> np.ndarray:
    """Return a column as an array, (rows,) for scalars and (rows, components) for vectors."""
    column = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
    return column.to_numpy(zero_copy_only=False)


def statistics(
    actuation: Actuation, paths: Iterable[Path], key: str, advance: Advance, catheters: int = 0
) -> tuple[dict[str, dict[str, list[float]]], dict[str, float]]:
    """Return the content of `meta/stats.json`, and the share of each manoeuvre in what was driven.

    The first holds min, max, mean, std and count of every numeric signal's valid samples.

    Args:
        actuation: what the dataset's control is.
        paths: the data files.
        key: key of the dataset.
        advance: called once for each file that has been read.
        catheters: their number; the manoeuvres are the wire's.
    """
    sums: dict[str, list[np.ndarray]] = {}
    count, driven = 0, np.zeros(len(MANOEUVRES))
    for path in paths:
        table = read_table(path, key)
        valid = column_values(table, "valid")
        count += int(valid.sum())
        velocity = column_values(table, "velocity" if actuation == "force" else "action")[valid]
        driven += np.bincount(manoeuvres(velocity), minlength=len(driven))
        for name, (dtype, _) in signals(actuation, catheters).items():
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
    described = {
        name: {
            "min": low.tolist(),
            "max": high.tolist(),
            "mean": (total / count).tolist(),
            "std": np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0)).tolist(),
            "count": [count],
        }
        for name, (low, high, total, squares) in sums.items()
    }
    return described, dict(zip(MANOEUVRES, (driven / max(count, 1)).tolist(), strict=True))


def _column(values: np.ndarray, dtype: str, names: list[str] | None) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values, dtype=dtype).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, len(names)) if names else flat
