"""Anatomies whose files someone edited, or that were damaged: read, or refused in one line."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_fuzz import bounded, damaged, outcome
from make_meshes import arc

from endopilot import files
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.errors import InputError
from endopilot.vessels.sources import Polylines


@pytest.fixture(scope="module")
def anatomy():
    lines = Polylines((arc(),), (np.full(60, 2.0),))
    return extract_anatomy(lines, name="a", config=AnatomyConfig(spacing_mm=1.5))


def resigned(folder, **change):
    """Write the hashes of the files as they are now, without the identity."""
    record = json.loads((folder / "anatomy.json").read_text())
    record["sha256"] = {name: files.sha256(folder / name) for name in ("centerline.vtp", "lumen.nrrd")}
    del record["identity"]
    (folder / "anatomy.json").write_text(json.dumps(record | change))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (rb"left-posterior-superior", b"right-anterior-superior", "not along the LPS axes"),
        (rb"\(1.5,0,0\)", b"(3.0,0,0)", "not the same along all"),
    ],
)
def test_a_distance_map_on_other_axes_is_refused(anatomy, tmp_path, old, new, message):
    write_anatomy(anatomy, output=tmp_path / "a")
    path = tmp_path / "a" / "lumen.nrrd"
    content = path.read_bytes()
    changed = re.sub(old, new, content, count=1)
    assert changed != content
    path.write_bytes(changed)
    resigned(tmp_path / "a")
    with pytest.raises(InputError, match=rf"lumen\.nrrd: .*{message}.*; make the anatomy again"):
        read_anatomy(tmp_path / "a")


@pytest.mark.parametrize(
    "change",
    [
        {"insertion": {"position_mm": [1, 2], "direction": [0, 0, 1], "rotation_zero": [1, 0, 0]}},
        {"insertion": {"position_mm": [1, 2, 3], "direction": [0, 0, 0], "rotation_zero": [1, 0, 0]}},
        {"insertion": {"position_mm": [1, 2, float("nan")], "direction": [0, 0, 1], "rotation_zero": [1, 0, 0]}},
        {"insertion": 7},
        {"catheter_radius_mm": -1},
        {"section_names": []},
        {"provenance": 3},
        {"sha256": []},
    ],
)
def test_a_damaged_record_without_identity_is_refused(anatomy, tmp_path, change):
    write_anatomy(anatomy, output=tmp_path / "a")
    resigned(tmp_path / "a", **change)
    with pytest.raises(InputError, match="make the anatomy again") as error:
        read_anatomy(tmp_path / "a")
    assert "\n" not in str(error.value)


def test_a_record_without_identity_is_read_where_the_rest_is_whole(anatomy, tmp_path):
    write_anatomy(anatomy, output=tmp_path / "a")
    resigned(tmp_path / "a")
    assert read_anatomy(tmp_path / "a").identity == anatomy.identity


@pytest.fixture(scope="module")
def folder(anatomy, tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("anatomies") / "vessel"
    write_anatomy(anatomy, output=made)
    return made


FLIPS = st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 255)), max_size=4)
CUT = st.one_of(st.none(), st.integers(0, 4000))
ODD = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**20), 10**20), st.floats(), st.text(max_size=4), st.just([]), st.just({})
)


def replaced(content: object, steps: list[int], value: object) -> object:
    """Return JSON content in which what the steps lead to is replaced by another value."""
    if not steps or not isinstance(content, (dict, list)) or not content:
        return value
    result = content.copy()
    key = list(content)[steps[0] % len(content)] if isinstance(content, dict) else steps[0] % len(content)
    result[key] = replaced(content[key], steps[1:], value)
    return result


@bounded(40)
@given(steps=st.lists(st.integers(0, 20), min_size=1, max_size=4), value=ODD)
def test_entries_of_an_anatomy(tmp_path, capfd, folder, steps, value):
    copy = tmp_path / "vessel"
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    record = json.loads((folder / "anatomy.json").read_text())
    (copy / "anatomy.json").write_text(json.dumps(replaced(record, steps, value)))
    found = outcome(lambda: read_anatomy(copy), capfd)
    if found is not None:  # what does not count, such as provenance
        assert found.identity == read_anatomy(folder).identity


@pytest.mark.parametrize("file", ["anatomy.json", "centerline.vtp", "lumen.nrrd"])
@bounded(10)
@given(flips=FLIPS.filter(len), cut=CUT)
def test_bytes_of_an_anatomy(tmp_path, capfd, folder, file, flips, cut):
    copy = tmp_path / "vessel"
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    (copy / file).write_bytes(damaged((folder / file).read_bytes(), flips, cut))
    outcome(lambda: read_anatomy(copy), capfd)
