"""Atomic writes, hashes, manifests, and folders that runs claim."""

from __future__ import annotations

import errno
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.files import input_hash, manifest, read_json, sha256, stored_arrays, write_json, writing
from endopilot.runs import claim, make_missing


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


@dataclass(frozen=True)
class Settings:
    seed: int = 1
    shares: tuple[float, float] = (0.5, 0.5)


def test_arrays_that_are_damaged_anywhere_are_one_line(tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).integers(1000, size=200)
    np.savez_compressed(tmp_path / "whole.npz", numbers=numbers)
    whole, damaged = (tmp_path / "whole.npz").read_bytes(), 0
    for at in range(0, len(whole) - 20, 5):
        (tmp_path / "bad.npz").write_bytes(whole[:at] + bytes(20) + whole[at + 20 :])
        try:
            with stored_arrays(tmp_path / "bad.npz", "numbers", "write them again") as stored:
                stored["numbers"].sum()
        except InputError as error:
            assert re.search(r"bad\.npz: no numbers \(.*\); write them again$", str(error))
            damaged += 1
    assert damaged > 20


def begin(folder: Path, **identity) -> None:
    claim(folder, "endopilot test", **({"config": Settings(), "input": "a", "at": np.float64(2)} | identity))


def test_the_same_run_may_go_on_and_its_record_stays(tmp_path):
    folder = tmp_path / "deep" / "run"
    begin(folder)
    (folder / "result").write_text("whole")
    before = (folder / "run.json").stat().st_mtime_ns
    begin(folder)
    assert (folder / "run.json").stat().st_mtime_ns == before
    assert read_json(folder / "run.json") == {
        "command": "endopilot test", "config": {"seed": 1, "shares": [0.5, 0.5]}, "input": "a", "at": 2.0,
        "version": __version__,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"input": "b"}, "was begun with input = a, now it is b"),
        ({"config": Settings(seed=2)}, r"was begun with config\.seed = 1, now it is 2"),
        ({"more": 3}, "was begun with more = absent, now it is 3"),
        ({"config": {"seed": 1}}, r"was begun with config\.shares = \[0\.5, 0\.5\], now it is absent"),
        ({"input": "x" * 500}, f"now it is {'x' * 60}…; choose another folder, or remove this one$"),
    ],
)
def test_another_run_is_refused_and_changes_nothing(tmp_path, change, message):
    begin(tmp_path)
    (tmp_path / "result").write_text("mine")
    (tmp_path / ".part-1-half").write_text("of another process")
    before = (tmp_path / "run.json").read_text()
    with pytest.raises(InputError, match=message):
        begin(tmp_path, **change)
    assert (tmp_path / "run.json").read_text() == before
    assert (tmp_path / ".part-1-half").exists()


def test_a_folder_without_results_goes_to_the_new_run(tmp_path):
    begin(tmp_path)
    (tmp_path / ".part-1-half").write_text("")
    begin(tmp_path, input="b")
    assert read_json(tmp_path / "run.json")["input"] == "b"
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize("text", ["{", "[]"])
def test_a_damaged_record_is_refused(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    (tmp_path / "result").write_text("mine")
    with pytest.raises(InputError, match=str(tmp_path)):
        begin(tmp_path)
    assert (tmp_path / "run.json").read_text() == text


def test_half_written_files_and_folders_of_a_killed_run_are_removed(tmp_path):
    begin(tmp_path)
    (tmp_path / "deep" / ".part-7-folder").mkdir(parents=True)
    (tmp_path / "deep" / ".part-7-folder" / "a").write_text("half")
    (tmp_path / "deep" / ".part-7-file").write_text("half")
    begin(tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["deep", "run.json"]


def make(path: Path) -> None:
    if path.stem == "bad":
        raise InputError("cannot be made; mend it")
    path.write_text("new")


def test_only_missing_files_are_made_and_a_bad_one_is_named(tmp_path):
    paths = [tmp_path / f"{name}.json" for name in ("old", "bad", "fresh")]
    paths[0].write_text("kept")
    with pytest.raises(InputError, match=r"bad\.json: cannot be made; mend it"):
        make_missing("Test", paths, make)
    assert paths[0].read_text() == "kept" and paths[2].read_text() == "new" and not paths[1].exists()
