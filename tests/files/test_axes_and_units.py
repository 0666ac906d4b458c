"""Meshes, centerlines and markups: stated axes and units are obeyed, absent ones noted, damaged files refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_meshes import SLICER, arc, markup, tube, write_lines, write_surface

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.types import LumenMask, Volume
from endopilot.vessels.sources import AnatomySource, Polylines, check_unit, read_source, transformed
from endopilot.vessels.surface import Surface

RAS = np.array([-1.0, -1.0, 1.0])
MESHES = ["mesh.bin.stl", "mesh.stl", "mesh.ply", "mesh.obj", "mesh.vtk", "mesh.vtp", "lines.vtp"]


def stated(name, axes):
    return f"SPACE={axes}" if name.endswith(".vtp") else SLICER.format(axes)


def middle(source):
    content = source.content
    assert isinstance(content, (Surface, Polylines))
    return (content.vertices if isinstance(content, Surface) else np.concatenate(content.points)).mean(axis=0)


@pytest.mark.parametrize(("name", "axes"), [*((name, "RAS") for name in MESHES), ("mesh.ply", "LPS")])
def test_axes_in_a_header_are_obeyed(tmp_path, name, axes):
    vertices, faces = tube(arc())
    turn = RAS if axes == "RAS" else 1.0
    if name == "lines.vtp":
        vertices = arc()
        path = write_lines(tmp_path / name, [vertices * turn], [np.full(60, 1.5)], stated(name, axes))
    else:
        path = write_surface(tmp_path / name, vertices * turn, faces, stated(name, axes))
    source = read_source(path)
    assert source.coordinates == axes.lower() and source.notes == ()
    np.testing.assert_allclose(
        middle(transformed(source, scale=1.0, coordinates=None)), vertices.mean(axis=0), atol=1e-3
    )
    agreeing = transformed(source, scale=1.0, coordinates=axes.lower())
    np.testing.assert_allclose(middle(agreeing), vertices.mean(axis=0), atol=1e-3)
    other = "lps" if axes == "RAS" else "ras"
    with pytest.raises(InputError, match=rf"--coordinates {other} was given, but the file states {axes}") as error:
        transformed(source, scale=1.0, coordinates=other)
    assert name in str(error.value)


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.vtp"])
def test_axes_that_nothing_states_are_lps_with_a_note(tmp_path, name):
    vertices, faces = tube(arc())
    source = read_source(write_surface(tmp_path / name, vertices, faces))
    assert source.coordinates is None
    silent = transformed(source, scale=1.0, coordinates=None)
    assert any("axes not stated: taken for LPS" in note for note in silent.notes)
    given = transformed(source, scale=1.0, coordinates="ras")
    assert given.notes == ()
    np.testing.assert_allclose(middle(given), vertices.mean(axis=0) * RAS, atol=1e-3)


@pytest.mark.parametrize("header", ["SPACE=LAS", "SPACE=scanner-xyz", "SPACE=LPS SPACE=RAS"])
def test_axes_that_are_neither_lps_nor_ras_are_refused(tmp_path, header):
    vertices, faces = tube(arc())
    with pytest.raises(InputError, match="the header states SPACE="):
        read_source(write_surface(tmp_path / "mesh.ply", vertices, faces, header))


def test_axes_given_for_a_mask_are_refused():
    mask = LumenMask(Volume(np.ones((4, 4, 4), dtype=bool), np.ones(3), np.zeros(3), np.eye(3)))
    with pytest.raises(InputError, match=r"--coordinates ras was given, but the file is a mask"):
        transformed(AnatomySource(mask, coordinates="lps"), scale=None, coordinates="ras")


CM_OR_INCHES = r"in cm \(--scale 10\), or .* in inches \(--scale 25\.4\); say which"


@pytest.mark.parametrize(
    ("extent", "radius", "vessel", "said"),
    [
        (1.22, 0.015, "rca", r"in dm \(--scale 100\); say which"),
        (0.122, 0.0015, "rca", r"in m \(--scale 1000\); say which"),
        (122e3, 1500.0, "rca", r"in µm \(--scale 0\.001\); say which"),
        (7.0, 0.1, "lca", CM_OR_INCHES),
        (10.0, 0.15, "generic", CM_OR_INCHES),
        (1e9, 1.5, "generic", "as no vessel does"),
    ],
)
def test_the_units_that_explain_a_size_are_named_with_their_scales(extent, radius, vessel, said):
    with pytest.raises(InputError, match=said):
        check_unit(np.array([[0.0, 0, 0], [0.0, 0.0, extent]]), radius, vessel, "tree.vtp")


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.ply", "mesh.vtp"])
def test_a_unit_in_the_header_of_a_surface_is_obeyed_once(tmp_path, name):
    vertices, faces = tube(arc())
    source = read_source(write_surface(tmp_path / name, vertices / 10, faces, "UNITS=cm"))
    assert isinstance(source.content, Surface)
    assert any("unit cm: multiplied by 10" in note for note in source.notes)
    np.testing.assert_allclose(np.ptp(source.content.vertices, axis=0), np.ptp(vertices, axis=0), rtol=1e-4)
    same = transformed(source, scale=10.0, coordinates="lps").content
    assert isinstance(same, Surface)
    np.testing.assert_allclose(same.vertices, source.content.vertices)
    with pytest.raises(InputError, match="--scale 1000 was given, but the file states a unit of 10 mm"):
        transformed(source, scale=1000.0, coordinates=None)


@pytest.mark.parametrize(("unit", "factor"), [("cm", 10.0), (["m", "UCUM", "meter"], 1000.0), ("in", 25.4)])
def test_the_unit_of_a_slicer_curve_is_obeyed_with_its_radii(tmp_path, unit, factor):
    line, radius = arc(), np.full(60, 1.5)
    curve = markup(line / factor, radius, coordinateUnits=unit)  # radii stay in mm, as they state
    (tmp_path / "cl.mrk.json").write_text(json.dumps({"markups": [curve]}))
    anatomy = extract_anatomy(tmp_path / "cl.mrk.json", config=AnatomyConfig(spacing_mm=1.0))
    first = anatomy.tree.branches[0].centerline
    np.testing.assert_allclose(first.points[[0, -1]], line[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(first.radius, 1.5)
    assert any(f"multiplied by {factor:g}" in note for note in anatomy.provenance["notes"])


def written(path, *markups):
    path.mkdir(exist_ok=True)
    (path / "cl.mrk.json").write_text(json.dumps({"markups": markups}))
    return path / "cl.mrk.json"


RADIUS = np.full(60, 1.5)


@pytest.mark.parametrize(("system", "turn"), [("LPS", 1.0), ("RAS", RAS), ("0", RAS), (1, 1.0), (None, 1.0)])
def test_axes_of_slicer_curves_are_obeyed(tmp_path, system, turn):
    source = read_source(written(tmp_path, markup(arc() * turn, RADIUS, coordinateSystem=system)))
    np.testing.assert_allclose(middle(source), arc().mean(axis=0))
    assert any("axes not stated" in note for note in source.notes) == (system is None)
    with pytest.raises(InputError, match="--coordinates"):
        transformed(source, scale=1.0, coordinates="lps" if source.coordinates == "ras" else "ras")


def test_other_markups_beside_curves_and_lines_are_left_out_with_a_note(tmp_path):
    other = markup(arc(), RADIUS, type="ClosedCurve", label="B")
    with pytest.raises(InputError, match=r"ClosedCurve 'B' is no centerline; save it as an open curve"):
        read_source(written(tmp_path, other))
    line = markup(np.array([[0.0, 0, 0], [0, 0, 40]]), np.array([1.0, 1.0]), type="Line")
    source = read_source(written(tmp_path, markup(arc(), RADIUS), line, other))
    assert isinstance(source.content, Polylines) and len(source.content.points) == 2
    assert source.notes == ("ClosedCurve 'B' is no centerline, and is left out",)


def test_the_curves_of_a_folder_are_one_tree(tmp_path):
    folder = tmp_path / "curves"
    turn = np.linspace(0.0, np.pi, 61)[:, None]
    side = np.hstack([np.sin(turn), np.zeros_like(turn), 1.5 - 1.5 * np.cos(turn)]) * 20
    trunk = np.linspace([0.0, 0, -40], [0, 0, 0], 41)
    for name, line, size in (("trunk", trunk, 3.0), ("left", side, 1.0), ("right", side[::6] * [-1, 1, 1], 1.0)):
        written(folder, markup(line, np.full(len(line), size))).rename(folder / f"{name}.mrk.json")
    (folder / "wall.obj").write_text("")
    anatomy = extract_anatomy(folder)
    assert anatomy.name == "curves" and len(anatomy.tree.leaves()) == 2
    np.testing.assert_allclose(anatomy.insertion.position, trunk[0], atol=0.1)
    notes = anatomy.provenance["notes"]
    assert notes[1:3] == [
        "3 files of curves in the folder are the lines of one tree",
        "beside the curves the folder holds wall.obj: left out",
    ]
    assert any(note.startswith("line 'right': the spheres of 10 neighbouring points do not touch") for note in notes)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: holds no curves \(\.mrk\.json\); give"):
        read_source(tmp_path / "empty")


def test_control_points_without_a_position_are_left_out_with_their_radii(tmp_path):
    curve = markup(arc(), np.linspace(1, 2, 60))
    curve["controlPoints"][7] = {"positionStatus": "undefined"}  # pyright: ignore[reportIndexIssue]
    source = read_source(written(tmp_path, curve))
    assert isinstance(source.content, Polylines)
    np.testing.assert_allclose(source.content.points[0], np.delete(arc(), 7, axis=0))
    np.testing.assert_allclose(source.content.radius[0], np.delete(np.linspace(1, 2, 60), 7))
    assert "1 control points without a position are left out" in source.notes[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinateSystem": "IJK"}, r"coordinateSystem is 'IJK'.*; save it in LPS or RAS"),
        ({"coordinateUnits": "parsec"}, "unit 'parsec' is no known length"),
        ({"controlPoints": []}, "positions of the shape"),
        ({"controlPoints": "many"}, "no number"),
        ({"controlPoints": [{"position": [1, 2]}] * 60}, r"positions of the shape \(60, 2\)"),
        ({"controlPoints": [{"position": ["a", 2, 3]}] * 60}, "no number"),
        ({"controlPoints": [{"position": [10**400, 2, 3]}] * 60}, "no number"),
        ({"controlPoints": [17] * 60}, "no number"),
        ({"measurements": []}, r"0 radii \(it measures nothing\)"),
        ({"measurements": 3}, "no number"),
        ({"measurements": [{"name": "Radius", "controlPointValues": [1.0] * 9}]}, "9 radii"),
        ({"measurements": [{"name": "Radius", "controlPointValues": ["x"] * 60}]}, "no number"),
        ({"measurements": [{"name": "Radius", "controlPointValues": [0.0] * 60}]}, "mm is 0;"),
    ],
)
def test_damaged_curves_are_refused_in_one_line(tmp_path, change, message):
    path = written(tmp_path, markup(arc(), RADIUS) | change)
    with pytest.raises(InputError, match=message) as error:
        read_source(path)
    assert "cl.mrk.json" in str(error.value)


@pytest.mark.parametrize("content", ["[]", '{"markups": {}}', '{"markups": [3]}', "null"])
def test_json_without_markups_is_refused(tmp_path, content):
    (tmp_path / "cl.mrk.json").write_text(content)
    with pytest.raises(InputError, match="holds no Slicer markups"):
        read_source(tmp_path / "cl.mrk.json")


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.ply", "mesh.obj", "mesh.vtp"])
def test_truncated_meshes_are_refused(tmp_path, capfd, name):
    path = write_surface(tmp_path / name, *tube(arc()))
    content = path.read_bytes()
    share = 0.3 if name == "mesh.obj" else 0.6  # a text without counts is whole at any line: cut it among the points
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=name):
        read_source(path)
    assert capfd.readouterr() == ("", "")


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
    with pytest.raises(InputError, match=name):
        read_source(tmp_path / name)
    assert capfd.readouterr() == ("", "")


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
