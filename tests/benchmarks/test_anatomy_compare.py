"""Every quantity of the comparison against closed forms: circles, helices, known forks; and the table's distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.anatomy.compare import compare_with_atlas, compared, scaled_distance, together
from benchmarks.anatomy.vessel_shape import curvature_and_torsion, vessel_shape
from endopilot.anatomy.distance import distance_map_from_spheres
from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.labels_tree import LCA_SECTIONS, RCA_SECTIONS
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.errors import InputError
from endopilot.types import Anatomy, Branch, Insertion, VesselTree


def anatomy_of(lines, *, names=RCA_SECTIONS, direction=None, beside=(), **sections):
    """Return an anatomy of lines that leave each other; `sections` names those of its branches by their index."""
    tree = tree_from_lines([Line(*line) for line in lines])
    branches = [
        Branch(b.centerline, b.parent, np.full(len(b.section), names.index(sections.get(f"branch_{i}", names[0]))))
        for i, b in enumerate(tree.branches)
    ]
    tree = VesselTree(tuple(branches), names)
    points = tree.branches[0].centerline.points
    first = points[1] - points[0] if direction is None else np.asarray(direction, dtype=float)
    return Anatomy(
        name="known",
        tree=tree,
        distance_map=distance_map_from_spheres(tree, beside=beside),
        insertion=Insertion(position=points[0], direction=first / np.linalg.norm(first)),
        catheter_radius_mm=0.9,
    )


def straight(start, direction, length_mm, step_mm=0.25):
    along = np.arange(0.0, length_mm + step_mm / 2, step_mm)
    return np.asarray(start, dtype=float) + along[:, None] * np.asarray(direction) / np.linalg.norm(direction)


def constant(points, radius):
    return np.full(len(points), float(radius))


def test_a_circle_has_its_curvature_turn_and_tortuosity():
    size = 12.0
    turn = np.linspace(0.0, 1.5 * np.pi, 400)
    circle = size * np.stack([np.cos(turn), np.sin(turn), np.zeros(400)], axis=1)
    shape = vessel_shape(anatomy_of([(circle, constant(circle, 1.5), -1, 0)]))
    # The blur of 2 mm shrinks a circle of radius R by exp(−σ²/2R²): 1.4 %.
    shrunk = np.exp(-0.5 * (2.0 / size) ** 2)
    assert shape["curvature p95, 1/mm"] == pytest.approx([1 / (size * shrunk)], rel=0.01)
    assert shape["largest κ·r"] == pytest.approx([1.5 / (size * shrunk)], rel=0.02)
    assert shape["median absolute torsion, 1/mm"][0] < 1e-3
    assert shape["total turn, °"] == pytest.approx([270 * (1 - 6.0 / (1.5 * np.pi * size)) / shrunk], rel=0.02)
    # An arc of 20 mm spans an angle of 20/R and a chord of 2R·sin(10/R).
    assert shape["tortuosity in 20 mm, p95"] == pytest.approx([10 / size / np.sin(10 / size)], rel=0.03)
    assert shape["curvature peaks > 0.2 in 100 mm"] == [0.0]
    assert shape["branches > 10 mm"] == [1.0] and shape["side-branch angle, °"] == []


def test_a_helix_has_its_curvature_and_torsion():
    # κ = a/(a² + b²), τ = b/(a² + b²) for radius a and rise b a radian.
    a, b = 8.0, 6.0
    turn = np.linspace(0.0, 4 * np.pi, 900)
    helix = np.stack([a * np.cos(turn), a * np.sin(turn), b * turn], axis=1)
    bends, twists, radius, _ = curvature_and_torsion(
        anatomy_of([(helix, constant(helix, 1.0), -1, 0)]).tree.longest_path()
    )
    # The blur shrinks a to a·exp(−σ²ω²/2), where ω = 1/√(a² + b²) is the turn a mm.
    small = a * np.exp(-0.5 * 4.0 / (a**2 + b**2))
    assert np.median(bends) == pytest.approx(small / (small**2 + b**2), rel=0.01)
    assert np.median(twists) == pytest.approx(b / (small**2 + b**2), rel=0.01)
    assert radius == pytest.approx(np.ones(len(radius)))


@pytest.mark.parametrize(("side", "gives_way"), [(60.0, 0.0), (35.0, 20.0), (95.0, 10.0)])
def test_a_fork_has_its_angles_and_calibre(side, gives_way):
    across = np.deg2rad([-gives_way, side])
    main = np.concatenate(
        [straight((0, 0, -30), (0, 0, 1), 30), straight((0, 0, 0), (np.sin(across[0]), 0, np.cos(across[0])), 50)[1:]]
    )
    branch = straight((0, 0, 0), (np.sin(across[1]), 0, np.cos(across[1])), 25)
    own = constant(branch, 1.2)
    own[0] = 2.0
    stub = straight((0, 0, -15), (0, 1, 0), 3.5)
    lines = [(main, constant(main, 2.0), -1, 0), (branch, own, 0, 120), (stub, constant(stub, 0.8), 0, 60)]
    shape = vessel_shape(anatomy_of(lines))
    assert shape["side-branch angle, °"] == pytest.approx([side], abs=0.5)
    assert shape["parent's deflection at branches, °"] == pytest.approx([gives_way], abs=0.5)
    assert shape["side / parent radius"] == pytest.approx([0.6], abs=0.01)
    # The stub of 3.5 mm makes no fork, and no branch.
    assert shape["branches > 10 mm"] == [2.0]


def test_the_left_mains_fork_is_measured_by_its_sections():
    main = straight((0, 0, 0), (1, 0, 0), 8)
    lad = straight((8, 0, 0), (np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30)), 0), 60)
    lcx = straight((8, 0, 0), (np.cos(np.deg2rad(50)), -np.sin(np.deg2rad(50)), 0), 40)
    trunk = np.concatenate([main, lad[1:]])
    lines = [(trunk, constant(trunk, 2.2), -1, 0), (lcx, constant(lcx, 1.6), 0, len(main) - 1)]
    anatomy = anatomy_of(lines, names=LCA_SECTIONS, branch_0="5", branch_1="6", branch_2="11")
    shape = vessel_shape(anatomy)
    assert shape["LM→LAD turn, °"] == pytest.approx([30], abs=0.5)
    assert shape["LM→LCx turn, °"] == pytest.approx([50], abs=0.5)
    assert shape["LAD–LCx angle, °"] == pytest.approx([80], abs=0.5)
    assert shape["left main's length, mm"] == pytest.approx([8.0])
    assert shape["radius at the left main's fork, mm"] == pytest.approx([2.2])
    assert "LM→LAD turn, °" not in vessel_shape(anatomy_of(lines))


def test_the_distance_is_a_shift_in_standard_deviations():
    generator = np.random.default_rng(0)
    one = generator.normal(size=4000)
    assert scaled_distance(one.tolist(), (one + 2.0).tolist()) == pytest.approx(2.0, rel=0.05)
    assert scaled_distance((10 * one).tolist(), (10 * one + 20).tolist()) == pytest.approx(2.0, rel=0.05)
    assert scaled_distance([1.0, 2.0], [2.0, 1.0]) == 0.0
    assert scaled_distance([1.0], [1.0]) == 0.0
    assert scaled_distance([1.0], [2.0]) is None and scaled_distance([], [2.0]) is None


def test_a_row_holds_medians_and_percentiles_of_both_sets():
    given = together({"length": [float(value)]} for value in range(101))
    (row, only) = compared("rca", given, {"length": [50.0] * 3, "width": [1.0]})
    assert (row["given_count"], row["given"], row["given_p5"], row["given_p95"]) == (101, 50.0, 5.0, 95.0)
    # |value − 50| has a mean of 25.2; the pooled spread is 29.15/√2.
    assert row["distance"] == pytest.approx(25.248 / (29.155 / np.sqrt(2)), rel=5e-3)
    assert only["quantity"] == "width" and only["given"] is None and only["distance"] is None


def test_anatomies_are_compared_with_the_atlas_of_their_kind(tmp_path):
    config = AtlasConfig(vessel="lca", seed=3, count=2)
    for index in range(2):
        write_anatomy(make_patient(config, index), output=tmp_path / str(index))
    rows = compare_with_atlas([tmp_path], replace(config, vessel="rca"))
    assert {row["kind"] for row in rows} == {"lca"}
    by_name = {row["quantity"]: row for row in rows}
    # The same patients on both sides, through a file and back.
    assert all(row["distance"] is None or row["distance"] < 0.02 for row in rows)
    assert by_name["total turn, °"]["given"] == by_name["total turn, °"]["atlas"]
    assert by_name["LAD–LCx angle, °"]["given_count"] == 2
    with pytest.raises(InputError, match="is no anatomy and holds none"):
        compare_with_atlas([tmp_path / "none"], config)
