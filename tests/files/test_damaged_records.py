"""Records of our own that were damaged since: one line that says what to make again, never a traceback."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from endopilot.dataset.loader import read_manifest
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.models.checkpoint import load_model
from endopilot.models.config import read_run
from endopilot.pipeline.study import Stages
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig
from toy_navigation import make_untrained_run

ODD = [None, [], "text", 3, True, {"a": []}]


@pytest.fixture(scope="module")
def a_run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    write_json(
        folder / "dataset" / "meta" / "manifest.json", {"key": "k", "device": asdict(read_wire("workhorse-014"))}
    )
    (folder / "run").mkdir()
    make_untrained_run(folder / "dataset", folder / "run")
    return folder / "run"


def refused(path: Path, read: Any) -> str:
    with pytest.raises(InputError) as error:
        read()
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("odd", ODD, ids=repr)
@pytest.mark.parametrize("name", ["config", "device", "networks"])
def test_a_run_whose_manifest_holds_something_else(tmp_path, a_run, name, odd) -> None:
    run = tmp_path / "run"
    shutil.copytree(a_run, run)
    record = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(record | {name: odd}))
    if name != "config" and (name, odd) != ("networks", []):  # weights say their own size; no networks are none
        refused(run, lambda: load_model(run))


@pytest.mark.parametrize("content", ["", "[]", "null", "3", "{}", "[" * 50_000, '{"a": 1, "a": 2}', "\0"])
def test_a_manifest_that_is_none(tmp_path, content) -> None:
    (tmp_path / "manifest.json").write_text(content)
    refused(tmp_path, lambda: read_run(tmp_path))
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "manifest.json").write_text(content)
    refused(tmp_path, lambda: read_manifest(tmp_path))


@pytest.mark.parametrize("odd", ODD, ids=repr)
def test_a_dataset_whose_manifest_or_info_holds_something_else(tmp_path, odd) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "manifest.json").write_text(json.dumps({"key": "k", "settings": odd}))
    refused(tmp_path, lambda: read_manifest(tmp_path))


def test_weights_that_are_none(tmp_path, a_run) -> None:
    run = tmp_path / "run"
    shutil.copytree(a_run, run)
    for content in (b"", b"\x00" * 100, (run / "ff.safetensors").read_bytes()[:5000]):
        (run / "ff.safetensors").write_bytes(content)
        assert "train it again" in refused(run, lambda: load_model(run))


def test_stages_that_are_none(tmp_path) -> None:
    (tmp_path / "stages.json").write_text("[1]")
    refused(tmp_path, lambda: Stages(tmp_path))


@pytest.mark.parametrize("odd", [*ODD, {1: 2}], ids=repr)
def test_settings_that_are_none(odd) -> None:
    with pytest.raises(InputError):
        from_record(SimulatorConfig, odd)
