"""Records of our own that were damaged since: one line that says what to make again, never a traceback."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import endopilot
from endopilot.dataset.loader import read_manifest
from endopilot.errors import InputError
from endopilot.models.checkpoint import load_model
from endopilot.models.config import read_run
from endopilot.pipeline.study import Stages
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig

PRETRAINED = Path(endopilot.__file__).parent / "models" / "pretrained"
ODD = [None, [], "text", 3, True, {"a": []}]


def refused(path: Path, read: Any) -> str:
    with pytest.raises(InputError) as error:
        read()
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("odd", ODD, ids=repr)
@pytest.mark.parametrize("name", ["config", "device", "networks"])
def test_a_run_whose_manifest_holds_something_else(tmp_path, name, odd) -> None:
    run = tmp_path / "run"
    shutil.copytree(PRETRAINED, run)
    record = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(record | {name: odd}))
    if (name, odd) != ("networks", []):  # a run without networks is that of a model that has none
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


def test_weights_that_are_none(tmp_path) -> None:
    run = tmp_path / "run"
    shutil.copytree(PRETRAINED, run)
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
