"""The examples run as they stand; each ends in an assertion of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples"
NEEDS_MORE = {"recurrent_ppo.py", "segment_wire.py", "train_sb3.py"}
"""Examples that train for minutes, or need data or a library of their own."""
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py") if path.name not in NEEDS_MORE)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_and_its_assertion_holds(name, tmp_path):
    assert "    assert " in (FOLDER / name).read_text(encoding="utf-8")
    done = subprocess.run([sys.executable, FOLDER / name], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_there_are_examples():
    assert {"my_policy.py", "my_segmentation.py", "robot_phantom_logs.py"} <= set(EXAMPLES)
