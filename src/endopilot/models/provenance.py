"""What a run was trained on: its patients and its wire."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from endopilot.dataset.loader import Dataset, check_same_wire
from endopilot.errors import InputError
from endopilot.files import reading


def check_wire(run: Path, record: Mapping[str, Any], dataset: Dataset) -> None:
    """Check that a dataset was made with the wire that a run was trained with.

    Raises:
        InputError: it was made with another wire, or with catheters.
    """
    dataset.check_wire_alone("a model")
    with reading(run, "train anew"):
        check_same_wire(dataset, record["device"], run, "make a dataset with the run's wire")


def trained_patients(run: Path, record: Mapping[str, Any], dataset: Dataset) -> frozenset[str]:
    """Return the names of the patients of a dataset that a run was trained on.

    A patient is known by the SHA-256 of the anatomy.

    Raises:
        InputError: the run is too old to name its patients, or the dataset was made with another wire.
    """
    check_wire(run, record, dataset)
    if "patients" in record:
        return frozenset(name for name, sha in dataset.patients.items() if sha in set(record["patients"]))
    if record["config"]["model"] == "twin":
        return frozenset()
    if record.get("inputs", {}).get("dataset") == dataset.manifest["key"]:
        return frozenset(dataset.of_split("train").anatomy.tolist())
    raise InputError(
        f"{run}: does not name the patients that it was trained on, as it was made by an older version; train it again"
    )
