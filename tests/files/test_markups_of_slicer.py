"""Open curves with radii are centerlines; other markups are refused, or left out with a note beside curves."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_meshes import arc, markup

from endopilot.anatomy.extract import extract_anatomy
from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines

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
