"""Anatomies whose files someone edited, or that were damaged: read, or refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_fuzz import bounded, damaged, outcome
from make_meshes import arc

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.vessels.sources import Polylines


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("anatomies") / "vessel"
    lines = Polylines((arc(),), (np.full(60, 2.0),))
    write_anatomy(extract_anatomy(lines, name="a", config=AnatomyConfig(spacing_mm=1.5)), output=made)
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


@bounded(25)
@given(steps=st.lists(st.integers(0, 20), min_size=1, max_size=4), value=ODD)
def test_entries_of_an_anatomy(tmp_path, capfd, folder, steps, value):
    copy = tmp_path / "vessel"
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    record = json.loads((folder / "anatomy.json").read_text())
    (copy / "anatomy.json").write_text(json.dumps(replaced(record, steps, value)))
    found = outcome(lambda: read_anatomy(copy), capfd)
    if found is not None:  # what does not count, such as provenance
        assert found.identity == read_anatomy(folder).identity


def test_a_record_without_identity_or_with_too_few_section_names(tmp_path, capfd, folder):
    copy = tmp_path / "vessel"
    shutil.copytree(folder, copy)
    record = json.loads((folder / "anatomy.json").read_text())
    del record["identity"]
    for change, read in (({}, True), ({"section_names": []}, False), ({"insertion": 7}, False)):
        (copy / "anatomy.json").write_text(json.dumps(record | change))
        assert (outcome(lambda: read_anatomy(copy), capfd) is not None) == read


@pytest.mark.parametrize("file", ["anatomy.json", "centerline.vtp", "lumen.nrrd"])
@bounded(6)
@given(flips=FLIPS.filter(len), cut=CUT)
def test_bytes_of_an_anatomy(tmp_path, capfd, folder, file, flips, cut):
    copy = tmp_path / "vessel"
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    (copy / file).write_bytes(damaged((folder / file).read_bytes(), flips, cut))
    outcome(lambda: read_anatomy(copy), capfd)
