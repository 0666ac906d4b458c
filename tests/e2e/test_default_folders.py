"""Commands that keep results keep them apart: each default folder belongs to one command."""

from __future__ import annotations

import pytest
from command import run

from benchmarks.__main__ import main as benchmarks
from benchmarks.core import robustness
from endopilot import runs
from endopilot.cli import main
from endopilot.ladder import mismatch

LADDER = ("ladder", "--mismatch", "0.2", "--policy", "forward", "--tasks", "straight", "--patients", "1")
BENCH = ("robustness", "--rollouts", "1", "--anatomies", "1", "--seconds", "5", "--threads", "1")


def here(title, items, work, pool):
    """Do the work in this process."""
    for item in items:
        work(item)
    return {}


@pytest.mark.parametrize("order", [(LADDER, BENCH), (BENCH, LADDER)], ids=["ladder first", "benchmark first"])
def test_the_ladder_with_a_model_mismatch_and_the_robustness_benchmark_run_one_after_the_other(
    tmp_path, monkeypatch, capsys, order
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mismatch, "CASES", ("matched",))
    monkeypatch.setattr(runs, "each", here)
    monkeypatch.setattr(robustness, "MOST_PENETRATION_MM", 1.0)  # what is measured is not judged here
    for line in (*order, *order):  # and again, where each goes on in its own folder
        assert run(capsys, *line, command=benchmarks if line is BENCH else main)
    found = {str(path.parent.relative_to(tmp_path)) for path in tmp_path.rglob("run.json")}
    assert found == {"runs/ladder-mismatch/forward", "runs/bench-robustness"}
