"""Centerlines as other programs write them; domes, walls with a thickness, tubes that overlap, and units."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import pyvista
from hypothesis import given, settings
from hypothesis import strategies as st
from make_meshes import write_lines
from make_vessels import line, tubes

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.tree import tree_from_lines
from endopilot.atlas.atlas import VESSELS, AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.types import LumenMask, Volume
from endopilot.vessels.line_graph import found_lines
from endopilot.vessels.sources import ASSUMED, Polylines, check_unit, read_source
from endopilot.vessels.surface import Surface, surface_from_mask


class Made:
    """The tree that lines become, with the notes and the balance."""

    def __init__(self, lines, radii=None, vessel="generic"):
        sizes = tuple(np.full(len(line), size) for line, size in zip(lines, radii or [1.5] * len(lines), strict=True))
        found = found_lines(Polylines(tuple(lines), sizes), None, "lines.vtp", vessel)
        self.tree, self.notes, self.coverage = tree_from_lines(found.lines), found.notes, found.coverage


def helix(count=240):
    turn = np.linspace(0.0, 2 * np.pi, count)
    return np.column_stack([15 * np.cos(turn), 15 * np.sin(turn), 6 * turn])


def straight(first, last, count=100):
    return np.linspace(first, last, count)


@pytest.mark.parametrize("line", [helix(), helix()[::-1], np.concatenate([helix(), helix()[::-1]])])
def test_points_in_order_are_left_as_they_are(line):
    assert Made([line]).notes == []


def test_one_line_through_a_whole_tree_is_that_tree():
    trunk, branch = straight([0, 0, 0], [0, 0, 60], 121), straight([0, 0, 30], [20, 0, 60])
    found = Made([np.concatenate([trunk, trunk[60:][::-1], branch])])
    assert len(found.tree.leaves()) == 2 and found.notes == []
    assert len(Made([np.concatenate([trunk, trunk[::-1]])]).tree.branches) == 1  # there and back


@pytest.mark.parametrize("step_mm", [4.0, 9.0, 20.0])
def test_coarse_lines_are_joined_by_straight_pieces_and_noted(step_mm):
    line = np.outer(np.arange(0, 100.1, step_mm), [0.0, 0.6, 0.8])
    found = Made([line])
    length = np.linalg.norm(line[-1] - line[0])
    assert abs(found.tree.longest_path().abscissa[-1] - length) < 1e-6
    assert len(found.notes) == 1 and f"the longest step, {step_mm:.1f} mm" in found.notes[0]


TURN = np.linspace(0.0, 2 * np.pi, 300)
RING = np.column_stack([20 * np.cos(TURN), 20 * np.sin(TURN), 0 * TURN])


@given(
    pieces=st.lists(
        st.tuples(
            st.tuples(*[st.floats(-40, 40)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(3, 60),
            st.floats(0.5, 4.0),
        ),
        min_size=1, max_size=5,
    )
)  # fmt: skip
@settings(max_examples=30, deadline=None, derandomize=True)
def test_covered_left_out_and_bridged_are_all_of_the_lines(pieces):
    lines, radii = [], []
    for start, heading, length, radius in pieces:
        unit = np.array(heading) + np.array([0, 0, 1.5])
        end = np.array(start) + length * unit / np.linalg.norm(unit)
        lines.append(straight(start, end, max(2, int(length / radius))))
        radii.append(radius)
    found = Made(lines, radii)
    lengths = found.coverage
    total = sum(length for _, _, length, _ in pieces)
    assert abs(lengths["length_mm"] - total) < 0.3
    assert abs(lengths["reached_mm"] + lengths["left_out_mm"] - lengths["length_mm"]) < 0.3
    # Lines that run together are said once, so what is said is at most what is left out.
    said = sum(float(m[1]) for note in found.notes if (m := re.search(r"([\d.]+) mm of line .*left out", note)))
    assert lengths["left_out_mm"] / len(pieces) - 5.0 <= said <= lengths["left_out_mm"] + 0.5
    bridged = sum(float(m[1]) for note in found.notes if (m := re.match(r"a gap of ([\d.]+) mm", note)))
    assert abs(bridged - lengths["bridged_mm"]) < 0.3


@pytest.mark.parametrize(
    ("other", "left_out_mm", "bridged_mm", "said"),
    [
        (straight([30, 0, 0], [30, 0, 40]), 40.0, 0.0, r"40\.0 mm of line at \(30\.0, .*\) mm is left out"),
        (straight([0, 0, 64], [0, 0, 90]), 0.0, 4.0, r"a gap of 4\.0 mm between lines at \(0\.0, 0\.0, 60\.0\) mm"),
    ],
)
def test_a_second_line_is_bridged_to_if_near_and_else_left_out(other, left_out_mm, bridged_mm, said):
    found = Made([straight([0, 0, 0], [0, 0, 60]), other])
    assert len(found.tree.branches) == 1
    assert found.coverage["left_out_mm"] == left_out_mm and found.coverage["bridged_mm"] == bridged_mm
    assert any(re.match(said, note) for note in found.notes)


def test_a_loop_is_open_in_the_tree_and_nothing_of_it_is_left_out():
    found = Made([RING, straight([20, 0, 0], [60, 0, 0])])
    assert found.coverage["left_out_mm"] < 1.0 and len(found.tree.leaves()) == 2


def test_the_longer_of_two_pieces_is_taken_though_the_other_is_wider():
    found = Made([straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 30])], [1.0, 2.0])
    assert abs(found.tree.longest_path().abscissa[-1] - 90) < 0.5


def test_lines_of_two_coronary_arteries_are_refused_with_both_places():
    both = [straight([0, 0, 0], [0, 0, 90]), straight([40, 0, 0], [40, 0, 80])]
    with pytest.raises(InputError, match=r"two trees that are not connected.*--ostium-mm"):
        Made(both, vessel="rca")


def test_the_root_is_an_end_and_no_place_that_a_vessel_passes():
    lines = [straight([0, 0, 0], [0, 0, 40]), straight([0, 0, 40], [0, 0, 80]), straight([0, 0, 40], [30, 0, 60])]
    assert np.abs(Made(lines).tree.branches[0].centerline.points[0, 2] - 40) > 15


DATA = Path(__file__).parents[3] / "shared" / "data"
PARENT = "lies in the parent vessel that the lines start in"


@pytest.mark.skipif(not DATA.exists(), reason="the real patients' centerlines are not at hand")
@pytest.mark.parametrize(
    ("file", "vessel", "leaves", "said"),
    [
        ("coronary_centerlines/rca_cl.vtp", "rca", 3, PARENT),
        ("coronary_centerlines/lca_cl.vtp", "lca", 3, PARENT),
        ("liver_tace/tace-lps-0.75mm.vtp", "generic", 40, PARENT),
        ("steve_bench/dualdevicenav", "generic", 10, "do not touch"),
    ],
)
def test_real_lines_are_covered_but_for_their_parent_vessel(file, vessel, leaves, said):
    anatomy = extract_anatomy(DATA / file, config=AnatomyConfig(vessel=vessel, spacing_mm=3.0))
    assert len(anatomy.tree.leaves()) >= leaves
    assert any(said in note for note in anatomy.provenance["notes"])
    assert not any("no line leads there" in note for note in anatomy.provenance["notes"])
    if said != PARENT:
        assert anatomy.provenance["coverage"]["left_out_mm"] < 1.0
        # The ascending aorta, which no vessel passes.
        assert np.linalg.norm(anatomy.insertion.position - [-367.5, 3.9, -10.2]) < 1.0


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
