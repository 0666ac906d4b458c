"""Damaged meshes and curves are read or refused in one line, whatever VTK does with them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from make_meshes import arc, tube, write_lines, write_surface

from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.surface import Surface


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.ply", "mesh.obj", "mesh.vtp"])
def test_truncated_meshes_are_refused(tmp_path, capfd, name):
    path = write_surface(tmp_path / name, *tube(arc()))
    content = path.read_bytes()
    share = 0.3 if name == "mesh.obj" else 0.6  # a text without counts is whole at any line: cut it among the points
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=name) as error:
        read_source(path)
    assert "\n" not in str(error.value) and capfd.readouterr() == ("", "")


PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("many.ply", PLY.format("ascii 1.0", 999999999, "") + "0 0 0\n"),
        ("list.ply", PLY.format("binary_little_endian 1.0", 0, "element face 2\nproperty list int int i\n") + 8 * "z"),
        ("many.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET POLYDATA\nPOINTS 99999999999 float\n0 0 0\n"),
        ("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("image.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 2\n"
                      "ORIGIN 0 0 0\nSPACING 1 1 1\nPOINT_DATA 8\nSCALARS s float 1\nLOOKUP_TABLE default\n"
                      "1 1 1 1 1 1 1 1\n"),
        ("empty.obj", "# nothing but a comment\n"),
        ("empty.stl", ""),
    ],
)  # fmt: skip
def test_headers_that_promise_what_is_not_there_are_refused(tmp_path, capfd, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=name) as error:
        read_source(tmp_path / name)
    assert "\n" not in str(error.value) and capfd.readouterr() == ("", "")


def test_lines_beside_triangles_are_noted(tmp_path):
    vertices, faces = tube(arc())
    path = write_surface(tmp_path / "both.vtk", vertices, faces)
    path.write_text(path.read_text() + "LINES 1 3\n2 0 1\n")
    source = read_source(path)
    assert isinstance(source.content, Surface)
    assert source.notes == ("lines beside the triangles are left out: the file is read as a surface",)


def test_positions_and_radii_that_are_none_are_refused(tmp_path):
    line = arc()
    line[3, 1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        read_source(write_lines(tmp_path / "lines.vtp", [line], [np.full(60, 1.5)]))
    with pytest.raises(InputError, match="without radii"):
        read_source(write_lines(tmp_path / "bare.vtp", [arc()], None))
    with pytest.raises(InputError, match=r"missing\.stl: no such file"):
        read_source(tmp_path / "missing.stl")


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
@settings(max_examples=8, deadline=None, derandomize=True)
def test_edited_meshes_are_read_or_refused(originals, name, edits):
    content = bytearray(originals[name])
    for share, kind, text in edits:
        place = int(share * len(content))
        content[place : place + {"put": len(text), "cut": 40, "add": 0}[kind]] = b"" if kind == "cut" else text
    outcome(name, bytes(content))
