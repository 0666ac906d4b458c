"""Several datasets as one: `read_joined`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.errors import InputError

_DRIVE = ("max_velocity_mm_s", "max_rotation_rad_s", "push_limit_n", "pull_limit_n", "torque_limit_n_mm")
_OTHER = ("name", "friction", "tip_load_n", "tip_shaping", "sources", *_DRIVE)
"""What does not make another wire: names and sources, limits of the drive, and friction, which is the navigation's."""


def read_joined(folders: Sequence[Path]) -> Dataset:
    """Read datasets as one: the first one, with the episodes of the others behind its own.

    A patient that the first dataset holds keeps the split that it has there, so nothing that is kept for a test is
    trained on.

    Args:
        folders: of the datasets, made with the same devices and with episodes of one length.

    Raises:
        InputError: none is given; one cannot be read, was made with another wire or other catheters, has episodes of
            another length, or has another patient of the same name, or the same one who moves otherwise.
    """
    if not folders:
        raise InputError("dataset: none given; name at least one folder made by `endopilot dataset`")
    first, *others = (read_dataset(folder) for folder in folders)
    for other in others:
        first = _joined(first, other)
    return first


def _joined(first: Dataset, other: Dataset) -> Dataset:
    _check_alike(first, other)
    home = dict(zip(first.anatomy.tolist(), first.split.tolist(), strict=True))
    held = {name: split if split in ("calibrate", "test") else None for name, split in home.items()}
    split = [held.get(name) or own for name, own in zip(other.anatomy.tolist(), other.split.tolist(), strict=True)]
    other = replace(other, split=np.array(split))
    records = {record["name"]: record for record in first.manifest["anatomies"]}
    for record in other.manifest["anatomies"]:
        folder = (other.folder / record["folder"]).resolve()
        records.setdefault(record["name"], record | {"folder": os.path.relpath(folder, first.folder.resolve())})
    keys = [first.manifest["key"], other.manifest["key"]]
    manifest = first.manifest | {
        "key": hashlib.sha256("".join(keys).encode()).hexdigest(),
        "anatomies": list(records.values()),
        "world": ours if (ours := first.manifest.get("world", {})) == other.manifest.get("world", {}) else None,
    }
    names = [field.name for field in fields(Dataset) if field.name not in ("folder", "manifest", "sample_period_s")]
    pairs = {name: (getattr(first, name), getattr(other, name)) for name in names}
    # where one of them has no robot, neither has what it measured
    arrays = {
        name: np.concatenate(pair) if all(isinstance(part, np.ndarray) for part in pair) else None
        for name, pair in pairs.items()
    }
    return replace(first, manifest=manifest, **arrays)


def _check_alike(first: Dataset, other: Dataset) -> None:
    ours, theirs = first.manifest["device"], other.manifest["device"]
    for name in ours.keys() - set(_OTHER):
        if not np.array_equal(ours[name], theirs[name]):
            raise InputError(
                f"{other.folder}: its wire is {theirs['name']}, and that of {first.folder} is {ours['name']}, with "
                f"another {name}; join datasets of one wire"
            )
    if first.stack.catheters != other.stack.catheters:
        around = [", ".join(each.name for each in data.stack.catheters) or "no catheter" for data in (other, first)]
        raise InputError(
            f"{other.folder}: its wire lies in {around[0]}, and that of {first.folder} in {around[1]}; join datasets "
            "of the same devices"
        )
    length, other_length = (dataset.valid.shape[1] * dataset.sample_period_s for dataset in (first, other))
    if length != other_length:
        raise InputError(
            f"{other.folder}: episodes of {other_length:g} s, and those of {first.folder} take {length:g} s; "
            f"make it with --seconds {length:g}"
        )
    for name in first.patients.keys() & other.patients.keys():
        if first.patients[name] != other.patients[name]:
            raise InputError(f"{other.folder}: its patient {name} is another than that of {first.folder}; rename one")
        if first.motion(name) != other.motion(name):
            raise InputError(
                f"{other.folder}: its patient {name} moves otherwise than in {first.folder}; join datasets of other "
                "patients, or of one motion"
            )
