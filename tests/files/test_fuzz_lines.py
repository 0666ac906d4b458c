"""Any bytes in the place of a mesh, curve or centerline end in a source or in one line; VTK prints nothing."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from make_meshes import arc, markup, tube, write_lines, write_surface

from endopilot.anatomy.tree import tree_from_polylines
from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines

NAMES = ["mesh.bin.stl", "mesh.stl", "mesh.ply", "mesh.obj", "mesh.vtk", "mesh.vtp", "lines.vtp"]
EDITS = st.lists(st.tuples(st.floats(0, 1), st.sampled_from(["put", "cut", "add"]), st.binary(min_size=1, max_size=6)))


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder, axis = tmp_path_factory.mktemp("meshes"), arc()[::6]
    vertices, faces = tube(axis, sides=5)
    paths = [write_surface(folder / name, vertices, faces) for name in NAMES[:-1]]
    paths.append(write_lines(folder / NAMES[-1], [axis], [np.full(len(axis), 1.5)]))
    return {path.name: path.read_bytes() for path in paths}


def outcome(name, content):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            read_source(path)
        except InputError as error:
            assert "\n" not in str(error) and name in str(error)


@given(name=st.sampled_from(NAMES), edits=EDITS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_edited_meshes_are_read_or_refused(originals, name, edits):
    content = bytearray(originals[name])
    for share, kind, text in edits:
        place = int(share * len(content))
        content[place : place + {"put": len(text), "cut": 40, "add": 0}[kind]] = b"" if kind == "cut" else text
    outcome(name, bytes(content))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
KEYS = ["type", "coordinateSystem", "coordinateUnits", "controlPoints", "measurements", "label"]


@given(changes=st.dictionaries(st.sampled_from(KEYS), VALUES, min_size=1, max_size=3))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_edited_curves_are_read_or_refused(changes):
    curve = markup(arc()[::6], np.full(10, 1.5)) | changes
    outcome("cl.mrk.json", json.dumps({"markups": [curve]}).encode())


@given(
    points=st.lists(st.tuples(*[st.floats(-200, 200)] * 3), min_size=2, max_size=25),
    radii=st.lists(st.floats(0.05, 30), min_size=25, max_size=25),
    cut=st.integers(0, 25),
)
@settings(max_examples=30, deadline=None, derandomize=True)
def test_any_lines_become_a_tree_or_are_refused(points, radii, cut):
    places, sizes = np.array(points), np.array(radii)[: len(points)]
    parts = [part for part in (slice(None, cut), slice(cut, None)) if len(places[part]) > 1]
    lines = Polylines(tuple(places[part] for part in parts), tuple(sizes[part] for part in parts))
    if not parts:
        return
    try:
        found = tree_from_polylines(lines, None, "lines.vtp")
    except InputError as error:
        assert "\n" not in str(error)
        return
    lengths = found.coverage
    assert abs(lengths["reached_mm"] + lengths["left_out_mm"] - lengths["length_mm"]) < 0.3
    for branch in found.tree.branches:
        assert np.isfinite(branch.centerline.points).all() and (np.diff(branch.centerline.abscissa) >= 0).all()
