"""Axes that a mesh or centerline states are obeyed; others given are refused; where none is stated, that is noted."""

from __future__ import annotations

import json

import numpy as np
import pytest
from make_meshes import SLICER, arc, markup, tube, write_lines, write_surface

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines, transformed
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


def test_axes_given_for_a_mask_are_refused(tmp_path):
    from endopilot.imaging.volume import write_volume
    from endopilot.types import Volume

    voxels = np.zeros((30, 10, 10), dtype=np.uint8)
    voxels[2:28, 3:7, 3:7] = 1
    write_volume(Volume(voxels, np.ones(3), np.zeros(3), np.eye(3)), tmp_path / "mask.nii.gz")
    with pytest.raises(InputError, match=r"mask\.nii\.gz: --coordinates ras was given, but the file is a mask"):
        extract_anatomy(tmp_path / "mask.nii.gz", config=AnatomyConfig(coordinates="ras"))
