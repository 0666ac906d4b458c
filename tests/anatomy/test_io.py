"""An anatomy on disk: exact round trip, and one line for every damage."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.anatomy.analytic_lumens import forked_tree
from endopilot.anatomy.catheter_axis import with_world_zero
from endopilot.anatomy.distance import add_catheter, distance_map_from_spheres
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.errors import InputError
from endopilot.types import Anatomy, Branch, Centerline, DistanceMap, Insertion, VesselTree


@pytest.fixture
def anatomy():
    tree = forked_tree()
    insertion = Insertion(tree.branches[0].centerline.points[0], np.array([0.1, 0.2, np.sqrt(0.95)]))
    lumen = add_catheter(distance_map_from_spheres(tree, spacing_mm=0.7 / 1.3), insertion, 1.5, 8.0)
    return Anatomy("patient", tree, lumen, insertion, 1.5, {"source": {"file": "x.nii.gz"}, "notes": []})


def test_round_trip_is_exact(anatomy, tmp_path):
    import pyvista
    import SimpleITK

    write_anatomy(anatomy, output=tmp_path / "a")
    lines = pyvista.read(tmp_path / "a" / "centerline.vtp")  # other programs read it too
    assert lines.n_lines == 3 and "MaximumInscribedSphereRadius" in lines.point_data
    image = SimpleITK.ReadImage(str(tmp_path / "a" / "lumen.nrrd"))
    assert np.allclose(image.GetOrigin(), anatomy.distance_map.origin_mm)
    back = read_anatomy(tmp_path / "a")
    assert back.name == anatomy.name and back.catheter_radius_mm == 1.5 and back.provenance == anatomy.provenance
    assert np.array_equal(back.insertion.direction, anatomy.insertion.direction)
    assert np.array_equal(back.distance_map.values, anatomy.distance_map.values)
    assert np.array_equal(back.distance_map.origin_mm, anatomy.distance_map.origin_mm)
    assert back.distance_map.spacing_mm == anatomy.distance_map.spacing_mm
    assert back.tree.section_names == anatomy.tree.section_names
    for one, two in zip(back.tree.branches, anatomy.tree.branches, strict=True):
        assert one.parent == two.parent and np.array_equal(one.section, two.section)
        for name in ("points", "radius", "abscissa", "normals"):
            assert np.array_equal(getattr(one.centerline, name), getattr(two.centerline, name))


def test_identity_is_that_of_the_vessel_in_memory_as_on_disk(anatomy, tmp_path):
    double = replace(anatomy.distance_map, values=anatomy.distance_map.values.astype(float) * (1 + 1e-12))
    made = replace(anatomy, distance_map=double)  # more digits than the disk keeps
    write_anatomy(made, output=tmp_path / "a")
    assert read_anatomy(tmp_path / "a").identity == made.identity == anatomy.identity
    assert replace(anatomy, name="other", provenance={}).identity == anatomy.identity


def test_identity_changes_with_everything_that_affects_a_wire(anatomy):
    field, insertion, (root, *others) = anatomy.distance_map, anatomy.insertion, anatomy.tree.branches
    values = field.values.copy()
    values[2, 3, 4] += 1e-3
    wider = replace(root, centerline=replace(root.centerline, radius=root.centerline.radius + 1e-3))
    fields = (
        {"values": values}, {"spacing_mm": field.spacing_mm * 1.001}, {"origin_mm": field.origin_mm + 1e-3},
        {"values": field.values.reshape(field.values.shape[::-1])},
    )  # fmt: skip
    enters = {"position": insertion.position + 1e-3}, {"direction": -insertion.direction}
    changed = [
        *(replace(anatomy, distance_map=replace(field, **change)) for change in fields),
        *(replace(anatomy, insertion=replace(insertion, **change)) for change in enters),
        replace(anatomy, catheter_radius_mm=1.4),
        replace(anatomy, tree=replace(anatomy.tree, branches=(wider, *others))),
    ]
    assert len({anatomy.identity, *(other.identity for other in changed)}) == 1 + len(changed)


@pytest.mark.parametrize("file", ["centerline.vtp", "lumen.nrrd"])
def test_a_changed_file_is_refused(anatomy, tmp_path, file):
    write_anatomy(anatomy, output=tmp_path / "a")
    content = (tmp_path / "a" / file).read_bytes()
    for changed in (content[:-1], content[:100] + b"x" + content[101:]):
        (tmp_path / "a" / file).write_bytes(changed)
        with pytest.raises(InputError, match=rf"{file}: differs from what anatomy\.json records"):
            read_anatomy(tmp_path / "a")


@pytest.mark.parametrize("odd", [None, 7, -1, "x", [], {}, [1.0, 2.0, 3.0], float("nan")])
def test_a_record_with_an_odd_entry_is_refused_in_one_line_or_means_the_same(anatomy, tmp_path, odd):
    write_anatomy(anatomy, output=tmp_path / "a")
    path = tmp_path / "a" / "anatomy.json"
    record = json.loads(path.read_text())
    changes = [{name: odd} for name in record] + [{"insertion": record["insertion"] | {"position_mm": odd}}]
    for change in changes:
        path.write_text(json.dumps(record | change))
        try:
            assert read_anatomy(tmp_path / "a").identity == anatomy.identity
        except InputError as error:
            assert str(error).startswith(str(tmp_path))


def test_writing_again_replaces_an_anatomy_but_nothing_else(anatomy, tmp_path):
    write_anatomy(anatomy, output=tmp_path / "a")
    write_anatomy(anatomy, output=tmp_path / "a")
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("dear")
    with pytest.raises(InputError, match=r"other: is not empty and holds no anatomy\.json"):
        write_anatomy(anatomy, output=other)
    assert (other / "thesis.txt").read_text() == "dear"


def test_other_versions_and_what_is_missing_are_refused(anatomy, tmp_path):
    for file, said in (
        ("centerline.vtp", "is missing"),
        ("lumen.nrrd", "is missing"),
        ("anatomy.json", "not an anatomy"),
    ):
        folder = tmp_path / f"no {file}"
        write_anatomy(anatomy, output=folder)
        (folder / file).unlink()
        with pytest.raises(InputError, match=said):
            read_anatomy(folder)
    write_anatomy(anatomy, output=tmp_path / "a")
    path = tmp_path / "a" / "anatomy.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"schema_version": 99}))
    with pytest.raises(InputError, match="schema_version is 99"):
        read_anatomy(tmp_path / "a")
    del record["insertion"]
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match="insertion"):
        read_anatomy(tmp_path / "a")
    with pytest.raises(InputError, match="no such folder"):
        read_anatomy(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"it holds anatomies, so give .*/\*$"):
        read_anatomy(tmp_path)


def test_the_zero_of_the_rotation_is_kept_and_decides_the_identity(anatomy, tmp_path):
    zero = anatomy.insertion.rotation_zero
    write_anatomy(anatomy, output=tmp_path / "a")
    back = read_anatomy(tmp_path / "a").insertion.rotation_zero
    assert isinstance(back, np.ndarray) and np.array_equal(back, zero)
    other = replace(anatomy, insertion=replace(anatomy.insertion, rotation_zero=-zero))
    assert len({anatomy.identity, other.identity, with_world_zero(anatomy).identity}) == 3
    record = json.loads((tmp_path / "a" / "anatomy.json").read_text())
    for bad in ([1.0, 0.0], "up", None, 3, [[1.0, 0.0, 0.0]]):
        record["insertion"]["rotation_zero"] = bad
        (tmp_path / "a" / "anatomy.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match=r"anatomy\.json: damaged"):
            read_anatomy(tmp_path / "a")


def test_a_record_of_schema_version_1_keeps_the_zero_of_the_world_axes(anatomy, tmp_path):
    before = with_world_zero(anatomy)
    write_anatomy(before, output=tmp_path / "a")
    path = tmp_path / "a" / "anatomy.json"
    record = json.loads(path.read_text())
    del record["insertion"]["rotation_zero"]
    path.write_text(json.dumps(record | {"schema_version": 1}))
    back = read_anatomy(tmp_path / "a")
    assert back.insertion.rotation_zero == "world axes" and back.identity == before.identity
    write_anatomy(back, output=tmp_path / "b")
    again = read_anatomy(tmp_path / "b")
    assert again.insertion.rotation_zero == "world axes" and again.identity == before.identity


def test_the_identity_of_an_anatomy_without_a_zero_is_that_of_earlier_versions():
    points = np.arange(12.0).reshape(4, 3)
    line = Centerline(points, np.ones(4), np.arange(4.0), np.eye(3)[[0, 0, 0, 0]])
    tree = VesselTree((Branch(line, -1, np.zeros(4, dtype=np.int64)),), ("vessel",))
    lumen = DistanceMap(np.ones((2, 2, 2)), 0.5, np.zeros(3))
    insertion = Insertion(np.zeros(3), np.array([0.0, 0.6, 0.8]), "world axes")
    assert Anatomy("one", tree, lumen, insertion, 0.9).identity == (
        "c1b5cfc73a69637711ce04d4dca993d387197903a86cd365be9db6047e66e943"
    )
