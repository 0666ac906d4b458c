"""Axes and units that meshes, centerlines and markups state are obeyed, and noted where they are not stated."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_meshes import SLICER, arc, markup, tube, write_lines, write_surface

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.types import LumenMask, Volume
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import AnatomySource, Polylines, check_unit, transformed
from endopilot.vessels.surface import Surface

RAS = np.array([-1.0, -1.0, 1.0])
MESHES = ["mesh.bin.stl", "mesh.stl", "mesh.ply", "mesh.obj", "mesh.vtk", "mesh.vtp"]


def stated(name, axes):
    return f"SPACE={axes}" if name.endswith(".vtp") else SLICER.format(axes)


def middle(source):
    content = source.content
    assert isinstance(content, (Surface, Polylines))
    return (content.vertices if isinstance(content, Surface) else np.concatenate(content.points)).mean(axis=0)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("axes", ["LPS", "RAS"])
def test_axes_in_the_header_of_a_surface_are_obeyed(tmp_path, name, axes):
    vertices, faces = tube(arc())
    turn = RAS if axes == "RAS" else 1.0
    source = read_source(write_surface(tmp_path / name, vertices * turn, faces, stated(name, axes)))
    assert source.coordinates == axes.lower() and source.notes == ()
    np.testing.assert_allclose(
        middle(transformed(source, scale=1.0, coordinates=None)), vertices.mean(axis=0), atol=1e-3
    )
    agreeing = transformed(source, scale=1.0, coordinates=axes.lower())
    np.testing.assert_allclose(middle(agreeing), vertices.mean(axis=0), atol=1e-3)
    other = "lps" if axes == "RAS" else "ras"
    with pytest.raises(InputError, match=rf"--coordinates {other} was given, but the file states {axes}") as error:
        transformed(source, scale=1.0, coordinates=other)
    assert name in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("axes", ["LPS", "RAS"])
def test_axes_in_the_field_data_of_centerlines_are_obeyed(tmp_path, axes):
    line = arc()
    turn = RAS if axes == "RAS" else 1.0
    path = write_lines(tmp_path / "lines.vtp", [line * turn], [np.full(60, 1.5)], f"SPACE={axes}")
    anatomy = extract_anatomy(path)
    np.testing.assert_allclose(anatomy.tree.branches[0].centerline.points[[0, -1]], line[[0, -1]], atol=1e-6)
    assert not any("axes" in note for note in anatomy.provenance["notes"])
    with pytest.raises(InputError, match="--coordinates"):
        extract_anatomy(path, config=AnatomyConfig(coordinates="ras" if axes == "LPS" else "lps"))


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


@pytest.mark.parametrize(("system", "turn"), [("LPS", 1.0), ("RAS", RAS), ("0", RAS), (1, 1.0), (None, 1.0)])
def test_axes_of_slicer_curves_are_obeyed(tmp_path, system, turn):
    line = arc()
    curve = markup(line * turn, np.full(60, 1.5), coordinateSystem=system)
    path = tmp_path / "cl.mrk.json"
    path.write_text(json.dumps({"markups": [curve]}))
    source = read_source(path)
    np.testing.assert_allclose(middle(source), line.mean(axis=0))
    assert any("axes not stated" in note for note in source.notes) == (system is None)
    with pytest.raises(InputError, match="--coordinates"):
        transformed(source, scale=1.0, coordinates="lps" if source.coordinates == "ras" else "ras")


@pytest.mark.parametrize("system", ["IJK", 2, "north"])
def test_slicer_curves_in_voxel_or_unknown_axes_are_refused(tmp_path, system):
    curve = markup(arc(), np.full(60, 1.5), coordinateSystem=system)
    (tmp_path / "cl.mrk.json").write_text(json.dumps({"markups": [curve]}))
    with pytest.raises(InputError, match=r"coordinateSystem is .*; save it in LPS or RAS"):
        read_source(tmp_path / "cl.mrk.json")


def test_axes_given_for_a_mask_are_refused():
    mask = LumenMask(Volume(np.ones((4, 4, 4), dtype=bool), np.ones(3), np.zeros(3), np.eye(3)))
    with pytest.raises(InputError, match=r"--coordinates ras was given, but the file is a mask"):
        transformed(AnatomySource(mask, coordinates="lps"), scale=None, coordinates="ras")


FACTORS = {"dm": 100.0, "m": 1000.0, "cm": 10.0, "µm": 0.001}


@pytest.mark.parametrize("unit", FACTORS)
def test_the_unit_of_a_coronary_tree_is_named_alone(unit):
    factor = FACTORS[unit]
    with pytest.raises(InputError, match=f"seems to be in {unit}: use --scale {factor:g}$"):
        check_unit(np.array([[0.0, 0, 0], [60.0, 70.0, 80.0]]) / factor, 1.5 / factor, "rca", "tree.vtp")


def test_all_units_that_explain_a_file_are_named():
    with pytest.raises(InputError, match=r"in cm or inches: use --scale 10 or --scale 25\.4$"):
        check_unit(np.array([[0.0, 0, 0], [0.0, 0.0, 7.0]]), 0.1, "lca", "tree.vtp")
    with pytest.raises(InputError, match=r"in cm or inches: use --scale 10 or --scale 25\.4$"):
        check_unit(np.array([[0.0, 0, 0], [0.0, 0.0, 10.0]]), 0.15, "generic", "tree.vtp")
    with pytest.raises(InputError, match="as no vessel does"):
        check_unit(np.array([[0.0, 0, 0], [0.0, 0.0, 1e9]]), 1.5, "generic", "tree.vtp")


def test_lines_and_walls_in_cm_are_told_with_the_scale():
    config = AnatomyConfig(vessel="rca", spacing_mm=1.5)
    for content in (Polylines((0.1 * arc(),), (np.full(60, 0.15),)), Surface(0.1 * tube(arc())[0], tube(arc())[1])):
        with pytest.raises(InputError, match=r"--scale 10\)?$"):
            extract_anatomy(content, name="tree", config=config)


@pytest.mark.parametrize("name", ["mesh.bin.stl", "mesh.obj", "mesh.ply", "mesh.vtk", "mesh.vtp"])
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


def test_an_unknown_unit_of_a_slicer_curve_is_refused(tmp_path):
    curve = markup(arc(), np.full(60, 1.5), coordinateUnits="parsec")
    (tmp_path / "cl.mrk.json").write_text(json.dumps({"markups": [curve]}))
    with pytest.raises(InputError, match="unit 'parsec' is no known length"):
        read_source(tmp_path / "cl.mrk.json")


RADIUS = np.full(60, 1.5)


def written(path, *markups):
    (path / "cl.mrk.json").write_text(json.dumps({"markups": markups}))
    return path / "cl.mrk.json"


@pytest.mark.parametrize(
    ("kind", "mend"),
    [("ClosedCurve", "save it as an open curve"), ("Fiducial", "in no order; convert it to a curve"),
     ("Angle", "only open curves"), ("ROI", "only open curves"), ("Plane", "only open curves")],
)  # fmt: skip
def test_markups_that_are_no_open_curves_are_refused_or_left_out_with_a_note(tmp_path, kind, mend):
    other = markup(arc(), RADIUS, type=kind, label="B")
    with pytest.raises(InputError, match=rf"{kind} 'B' is no centerline: .*{mend}"):
        read_source(written(tmp_path, other))
    source = read_source(written(tmp_path, markup(arc(), RADIUS), other))
    assert isinstance(source.content, Polylines) and len(source.content.points) == 1
    assert source.notes == (f"{kind} 'B' is no centerline, and is left out",)


def test_curves_and_lines_of_one_file_are_all_read(tmp_path):
    line = markup(np.array([[0.0, 0, 0], [0, 0, 40]]), np.array([1.0, 1.0]), type="Line")
    source = read_source(written(tmp_path, markup(arc(), RADIUS), markup(arc() + 9, RADIUS), line))
    assert isinstance(source.content, Polylines) and len(source.content.points) == 3 and source.notes == ()


def test_the_curves_of_a_folder_are_one_tree_coarse_lines_and_a_loop_are_noted(tmp_path):
    """Two arteries leave a trunk and meet again; one is coarse: neighbouring spheres do not touch."""
    folder = tmp_path / "curves"
    folder.mkdir()
    turn = np.linspace(0.0, np.pi, 61)[:, None]
    side = np.hstack([np.sin(turn), np.zeros_like(turn), 1.5 - 1.5 * np.cos(turn)]) * 20
    trunk = np.linspace([0.0, 0, -40], [0, 0, 0], 41)
    for name, line, size in (("trunk", trunk, 3.0), ("left", side, 1.0), ("right", side[::6] * [-1, 1, 1], 1.0)):
        text = json.dumps({"markups": [markup(line, np.full(len(line), size), coordinateSystem="LPS")]})
        (folder / f"{name}.mrk.json").write_text(text)
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
    (loop,) = [note for note in notes if "close a loop" in note]
    around = 2 * float(np.linalg.norm(np.diff(side, axis=0), axis=1).sum())
    assert abs(float(loop.split("loop of ")[1].split(" mm")[0]) - around) < 0.05 * around
    other = tmp_path / "empty"
    other.mkdir()
    with pytest.raises(InputError, match=r"empty: holds no curves \(\.mrk\.json\); give"):
        read_source(other)


@pytest.mark.parametrize("status", ["undefined", "missing", "preview"])
def test_control_points_without_a_position_are_left_out_with_their_radii(tmp_path, status):
    curve = markup(arc(), np.linspace(1, 2, 60))
    curve["controlPoints"][7] = {"positionStatus": status}  # pyright: ignore[reportIndexIssue]
    source = read_source(written(tmp_path, curve))
    assert isinstance(source.content, Polylines)
    np.testing.assert_allclose(source.content.points[0], np.delete(arc(), 7, axis=0))
    np.testing.assert_allclose(source.content.radius[0], np.delete(np.linspace(1, 2, 60), 7))
    assert source.notes == ("curve 'curve': 1 control points without a position are left out",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controlPoints": []}, "0 control points"),
        ({"controlPoints": "many"}, "0 control points"),
        ({"controlPoints": [{"position": [1, 2]}] * 60}, "shape"),
        ({"controlPoints": [{"position": ["a", 2, 3]}] * 60}, "no numeric position"),
        ({"controlPoints": [{"position": [10**400, 2, 3]}] * 60}, "no numeric position"),
        ({"controlPoints": [{"position": None}] * 60}, "no numeric position"),
        ({"controlPoints": [17] * 60}, "no numeric position"),
        ({"measurements": []}, "no radius measurement"),
        ({"measurements": 3}, "no radius measurement"),
        ({"measurements": [{"name": "Radius", "controlPointValues": [1.0] * 9}]}, "9 radii for 60 control points"),
        ({"measurements": [{"name": "Radius", "controlPointValues": ["x"] * 60}]}, "a radius is no number"),
        ({"measurements": [{"name": "Radius", "controlPointValues": [-1.0] * 60}]}, "mm is -1 "),
        ({"measurements": [{"name": "Radius", "controlPointValues": [0.0] * 60}]}, "radii are zero"),
        ({"measurements": [{"name": "Radius", "controlPointValues": [float("nan")] * 60}]}, "mm is nan "),
    ],
)
def test_damaged_curves_are_refused_in_one_line(tmp_path, change, message):
    path = written(tmp_path, markup(arc(), RADIUS) | change)
    with pytest.raises(InputError, match=message) as error:
        read_source(path)
    assert "cl.mrk.json" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("content", ["[]", "{}", '{"markups": {}}', '{"markups": [3]}', '{"markups": []}', "3", "null"])
def test_json_without_markups_is_refused(tmp_path, content):
    (tmp_path / "cl.mrk.json").write_text(content)
    with pytest.raises(InputError, match="holds no Slicer markups"):
        read_source(tmp_path / "cl.mrk.json")
