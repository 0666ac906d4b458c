"""What `lerobot` itself reads of a data set, in an environment of its own: both cannot be installed in one."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

READER = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("local/endopilot", root=sys.argv[1])
row = dataset[int(sys.argv[2])]
print(json.dumps({
    "samples": len(dataset), "episodes": dataset.num_episodes, "fps": dataset.fps, "task": row["task"],
    "action": row["action"].tolist(), "state": row["observation.state"].tolist(),
    "episode": int(row["episode_index"]), "names": dataset.features["action"]["names"],
    "mean": dataset.meta.stats["action"]["mean"].tolist(),
    "images": {name: [list(row[name].shape), float(row[name].max())] for name in dataset.meta.camera_keys},
    "of_images": {name: list(dataset.meta.stats[name]["mean"].shape) for name in dataset.meta.camera_keys},
}))
"""


def read_by_lerobot(folder: Path, row: int) -> dict[str, Any]:
    """Return figures of a data set and of one of its rows; skip the test where no Python has `lerobot`."""
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("LEROBOT_PYTHON names no Python that has lerobot (see docs/concepts/dataset.md)")
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "PYTHONPATH": os.environ.get("LEROBOT_PYTHONPATH", "")}
    result = subprocess.run(
        [python, "-c", READER, str(folder), str(row)], capture_output=True, text=True, env=environment, check=False
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])
