"""`lerobot` itself reads a dataset, in an environment of its own: its requirements and ours do not go together."""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from endopilot.dataset.loader import read_dataset

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
}))
"""


def test_lerobot_reads_a_dataset(toy_dataset):
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("LEROBOT_PYTHON names no Python that has lerobot (see docs/dataset.md)")
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "PYTHONPATH": os.environ.get("LEROBOT_PYTHONPATH", "")}
    result = subprocess.run(
        [python, "-c", READER, str(toy_dataset), "250"], capture_output=True, text=True, env=environment, check=False
    )
    assert result.returncode == 0, result.stderr
    read, data = json.loads(result.stdout.splitlines()[-1]), read_dataset(toy_dataset)
    assert (read["samples"], read["episodes"], read["fps"]) == (144 * 120, 144, 2)
    assert read["task"] == "random navigation"
    assert read["names"] == ["translation_mm_s", "rotation_rad_s"]
    assert read["episode"] == 2
    np.testing.assert_array_equal(np.float32(read["action"]), data.control[2, 10, 0])
    np.testing.assert_array_equal(
        np.float32(read["state"][2:]), [data.tip_abscissa[2, 10, 0], data.tip_offset[2, 10, 0]]
    )
    np.testing.assert_allclose(read["mean"], data.control.reshape(-1, 2).mean(axis=0), rtol=1e-3, atol=1e-5)
