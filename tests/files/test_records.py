"""YAML and JSON files as people and programs write them, and damaged records of our own: one reading, or one line."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from make_fuzz import refusal

from endopilot.dataset.loader import read_manifest
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import read_json, read_text, read_yaml, reading, write_json
from endopilot.imaging.segment import SegmentConfig
from endopilot.models.checkpoint import load_model
from endopilot.models.config import read_run
from endopilot.pipeline.study import Study, StudyConfig
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
    make_untrained_run(folder / "dataset", folder / "run", patients=[])
    return folder / "run"


def refused(path: Path, read: Any) -> str:
    with pytest.raises(InputError) as error:
        read()
    assert str(path) in str(error.value)
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


@pytest.mark.parametrize("content", ["", "[]", "{}", "\0"])
def test_a_manifest_that_is_none(tmp_path, content) -> None:
    (tmp_path / "manifest.json").write_text(content)
    refused(tmp_path, lambda: read_run(tmp_path))
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "manifest.json").write_text(content)
    refused(tmp_path, lambda: read_manifest(tmp_path))


def test_stages_and_settings_that_are_none(tmp_path) -> None:
    (tmp_path / "stages.json").write_text("[1]")
    given = {"config": StudyConfig(), "segmentation": SegmentConfig(), "device": read_wire("workhorse-014")}
    refused(tmp_path, lambda: Study(output=tmp_path, origin="", command="", **given))
    for odd in (*ODD, {1: 2}):
        with pytest.raises(InputError):
            from_record(SimulatorConfig, odd)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("3e-1", 0.3),
        ("1E3", 1000.0),
        ("+4.5e+3", 4500.0),
        (".5", 0.5),
        ("1.", 1.0),
        ("-3", -3),
        ("0", 0),
        (".inf", float("inf")),
        ("true", True),
        ("~", None),
        ("", None),
        # What YAML 1.1 makes numbers, truths and dates of, and no person means:
        ("1_000", "1_000"),
        ("017", "017"),
        ("0o17", "0o17"),
        ("0x1f", "0x1f"),
        ("1:30", "1:30"),
        ("yes", "yes"),
        ("no", "no"),
        ("2024-05-01", "2024-05-01"),
        ("0,36", "0,36"),
    ],
)
def test_a_plain_scalar_means_what_it_looks_like(tmp_path, written, value) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"a: {written}\n")
    found = read_yaml(path)["a"]
    assert found == value and type(found) is type(value)


def test_a_field_given_twice_is_refused(tmp_path) -> None:
    assert "line 3: not valid YAML (a is given twice)" in refusal(tmp_path / "a.yaml", "a: 1\nb: 2\na: 3\n", read_yaml)
    assert "a is given twice" in refusal(tmp_path / "a.json", '{"b": {"a": 1, "a": 2}}', read_json)


def test_aliases_that_stand_for_too_much_or_for_themselves_are_refused(tmp_path) -> None:
    laughs = "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 60))
    assert "stand for more than 100000 values" in refusal(tmp_path / "a.yaml", laughs, read_yaml)
    assert "an alias stands in its own anchor" in refusal(tmp_path / "a.yaml", "a: &a [*a]", read_yaml)
    (tmp_path / "a.yaml").write_text("a: &a [1, 2]\nb: *a\n")
    assert read_yaml(tmp_path / "a.yaml") == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    "tag", ["!!python/object/apply:os.system [ls]", "!!binary x", "!!timestamp x", "!!bool x", "!a"]
)
def test_tags_that_make_objects_are_refused(tmp_path, tag) -> None:
    assert "not valid YAML" in refusal(tmp_path / "a.yaml", f"a: {tag}", read_yaml)


@pytest.mark.parametrize("read", [read_yaml, read_json])
def test_text_with_the_marks_of_windows_is_read(tmp_path, read) -> None:
    path = tmp_path / "a"
    for encoding in ("utf-8-sig", "utf-16"):
        path.write_bytes('{"a": "µm"}\r\n'.encode(encoding))
        assert read(path) == {"a": "µm"}


@pytest.mark.parametrize("read", [read_yaml, read_json])
def test_deep_nesting_long_numbers_and_bytes_that_are_no_text_are_refused(tmp_path, read) -> None:
    assert "nested too deeply" in refusal(tmp_path / "a", "[" * 20_000, read)
    assert "not valid" in refusal(tmp_path / "a", '{"a": ' + "9" * 5000 + "}", read)
    for content in (b"PK\x03\x04\x00\x00", "µ: 1".encode("latin-1"), b"a\x00: 1"):
        assert "is no text" in refusal(tmp_path / "a", content, read)


def test_no_more_is_read_than_such_a_file_can_have(tmp_path) -> None:
    assert "larger than 0.25 MiB, too large for a YAML file" in refusal(tmp_path / "a.yaml", b"#" * 300_000, read_yaml)
    with (tmp_path / "huge.yaml").open("wb") as stream:
        stream.truncate(1 << 40)  # of which the disk holds nothing
    with pytest.raises(InputError, match=r"huge\.yaml: is larger"):
        read_text(tmp_path / "huge.yaml")
    with pytest.raises(InputError, match="/dev/zero: is a FIFO, a socket or a device"):
        read_text(Path("/dev/zero"))


def test_what_is_no_file_is_refused(tmp_path) -> None:
    for path in (tmp_path, tmp_path / "none", tmp_path / ("x" * 3000), Path("a\0b")):
        with pytest.raises(InputError, match=r"no such file|cannot be read"):
            read_yaml(path)


def test_a_record_of_another_kind_is_refused(tmp_path) -> None:
    path = tmp_path / "a.json"
    for content, what in (
        ("[1]", "holds a list where an object"),
        ("3", "a number"),
        ("null", "null"),
        ("{}", "b: missing"),
    ):
        assert what in refusal(path, content, lambda path: read_json(path, keys=("b",), mend="make it again"))


@pytest.mark.parametrize(
    ("record", "what"),
    [
        ({}, "b: missing"),
        ([], "damaged"),
        (None, "damaged"),
        ({"b": "x"}, "damaged"),
        ({"b": {"c": [[], 1]}}, "damaged"),
    ],
)
def test_odd_content_of_a_damaged_record_is_answered_in_one_line(tmp_path, record, what) -> None:
    with pytest.raises(InputError) as error, reading(tmp_path, "make it again"):
        float(record["b"]["c"][0] + 1)
    assert str(error.value).startswith(f"{tmp_path}: {what}") and str(error.value).endswith("; make it again")
