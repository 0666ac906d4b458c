"""Results are written whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.files import input_hash, manifest, read_json, sha256, write_json, writing


def test_a_finished_block_leaves_the_file_alone(tmp_path: Path) -> None:
    with writing(tmp_path / "deep" / "a.txt") as partial:
        assert partial.suffix == ".txt"
        partial.write_text("whole")
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.txt"]
    assert (tmp_path / "deep" / "a.txt").read_text() == "whole"


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), writing(target) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "old"


def test_a_failing_block_removes_a_half_written_folder(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), writing(tmp_path / "folder") as partial:
        partial.mkdir()
        (partial / "part").write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="disk is full"), writing(tmp_path / "a.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_place_of_a_folder_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match="cannot be written"), writing(tmp_path / "taken" / "a.txt"):
        pass


def test_json_takes_numpy_values_and_paths(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"x": np.float64(1.5), "n": np.arange(3), "p": Path("q")})
    assert read_json(tmp_path / "a.json") == {"x": 1.5, "n": [0, 1, 2], "p": "q"}


@pytest.mark.parametrize("text", [None, "{"])
def test_missing_or_broken_json_is_reported_in_one_line(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_manifest_names_versions_machine_and_inputs(tmp_path: Path) -> None:
    (tmp_path / "in").write_bytes(b"endopilot")
    record = manifest(config={"a": 1}, seed=3, inputs=input_hash(tmp_path / "in"), wall_seconds=2.0)
    assert record["inputs"] == {"in": sha256(tmp_path / "in")}
    assert record["seed"] == 3
    assert record["wall_seconds"] == 2.0
    assert {"endopilot", "python", "numpy", "torch"} <= record["versions"].keys()
    assert record["machine"]["cores"] >= 1


def test_the_hash_of_a_folder_sees_every_file(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    folder.mkdir()
    (folder / "1").write_text("a")
    (folder / "2").write_text("b")
    before = input_hash(folder)
    (folder / "2").write_text("c")
    assert input_hash(folder) != before
