"""The same work on a Dask cluster: same bits, and one line where there is no cluster."""

from __future__ import annotations

import sys

import pytest
from test_generate import data_hashes

from endopilot.errors import InputError
from toy_navigation import make_toy_dataset

SETTINGS = {"patients": 3, "sequences": 20, "sequences_per_file": 5}


def test_a_cluster_gives_the_same_bits(tmp_path):
    distributed = pytest.importorskip("distributed", reason="pip install 'endopilot[cluster]'")
    make_toy_dataset(tmp_path / "here", **SETTINGS)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, local_directory=tmp_path / "space"
    ) as cluster:
        make_toy_dataset(tmp_path / "there", scheduler=cluster.scheduler_address, **SETTINGS)
    assert data_hashes(tmp_path / "there") == data_hashes(tmp_path / "here")


def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="pip install 'endopilot[cluster]'")
    monkeypatch.setattr("endopilot.dataset.generate._CONNECT_TIMEOUT_S", 1)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9 cannot be reached"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"endopilot\[cluster\]"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")
