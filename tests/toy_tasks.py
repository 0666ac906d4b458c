"""A folder of tasks of one's own: a straight vessel, twice, with a target in each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.io import write_anatomy
from endopilot.tasks.task import Task, list_tasks
from endopilot.vessels.sources import Polylines


def own_tasks(folder: Path, **change: Any) -> Task:
    """Write the folder, and return its task as it is read; `change` replaces fields of its file, None removes them."""
    line = np.linspace([0.0, 0, 0], [0, 0, 60], 61)
    for name in ("a", "b"):
        anatomy = extract_anatomy(Polylines((line,), (np.full(61, 2.0),)), name=name)
        write_anatomy(anatomy, output=folder / "patients" / name)
    task = {
        "name": "along",
        "level": 1,
        "title": "Along a straight vessel",
        "device": "workhorse-014",
        "tip_bend_deg": 45,
        "tip_bend_mm": 3,
        "start_inserted_length_mm": 2,
        "seconds": 20,
        "force_limit_n": 0.2,
        "ladder": {"seed": 0, "numbers": [7, 3]},
        "anatomies": ["patients/a", "patients/b"],
        "targets_mm": [[0, 0.5, 20], [0, 0, 30]],
        "near_mm": 5.0,
    } | change
    kept = {name: value for name, value in task.items() if value is not None}
    (folder / "along.yaml").write_text(yaml.safe_dump(kept, sort_keys=False))
    (found,) = list_tasks(str(folder))
    return found
