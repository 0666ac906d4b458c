"""A unit that a file states is obeyed; one that its size tells is named with its `--scale`, and so are all that fit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_meshes import arc, markup, tube, write_surface

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines, check_unit, transformed
from endopilot.vessels.surface import Surface

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


def test_what_is_longer_than_any_body_is_refused():
    line = np.outer(np.linspace(0, 1e9, 50), [0, 0, 1.0])
    with pytest.raises(InputError, match="as no vessel does"):
        extract_anatomy(Polylines((line,), (np.full(50, 1.5),)), name="far")


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
