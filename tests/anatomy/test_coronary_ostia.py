"""Ostia of the coronary arteries in masks without an aorta: found, refused where unsure, absent arteries told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_shapes import mask_of

from benchmarks.anatomy.analytic_lumens import tree_of
from endopilot.anatomy.distance import distance_map_from_spheres
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume
from endopilot.types import Insertion, LumenMask, Volume
from endopilot.vessels.coronary_inlet import _coarse, coronary_inlet
from endopilot.vessels.coronary_ostia import end_score, rank_ostia
from endopilot.vessels.ends import open_ends, skeleton_of
from endopilot.vessels.inlet import component, entrance, grid_points
from endopilot.vessels.surface import surface_from_mask
from endopilot.vessels.surface_distance import distance_map_from_surface
from toy_coronaries import PLACE_MM, artery, mask_of_arteries, without

REAL = Path(__file__).parents[3] / "shared" / "data" / "real_coronaries"


@pytest.fixture(scope="module")
def both():
    return mask_of_arteries(artery("rca"), artery("lca"))


@pytest.fixture(scope="module")
def extracted(both):
    """Return the anatomy of each artery of a mask of both."""
    return {side: extract_anatomy(both, name="patient", config=AnatomyConfig(vessel=side)) for side in ("rca", "lca")}


@pytest.fixture(scope="module")
def right_alone():
    return mask_of_arteries(artery("rca"))


def test_each_artery_is_found_in_a_mask_of_both_with_crumbs(both):
    voxels = both.volume.voxels.copy()
    voxels[2:5, 2:5, 2:5] = True
    mask = LumenMask(replace(both.volume, voxels=voxels))
    for vessel in ("rca", "lca"):
        found = coronary_inlet(mask, vessel, "patient")
        assert np.linalg.norm(found.position - PLACE_MM[vessel]) < 4.0
        assert found.confidence > 0.9
        assert found.runner_up is not None and found.runner_up.probability < 0.1


def test_the_tree_begins_at_the_found_ostium_and_the_record_says_how_sure_it_is(extracted):
    anatomy = extracted["lca"]
    assert np.linalg.norm(anatomy.insertion.position - PLACE_MM["lca"]) < 2.0
    assert anatomy.provenance["ostium_rule"] == "shape of the coronary arteries"
    assert 0.9 < anatomy.provenance["ostium_confidence"] <= 1.0
    assert len(anatomy.provenance["ostium_runner_up"]["position_mm"]) == 3


def test_a_surface_of_both_arteries_is_taken_apart(both):
    found = coronary_inlet(surface_from_mask(both.volume), "lca", "patient")
    assert np.linalg.norm(found.position - PLACE_MM["lca"]) < 4.0


def test_a_single_artery_is_found_and_never_taken_for_the_other(right_alone):
    assert np.linalg.norm(coronary_inlet(right_alone, "rca", "patient").position) < 4.0
    with pytest.raises(InputError, match=r"holds no left coronary artery: .* looks like the right one; .*--vessel rca"):
        coronary_inlet(right_alone, "lca", "patient")


def test_a_short_artery_is_told(both):
    def left_or_near(points):
        return (np.linalg.norm(points, axis=1) < 28) | ((points[:, 1] > 15) & (points[:, 0] > 10))

    stump = without(both, left_or_near)
    anatomy = extract_anatomy(stump, name="patient", config=AnatomyConfig(vessel="rca"))
    assert np.linalg.norm(anatomy.insertion.position) < 4.0
    assert any("right coronary artery is only" in note for note in anatomy.provenance["notes"])


def test_fine_masks_are_looked_at_on_a_coarser_grid(right_alone):
    volume = right_alone.volume
    doubled = volume.voxels.repeat(3, axis=0).repeat(3, axis=1).repeat(3, axis=2)
    origin = volume.index_to_world(np.full(3, -1 / 3))
    fine = LumenMask(Volume(doubled, volume.spacing_mm / 3, origin, volume.direction))
    assert np.linalg.norm(coronary_inlet(fine, "rca", "patient").position) < 4.0
    assert _coarse(fine.volume).voxels.sum() < 0.3 * doubled.sum()


@pytest.mark.parametrize("vessel", ["rca", None])
def test_a_given_ostium_five_millimetres_off_enters_at_the_open_end(right_alone, vessel):
    lumen = distance_map_from_surface(surface_from_mask(right_alone.volume), spacing_mm=0.5)
    points, clearance = grid_points(lumen, component(lumen, None))
    for offset in np.concatenate([np.eye(3), -np.eye(3)]) * 5.0:
        found = entrance(lumen, points, clearance, Insertion(offset, np.zeros(3)), vessel)
        assert np.linalg.norm(found.position) < 4.0 and not found.direction.any()


def test_a_cone_narrows_from_its_wide_end_and_widens_from_the_narrow_one():
    def cone(points):
        height = np.clip(points[..., 2], -30.0, 30.0)
        return 1.7 - height / 60.0 - np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + (points[..., 2] - height) ** 2)

    lumen = distance_map_from_surface(surface_from_mask(mask_of(cone, (5, 5, 34), (0.5,) * 3).volume), spacing_mm=0.5)
    ends = open_ends(skeleton_of(*grid_points(lumen, lumen.values > 0), lumen.spacing_mm))
    wide, narrow = (pick(ends, key=lambda end: end.position[2]) for pick in (min, max))
    # mean of ln(u) over u from 1 to 2.2/1.2, where u is the radius over that of the narrow end
    ratio = 2.2 / 1.2
    assert abs(narrow.widening - (ratio * np.log(ratio) / (ratio - 1.0) - 1.0)) < 0.1
    assert wide.widening < 0.04
    assert wide.taper > 0.75 and narrow.taper < -0.75
    assert wide.calibre > 0.95 and narrow.calibre < 0.7
    np.testing.assert_allclose([wide.heading[2], narrow.heading[2]], [1.0, -1.0], atol=0.01)


def test_a_fork_entered_from_the_side_opens_backwards():
    along, side = np.linspace(0.0, 10.0, 21)[:, None], np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    up, fork = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 10.0])
    tree = tree_of(
        (2.0 * along * up, 1.6, -1), (2.0 * fork + 3.0 * along * up, 1.6, 0), (2 * fork + along * side, 1.2, 0)
    )
    lumen = distance_map_from_spheres(tree, spacing_mm=0.5)
    ends = open_ends(skeleton_of(*grid_points(lumen, lumen.values > 0), lumen.spacing_mm))
    tip = min(ends, key=lambda end: np.linalg.norm(end.position - 2 * fork - 10.0 * side))
    assert tip.opening_deg > 140.0


def test_the_likeliest_pair_of_ends_wins_over_each_ends_own_score(both):
    """The end that alone looks best as a left main does not win against one at the right place."""
    lumens = [artery("rca"), artery("lca")]
    ends = [open_ends(skeleton_of(*grid_points(each, each.values > 0), each.spacing_mm)) for each in lumens]
    true = max(ends[1], key=lambda end: end_score(end, "lca"))
    away = replace(true, position=true.position + np.array([25.0, -20.0, -30.0]), calibre=1.0, taper=0.6, widening=0.0)
    ranking = rank_ostia([ends[0], [*ends[1], away]])["lca"]
    assert end_score(away, "lca") > end_score(true, "lca")
    assert np.linalg.norm(ranking.candidates[0].position - true.position) < 0.1
    assert ranking.absent + sum(candidate.probability for candidate in ranking.candidates) <= 1.0 + 1e-9


def test_two_ends_of_one_stub_are_one_candidate_between_them(both):
    lumens = [artery("rca"), artery("lca")]
    ends = [open_ends(skeleton_of(*grid_points(each, each.values > 0), each.spacing_mm)) for each in lumens]
    true = max(ends[1], key=lambda end: end_score(end, "lca"))
    corner = replace(true, position=true.position + np.array([0.0, 0.0, 7.0]))
    first, second = rank_ostia([ends[0], [*ends[1], corner]])["lca"].candidates[:2]
    assert first.probability > 0.95 > 20 * second.probability
    assert np.linalg.norm(first.position - true.position) < 5.0


def test_no_vessel_lies_in_the_aorta_between_the_ostia():
    lumens = [artery("rca"), artery("lca")]
    ends = [open_ends(skeleton_of(*grid_points(each, each.values > 0), each.spacing_mm)) for each in lumens]
    right, left = (
        max(own, key=lambda end: end_score(end, side)) for own, side in zip(ends, ("rca", "lca"), strict=True)
    )
    across = right.position + np.linspace(0.1, 0.9, 9)[:, None] * (left.position - right.position)
    free, crossed = (rank_ostia(ends, vessels)["lca"].candidates[0].probability for vessels in (None, across))
    assert free > 0.99 and 1.0 - crossed > 2.0 * (1.0 - free)


def test_dominance_is_the_same_from_either_artery(extracted):
    assert extracted["rca"].provenance["dominance"] == extracted["lca"].provenance["dominance"]


@pytest.mark.skipif(not REAL.exists(), reason="the real coronary masks are not here")
@pytest.mark.parametrize("patient", ["0002", "0134", "0640"])
def test_ostia_of_real_patients(patient):
    """A conus branch beside the ostium, a right artery of 35 mm, and a septal branch that is wide."""
    content = read_volume(REAL / f"{patient}.nii.gz")
    mask = LumenMask(replace(content, voxels=content.voxels > 0))
    for vessel, known in json.loads((REAL / "ostia.json").read_text())[patient].items():
        found = coronary_inlet(mask, vessel, patient)
        assert np.linalg.norm(found.position - known["near_aorta_mm"]) < 5.0
        assert found.confidence > 0.9
