"""The same work on a Dask cluster: same bits, also where a worker dies, and one line where there is no cluster."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_generate import data_hashes

from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.workers import run_on_cluster
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import read_json
from toy_navigation import make_toy_dataset, write_toy_anatomies

HAS_DASK = importlib.util.find_spec("distributed") is not None
needs_dask = pytest.mark.skipif(not HAS_DASK, reason="distributed is not installed: pip install 'endopilot[cluster]'")
SETTINGS = {"sequences": 20, "sequences_per_file": 5}

WORKER = f"""
import sys, time; sys.path[:0] = {sys.path!r}
import toy_navigation
from unittest.mock import patch
def slowly(*args, **kwargs):
    time.sleep(0.3)
    return toy_navigation.toy_simulate(*args, **kwargs)
if __name__ == "__main__":
    from distributed.cli.dask_worker import main
    with patch("endopilot.dataset.workers.simulate_navigations", toy_navigation.toy_navigate(slowly)):
        main([sys.argv[1], "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", sys.argv[2]])
"""


def run(*arguments: str | Path) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )


@needs_dask
def test_a_cluster_gives_the_same_bits_though_a_worker_dies(tmp_path, monkeypatch):
    import distributed

    make_toy_dataset(tmp_path / "here", patients=3, **SETTINGS)
    (tmp_path / "worker.py").write_text(WORKER)
    scheduler_file = tmp_path / "scheduler.json"
    arguments = ("--port", "0", "--no-dashboard", "--scheduler-file", scheduler_file, "--host", "127.0.0.1")
    processes = [run("-m", "distributed.cli.dask_scheduler", *arguments)]
    try:
        deadline = time.monotonic() + 120
        while not scheduler_file.exists():
            assert processes[0].poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        address = read_json(scheduler_file)["address"]
        processes += [run(tmp_path / "worker.py", address, tmp_path / f"space-{k}") for k in range(2)]
        with distributed.Client(address) as client:
            client.wait_for_workers(2, timeout=120)
        killed = []

        def kill_one(work, items, done, scheduler):
            def killing(block, seconds):
                if not killed:
                    processes[1].kill()
                    killed.append(block)
                done(block, seconds)

            run_on_cluster(work, items, killing, scheduler)

        monkeypatch.setattr("endopilot.dataset.generate.run_on_cluster", kill_one)
        config = DatasetConfig(anatomy_shares=(2 / 3, 0.0, 1 / 3), **SETTINGS)
        folders = write_toy_anatomies(tmp_path / "anatomies", 3)
        generate_dataset(
            folders, output=tmp_path / "there", device=read_wire("workhorse-014"), config=config, scheduler=address
        )
        assert killed
        assert processes[1].wait(timeout=60) != 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert data_hashes(tmp_path / "there") == data_hashes(tmp_path / "here")


@needs_dask
def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("endopilot.dataset.workers._CONNECT_TIMEOUT_S", 1)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9 cannot be reached"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"endopilot\[cluster\]"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")
