"""What a file holds besides a plain lumen in mm: a dome, a wall with a thickness, closed tubes that overlap, cm."""

from __future__ import annotations

import re

import numpy as np
import pytest
import pyvista
from make_meshes import arc, tube, write_lines
from make_vessels import line, tubes

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.atlas.atlas import VESSELS, AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.types import LumenMask, Volume
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import ASSUMED, Polylines, check_unit, transformed
from endopilot.vessels.surface import Surface, surface_from_mask

COARSE = AnatomyConfig(spacing_mm=0.8)


def cut(mask: Volume, height_mm: float) -> Volume:
    """Return a mask without what lies below a height, as a field of view cuts it."""
    voxels = mask.voxels.copy()
    voxels[: int(np.ceil((height_mm - mask.origin_mm[2]) / mask.spacing_mm[2]))] = False
    return Volume(voxels, mask.spacing_mm, mask.origin_mm, mask.direction)


def with_dome(size: float, neck: float, at_mm: float) -> Volume:
    """Return a bent vessel of 2.4 mm radius that forks into thinner ones, with a dome on its side."""
    trunk = line((0, 0, -6), (3, 2, 22), (0, 0, 44))
    base = trunk[np.abs(trunk[:, 2] - at_mm).argmin()]
    centre = base + np.array([0.0, 1.0, 0.0]) * (2.4 + np.sqrt(size**2 - neck**2))
    arms = [(line((0, 0, 44), (18, 3, 56)), 1.4), (line((0, 0, 44), (-16, 5, 54)), 1.2)]
    dome = (line(base, centre), neck), (np.array([centre, centre]), size)
    return cut(tubes((trunk, 2.4), *arms, *dome, voxel_mm=(0.45, 0.45, 0.45)), 0.0)


@pytest.mark.parametrize(
    ("size", "neck", "at_mm", "kind"),
    [(3.5, 1.7, 30.0, "mask"), (5.5, 2.2, 18.0, "surface"), (7.0, 2.0, 36.0, "mask")],
)
def test_the_device_does_not_enter_through_an_aneurysm(size, neck, at_mm, kind):
    mask = with_dome(size, neck, at_mm)
    source = LumenMask(mask) if kind == "mask" else surface_from_mask(mask)
    place = extract_anatomy(source, name="dome", config=COARSE).insertion.position
    assert place[2] < 4.0 and np.linalg.norm(place) < 6.0


@pytest.mark.parametrize("turned", [1, -1])
def test_lines_into_a_dome_begin_at_the_vessel_inlet(turned):
    trunk = line((0, 0, 0), (0, 4, 40))
    dome = trunk[-1] + np.outer(np.linspace(0, 12, 60), [0, 0.2, 0.98])
    size = np.maximum(np.sqrt(np.maximum(30 - (np.linspace(0, 12, 60) - 6.5) ** 2, 0)), 1.3)
    arms = [trunk[-1] + np.outer(np.linspace(0, 25, 60), side) for side in ([1, 0, 0.2], [-1, 0, 0.3])]
    ends = [(arms[0], np.full(60, 1.4)), (arms[1], np.full(60, 1.2)), (dome, size)]
    lines = [
        (np.concatenate([trunk, end])[::turned], np.concatenate([np.full(len(trunk), 2.1), width])[::turned])
        for end, width in ends
    ]
    found = extract_anatomy(Polylines(*map(tuple, zip(*lines, strict=True))), name="dome", config=COARSE)
    assert np.linalg.norm(found.insertion.position) < 1.0


def test_ends_that_look_alike_are_named_with_their_widths():
    mask = cut(tubes((line((-15, 0, 0), (0, 0, 25), (0, 0, 60)), 2.0), (line((15, 0, 0), (0, 0, 25)), 2.0)), 2.0)
    notes = extract_anatomy(LumenMask(mask), name="two", config=COARSE).provenance["notes"]
    (note,) = [note for note in notes if "could be an inlet too" in note]
    places = [float(x) for x in re.findall(r"at \((-?[\d.]+),", note)] + [
        float(x) for x in re.findall(r"is \((-?[\d.]+),", note)
    ]
    assert sorted(np.sign(places)) == [-1, 1] and len(re.findall(r"\(\d\.\d mm wide\)", note)) == 2
    assert "--ostium-mm chooses" in note


@pytest.mark.parametrize(
    ("ends", "kind"), [("both open", "mask"), ("one open", "surface"), ("closed", "mask"), ("closed", "surface")]
)
def test_the_lumen_of_a_wall_is_taken(ends, kind):
    lines = [(line((0, 0, 0), (2, 1, 25), (0, 0, 50)), 2.6), (line((2, 1, 25), (20, 4, 40)), 1.9)]
    whole = tubes(*[(points, radius + 1.5) for points, radius in lines])
    lumen = np.zeros_like(whole.voxels)
    inner = tubes(*lines)
    corner = np.rint((inner.origin_mm - whole.origin_mm) / whole.spacing_mm).astype(int)[::-1]
    lumen[tuple(slice(a, a + n) for a, n in zip(corner, inner.voxels.shape, strict=True))] = inner.voxels
    wall = Volume(whole.voxels & ~lumen, whole.spacing_mm, whole.origin_mm, whole.direction)
    if ends != "closed":
        wall = cut(wall, 1.0)
    if ends == "both open":
        wall.voxels[int((49.0 - wall.origin_mm[2]) / wall.spacing_mm[2]) :] = False
    source = LumenMask(wall) if kind == "mask" else surface_from_mask(wall)
    anatomy = extract_anatomy(source, name="phantom", config=COARSE)
    assert len(anatomy.tree.leaves()) == 2
    assert abs(float(np.median(anatomy.tree.branches[0].centerline.radius)) - 2.6) < 0.35
    assert re.search(r"is a wall of [12]\.\d mm", " ".join(anatomy.provenance["notes"]))


def test_closed_tubes_that_overlap_are_one_vessel():
    parts = [surface_from_mask(tubes((points, radius))) for points, radius in (
        (line((0, 0, 0), (0, 0, 50)), 2.5), (line((0, 0, 20), (18, 0, 38)), 1.6), (line((0, 0, 35), (-15, 3, 48)), 1.5),
    )]  # fmt: skip
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, first, strict=False)])
    whole = Surface(np.concatenate([part.vertices for part in parts]), faces)
    anatomy = extract_anatomy(whole, name="cad", config=COARSE)
    assert len(anatomy.tree.leaves()) == 3
    assert any("3 closed surfaces overlap" in note for note in anatomy.provenance["notes"])


@pytest.mark.parametrize("vessel", VESSELS)
def test_vessels_in_mm_pass_unasked_and_none_in_cm_or_m_passes(vessel):
    for index in range(4):
        tree, _ = make_patient_tree(AtlasConfig(vessel=vessel, count=4, seed=5), index)
        lines = [branch.centerline for branch in tree.branches]
        points, radius = (
            np.concatenate([one.points for one in lines]),
            float(np.median(np.concatenate([one.radius for one in lines]))),
        )
        for asked in {"generic", vessel if vessel in ("rca", "lca") else "generic"}:
            check_unit(points, radius, asked, vessel, odds=ASSUMED)
            for factor in (10.0, 1000.0):
                with pytest.raises(InputError, match=f"--scale {factor:g}"):
                    check_unit(points / factor, radius / factor, asked, vessel, odds=ASSUMED)


def test_an_aorta_in_cm_is_asked_for_with_both_sizes_and_an_answer_counts(tmp_path):
    axis = line((0, 0, 0), (30, 40, 200), (0, 20, 390)) / 10
    path = write_lines(tmp_path / "aorta.vtp", [axis], [np.linspace(1.3, 0.9, len(axis))])
    with pytest.raises(InputError, match=r"39\.3 mm .*in mm \(--scale 1\), or .*393 mm .*in cm \(--scale 10\)"):
        extract_anatomy(path)
    for scale in (1.0, 10.0):
        made = extract_anatomy(path, config=AnatomyConfig(scale=scale))
        assert abs(made.tree.longest_path().abscissa[-1] - scale * 40) < 3 * scale
    assert "read as cm (--scale) in LPS (not stated)" in made.provenance["notes"][0]


def test_arrays_of_simvascular_state_cm_unless_the_user_knows_better(tmp_path):
    vertices, faces = tube(arc())
    mesh = pyvista.PolyData(vertices / 10, np.insert(faces, 0, 3, axis=1).ravel())
    mesh.cell_data["ModelFaceID"] = np.ones(len(faces), dtype=np.int32)
    mesh.save(tmp_path / "model.vtp")
    source = read_source(tmp_path / "model.vtp")
    np.testing.assert_allclose(np.ptp(source.content.vertices, axis=0), np.ptp(vertices, axis=0), rtol=1e-4)
    assert any("ModelFaceID" in note and "cm" in note for note in source.notes)
    kept = transformed(source, scale=1.0, coordinates=None).content
    np.testing.assert_allclose(np.ptp(kept.vertices, axis=0), np.ptp(vertices, axis=0) / 10, rtol=1e-4)


def test_a_volume_mesh_of_vtk_is_read(tmp_path):
    grid = pyvista.Cylinder(radius=2.0, height=60.0, resolution=24).triangulate().delaunay_3d()
    grid.save(tmp_path / "mesh.vtu")
    assert isinstance(read_source(tmp_path / "mesh.vtu").content, Surface)


@pytest.mark.parametrize(
    ("suffix", "word"), [(".swc", "VTP"), (".fcsv", "mrk.json"), (".ctgr", "VTU"), (".glb", "STL")]
)
def test_a_kind_that_is_not_read_is_told_how_to_convert(tmp_path, suffix, word):
    (tmp_path / f"tree{suffix}").write_text("x")
    with pytest.raises(InputError, match=f"unknown kind of file; .*{word}"):
        read_source(tmp_path / f"tree{suffix}")


def test_radii_that_are_none_are_taken_from_the_neighbour_at_an_end_and_named_elsewhere(tmp_path):
    axis, radius = line((0, 0, 0), (0, 0, 60)), np.full(302, 1.8)[: len(line((0, 0, 0), (0, 0, 60)))]
    ending, between, negative = radius.copy(), radius.copy(), radius.copy()
    ending[-3:], between[40], negative[-1] = np.nan, np.nan, -1.5
    source = read_source(write_lines(tmp_path / "a.vtp", [axis], [ending]))
    assert isinstance(source.content, Polylines)
    np.testing.assert_allclose(source.content.radius[0], 1.8)
    assert any("line 0: the radius of 3 points at its end" in note for note in source.notes)
    for name, bad, value in (("b.vtp", between, "nan"), ("c.vtp", negative, "-1.5")):
        with pytest.raises(InputError, match=rf"line 0: the radius at \(.*\) mm is {value}"):
            read_source(write_lines(tmp_path / name, [axis], [bad]))


def test_what_was_understood_is_said_in_one_sentence_first():
    mask = cut(tubes((line((0, 0, -4), (0, 0, 60)), 2.0), (line((0, 0, 80), (0, 0, 110)), 2.0)), 0.0)
    anatomy = extract_anatomy(LumenMask(mask), name="pipe", config=COARSE)
    found = re.fullmatch(
        r"Understood: enters at \((.*)\) mm, (.*) mm wide; (.*) mm to the farthest end, (.*) mm wide at the narrowest; "
        r"read as mm in LPS", anatomy.provenance["notes"][0],
    )  # fmt: skip
    assert found is not None
    line_of = anatomy.tree.branches[0].centerline
    np.testing.assert_allclose([float(x) for x in found[1].split(",")], line_of.points[0], atol=0.06)
    assert abs(float(found[2]) - 4.0) < 0.5 and abs(float(found[3]) - 61) < 3 and abs(float(found[4]) - 4.0) < 0.5
