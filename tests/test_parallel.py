"""Work on several items at once: bad input is collected, defects are raised, and no process is left behind."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from endopilot.errors import InputError
from endopilot.parallel import each


def write_process(item: Path) -> None:
    if item.name == "bad":
        raise InputError(f"{item}: bad; mend it")
    if item.name == "defect":
        raise RuntimeError("a defect")
    item.write_text(str(os.getpid()))


def test_every_item_is_worked_on_and_bad_ones_are_returned(tmp_path, in_processes):
    items = [tmp_path / name for name in ("a", "bad", "c")]
    bad = each("Test", items, write_process)
    assert list(bad) == [items[1]] and str(bad[items[1]]).endswith("mend it")
    assert {item.name for item in tmp_path.iterdir()} == {"a", "c"}
    if (os.cpu_count() or 1) > 1:
        assert str(os.getpid()) not in {item.read_text() for item in tmp_path.iterdir()}


def test_one_item_is_worked_on_here(tmp_path):
    assert each("Test", [tmp_path / "a"], write_process) == {}
    assert (tmp_path / "a").read_text() == str(os.getpid())


def test_a_defect_ends_the_work(tmp_path, in_processes):
    with pytest.raises(RuntimeError, match="a defect"):
        each("Test", [tmp_path / "defect", tmp_path / "b"], write_process)
    deadline = time.monotonic() + 20
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not multiprocessing.active_children()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be denied to a process here")
def test_cores_that_the_process_may_not_use_do_not_count():
    script = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
        "from endopilot.parallel import CORES; print(CORES)"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "1"
