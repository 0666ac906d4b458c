"""What a file holds besides a plain lumen in mm: a dome, a wall with a thickness, closed tubes that overlap, cm."""

from __future__ import annotations

import re

import numpy as np
import pytest
import pyvista
from make_meshes import write_lines
from make_vessels import line, tubes

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.atlas.atlas import VESSELS, AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.types import LumenMask, Volume
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import ASSUMED, Polylines, check_unit
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
    [(5.5, 2.2, 18.0, "surface"), (7.0, 2.0, 36.0, "mask")],
)
def test_the_device_does_not_enter_through_an_aneurysm(size, neck, at_mm, kind):
    mask = with_dome(size, neck, at_mm)
    source = LumenMask(mask) if kind == "mask" else surface_from_mask(mask)
    anatomy = extract_anatomy(source, name="dome", config=COARSE)
    place = anatomy.insertion.position
    assert place[2] < 4.0 and np.linalg.norm(place) < 6.0
    said = (
        r"Understood: enters at .* mm wide; .* mm to the farthest end, .* mm wide at the narrowest; read as mm in LPS"
    )
    assert re.fullmatch(said, anatomy.provenance["notes"][0])


def test_lines_into_a_dome_begin_at_the_vessel_inlet():
    trunk = line((0, 0, 0), (0, 4, 40))
    dome = trunk[-1] + np.outer(np.linspace(0, 12, 60), [0, 0.2, 0.98])
    size = np.maximum(np.sqrt(np.maximum(30 - (np.linspace(0, 12, 60) - 6.5) ** 2, 0)), 1.3)
    arms = [trunk[-1] + np.outer(np.linspace(0, 25, 60), side) for side in ([1, 0, 0.2], [-1, 0, 0.3])]
    ends = [(arms[0], np.full(60, 1.4)), (arms[1], np.full(60, 1.2)), (dome, size)]
    lines = [(np.concatenate([trunk, end]), np.concatenate([np.full(len(trunk), 2.1), width])) for end, width in ends]
    found = extract_anatomy(Polylines(*map(tuple, zip(*lines, strict=True))), name="dome", config=COARSE)
    assert np.linalg.norm(found.insertion.position) < 1.0


@pytest.mark.parametrize(("ends", "kind"), [("both open", "mask"), ("one open", "surface"), ("closed", "mask")])
def test_the_lumen_of_a_wall_is_taken(ends, kind):
    lines = [(line((0, 0, 0), (2, 1, 25), (0, 0, 50)), 2.6), (line((2, 1, 25), (20, 4, 40)), 1.9)]
    whole = tubes(*[(points, radius + 1.5) for points, radius in lines], voxel_mm=(0.6, 0.6, 0.6))
    lumen = np.zeros_like(whole.voxels)
    inner = tubes(*lines, voxel_mm=(0.6, 0.6, 0.6))
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
    parts = [surface_from_mask(tubes((points, radius), voxel_mm=(0.6, 0.6, 0.6))) for points, radius in (
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
    for index in range(2):
        tree, _ = make_patient_tree(AtlasConfig(vessel=vessel, count=2, seed=5), index)
        points, radius = tree.line.points, float(np.median(tree.line.radius))
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


def test_a_phantom_that_could_be_an_aorta_in_cm_is_asked_for_unless_its_artery_is_named():
    points = np.array([[0.0, 0.0, 0.0], [43.0, 41.0, 0.0]])
    with pytest.raises(InputError, match=r"0\.95 mm in mm \(--scale 1\), or .*9\.5 mm in cm \(--scale 10\)"):
        check_unit(points, 0.95, "generic", "phantom", odds=ASSUMED)
    check_unit(points, 0.95, "rca", "phantom", odds=ASSUMED)


@pytest.mark.parametrize(("place", "value"), [(slice(-3, None), np.nan), (slice(-3, None), -1.5), (40, np.nan)])
def test_radii_that_are_none_are_that_before_at_an_end_and_named_elsewhere(tmp_path, place, value):
    axis = line((0, 0, 0), (0, 0, 60))
    radius = np.full(len(axis), 1.8)
    radius[place] = value
    path = write_lines(tmp_path / "a.vtp", [axis], [radius])
    if place == 40:
        with pytest.raises(InputError, match=r"line 0: the radius at \(.*\) mm is nan"):
            read_source(path)
    else:
        source = read_source(path)
        np.testing.assert_allclose(source.content.radius[0], 1.8)
        assert any("line 0: its last 3 radii are none" in note for note in source.notes)


def test_a_volume_mesh_of_vtk_is_read(tmp_path):
    grid = pyvista.Cylinder(radius=2.0, height=60.0, resolution=24).triangulate().delaunay_3d()
    grid.save(tmp_path / "mesh.vtu")
    assert isinstance(read_source(tmp_path / "mesh.vtu").content, Surface)


@pytest.mark.parametrize(
    ("suffix", "word"),
    [(".csv", "Polylines"), (".swc", "VTP"), (".fcsv", "mrk.json"), (".ctgr", "VTU"), (".glb", "STL")],
)
def test_a_kind_that_is_not_read_is_told_how_to_convert(tmp_path, suffix, word):
    (tmp_path / f"tree{suffix}").write_text("x")
    with pytest.raises(InputError, match=f"unknown kind of file; .*{word}"):
        read_source(tmp_path / f"tree{suffix}")
