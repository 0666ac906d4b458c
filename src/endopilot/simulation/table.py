"""Rollouts as tables, for people and for other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import writing
from endopilot.simulation.motion import place
from endopilot.types import Rollout


def rollout_table(rollout: Rollout) -> pd.DataFrame:
    """Return one row for each world and sample; column names end in their units where they have one."""
    worlds, samples = rollout.valid.shape
    time = (np.arange(samples) + 1) * rollout.sample_period_s
    columns = {
        "world": np.repeat(np.arange(worlds), samples),
        "time_s": np.tile(time, worlds),
        "translation_mm_s": rollout.control[..., 0],
        "rotation_rad_s": rollout.control[..., 1],
        "inserted_length_mm": rollout.inserted_length,
        "rotation_rad": rollout.rotation,
        "tip_abscissa_mm": rollout.tip.abscissa,
        "tip_offset_mm": rollout.tip.offset,
        "branch": rollout.tip.branch,
        "lumen_radius_mm": rollout.tip.radius,
        **{f"tip_{axis}_mm": rollout.tip_position[..., i] for i, axis in enumerate("xyz")},
        **{f"tip_direction_{axis}": rollout.tip_direction[..., i] for i, axis in enumerate("xyz")},
        "contact_force_max_n": rollout.contact_force_max,
        "contact_force_sum_n": rollout.contact_force_sum,
        "base_force_n": rollout.base_force,
        "base_torque_nmm": rollout.base_torque,
        "drive_force_n": rollout.drive_force,
        "drive_torque_nmm": rollout.drive_torque,
        "slip_mm": rollout.slip,
        "rotation_slip_rad": rollout.rotation_slip,
        "newton_iterations": rollout.iterations,
        "valid": rollout.valid,
        **_catheter_columns(rollout),
        **_laboratory_columns(rollout),
    }
    return pd.DataFrame({name: np.asarray(values).reshape(-1) for name, values in columns.items()})


def _laboratory_columns(rollout: Rollout) -> dict[str, np.ndarray]:
    """Return where the tip is in the laboratory; nothing for a vessel that lies still, whose tip is there already."""
    if rollout.vessel_to_laboratory is None:
        return {}
    maps = np.broadcast_to(rollout.vessel_to_laboratory, (*rollout.valid.shape, 3, 4))
    tip = place(maps, rollout.tip_position)
    return {f"tip_laboratory_{axis}_mm": tip[..., i] for i, axis in enumerate("xyz")}


def _catheter_columns(rollout: Rollout) -> dict[str, np.ndarray]:
    """Return the columns of each catheter, the innermost first: `catheter_1_...`; none for a wire alone."""
    motion = rollout.catheters
    if motion is None:
        return {}
    columns = {}
    for k in range(motion.rotation.shape[-1]):
        one = {
            "translation_mm_s": motion.control[:, :, k, 0],
            "rotation_rad_s": motion.control[:, :, k, 1],
            "inserted_length_mm": motion.inserted_length[:, :, k],
            "rotation_rad": motion.rotation[:, :, k],
            **{f"tip_{axis}_mm": motion.tip_position[:, :, k, i] for i, axis in enumerate("xyz")},
            "base_force_n": motion.base_force[:, :, k],
            "base_torque_nmm": motion.base_torque[:, :, k],
            "drive_force_n": motion.drive_force[:, :, k],
            "drive_torque_nmm": motion.drive_torque[:, :, k],
            "slip_mm": motion.slip[:, :, k],
            "rotation_slip_rad": motion.rotation_slip[:, :, k],
        }
        columns |= {f"catheter_{k + 1}_{name}": values for name, values in one.items()}
    return columns


def write_rollout(rollout: Rollout, path: Path) -> None:
    """Write a rollout as .parquet or .csv (one row a sample) or .npz (all arrays, wire shapes included).

    Raises:
        InputError: another suffix, or wire shapes for a table.
        ModuleNotFoundError: .parquet without the extra `learn`.
    """
    path = Path(path)
    if path.suffix not in (".parquet", ".csv", ".npz"):
        raise InputError(f"{path}: a rollout is written as .parquet, .csv or .npz; choose one of these suffixes")
    if rollout.shape is not None and path.suffix != ".npz":
        raise InputError(f"{path}: wire shapes do not fit a table; write them as .npz")
    if path.suffix == ".parquet":
        with extra_named(f"{path}"):
            pass  # with which pandas writes it
    with writing(path) as partial:
        if path.suffix == ".parquet":
            rollout_table(rollout).to_parquet(partial, index=False)
        elif path.suffix == ".csv":
            rollout_table(rollout).to_csv(partial, index=False)
        else:
            columns = {str(name): column.to_numpy() for name, column in rollout_table(rollout).items()}
            shapes = {} if rollout.shape is None else {"shape_mm": rollout.shape}
            with partial.open("wb") as stream:
                np.savez_compressed(stream, **columns, **shapes)  # pyright: ignore[reportArgumentType]
