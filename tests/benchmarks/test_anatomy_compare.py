"""Every quantity of the comparison against closed forms: circles, helices, known forks; and the table's distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.anatomy.compare import compare_with_atlas, scaled_distance
from benchmarks.anatomy.vessel_shape import vessel_shape
from endopilot.anatomy.distance import distance_map_from_spheres
from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.labels_tree import RCA_SECTIONS
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


def test_the_distance_is_a_shift_in_standard_deviations():
    generator = np.random.default_rng(0)
    one = generator.normal(size=4000)
    assert scaled_distance(one.tolist(), (one + 2.0).tolist()) == pytest.approx(2.0, rel=0.05)
    assert scaled_distance((10 * one).tolist(), (10 * one + 20).tolist()) == pytest.approx(2.0, rel=0.05)
    assert scaled_distance([1.0, 2.0], [2.0, 1.0]) == 0.0
    assert scaled_distance([1.0], [1.0]) == 0.0
    assert scaled_distance([1.0], [2.0]) is None and scaled_distance([], [2.0]) is None


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
