"""Damaged meshes are refused in one line, whatever VTK does with them; what is left out of a whole one is noted."""

from __future__ import annotations

import numpy as np
import pytest
from make_meshes import arc, tube, write_lines, write_surface

from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.surface import Surface


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.ply", "mesh.obj", "mesh.vtk", "mesh.vtp"])
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
        ("negative.ply", PLY.format("ascii 1.0", -3, "") + "0 0 0\n"),
        ("list.ply", PLY.format("binary_little_endian 1.0", 0, "element face 2\nproperty list int int i\n") + 8 * "z"),
        ("word.ply", PLY.format("ascii 1.0", "three", "") + "0 0 0\n"),
        ("many.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET POLYDATA\nPOINTS 99999999999 float\n0 0 0\n"),
        ("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("word.obj", "v 0 a 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("image.vtk", "# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 2\n"
                      "ORIGIN 0 0 0\nSPACING 1 1 1\nPOINT_DATA 8\nSCALARS s float 1\nLOOKUP_TABLE default\n"
                      "1 1 1 1 1 1 1 1\n"),
        ("empty.obj", "# nothing but a comment\n"),
        ("empty.stl", ""),
        ("text.ply", "hello, world, this is no mesh\n"),
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


def test_points_that_coincide_become_one(tmp_path):
    vertices, faces = tube(arc())
    alone = vertices[faces].reshape(-1, 3)
    source = read_source(write_surface(tmp_path / "mesh.ply", alone, np.arange(len(alone)).reshape(-1, 3)))
    assert isinstance(source.content, Surface) and len(source.content.vertices) == len(vertices)


def test_positions_and_radii_that_are_none_are_refused(tmp_path):
    line = arc()
    line[3, 1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        read_source(write_lines(tmp_path / "lines.vtp", [line], [np.full(60, 1.5)]))
    with pytest.raises(InputError, match="without radii"):
        read_source(write_lines(tmp_path / "bare.vtp", [arc()], None))
    with pytest.raises(InputError, match=r"missing\.stl: no such file"):
        read_source(tmp_path / "missing.stl")
