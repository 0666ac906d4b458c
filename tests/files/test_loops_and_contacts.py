"""Masks that are no trees: loops, bypasses, two inlets, vessels that touch; a word on each, and the place."""

from __future__ import annotations

import re

import numpy as np
import pytest
from make_vessels import hairpin, length_of, line, lumen, tubes, with_voxels

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.topology import parted
from endopilot.errors import InputError
from endopilot.types import Volume

VOXELS = [(0.35, 0.35, 0.5), (0.7, 0.7, 0.5)]


def notes_of(anatomy) -> str:
    return " | ".join(anatomy.provenance["notes"][1:])


def places_of(anatomy) -> list[np.ndarray]:
    """Return the places that an anatomy's notes name, mm."""
    return [np.array(found.split(","), dtype=float) for found in re.findall(r"\(([^()]*)\) mm", notes_of(anatomy))]


@pytest.mark.parametrize("voxel_mm", VOXELS)
@pytest.mark.parametrize("across", [1, 2])
def test_a_hairpin_that_touches_itself_keeps_its_length_and_its_root(voxel_mm, across):
    mask = tubes((hairpin(50, 5.0), 1.8), voxel_mm=voxel_mm)
    for up in np.arange(across) * voxel_mm[2]:
        for aside in np.arange(across) * voxel_mm[1]:
            mask = with_voxels(mask, (-1.2, aside, 20 + up), (1.2, aside, 20 + up))
    anatomy = extract_anatomy(lumen(mask), name="hairpin")
    assert anatomy.insertion.position[2] < 2.0 and len(anatomy.tree.branches) == 1
    assert length_of(anatomy) > 104
    assert "touches itself and was parted at" in notes_of(anatomy)
    assert abs(places_of(anatomy)[0][1]) <= 0.5 and 20.0 <= places_of(anatomy)[0][2] < 30.0


def test_the_root_of_a_hairpin_is_its_wide_end_though_the_narrow_end_touches_it():
    angle = np.linspace(np.pi, 0.0, 60)
    bend = np.stack([5 + 5 * np.cos(angle), 0 * angle, 50 + 5 * np.sin(angle)], axis=1)
    limb = (line((0, 0, 0), (0, 0, 50)), 2.0)
    back = (np.concatenate([bend, line((10, 0, 50), (10, 0, 20), (5.5, 0, 7))]), 1.3)
    mask = with_voxels(tubes(limb, back), (1.5, 0, 8), (5.0, 0, 8))
    anatomy = extract_anatomy(lumen(mask), name="hairpin")
    assert np.linalg.norm(anatomy.insertion.position) < 3.0
    assert "touches itself and was parted at" in notes_of(anatomy)


def test_two_limbs_that_touch_over_their_length_are_parted():
    mask = tubes((hairpin(50, 3.4), 1.8), voxel_mm=(0.35, 0.35, 0.5))
    whole, remarks = parted(mask)
    assert whole.voxels.sum() < mask.voxels.sum()
    assert len(remarks) == 1 and "touch over" in remarks[0]


@pytest.mark.parametrize("voxel_mm", VOXELS)
def test_a_bypass_is_cut_at_its_narrowest_place_and_the_place_is_stated(voxel_mm):
    bypass = line((0, 0, 10), (10, 0, 20), (10, 0, 40), (0, 0, 50))
    mask = tubes((line((0, 0, 0), (0, 0, 60)), 1.8), (bypass, 1.2), voxel_mm=voxel_mm)
    anatomy = extract_anatomy(lumen(mask), name="bypass")
    assert length_of(anatomy) > 95.0
    assert "a tree holds no loops: cut at" in notes_of(anatomy)


@pytest.mark.parametrize("voxel_mm", VOXELS)
def test_two_vessels_that_touch_in_passing_are_parted(voxel_mm):
    vessels = tubes((line((0, 0, 0), (0, 0, 60)), 1.8), (line((4.6, -30, 30), (4.6, 30, 30)), 1.6), voxel_mm=voxel_mm)
    anatomy = extract_anatomy(lumen(with_voxels(vessels, (1.0, 0, 30), (3.6, 0, 30))), name="passing")
    notes = anatomy.provenance["notes"]
    assert len(anatomy.tree.branches) == 1 and abs(length_of(anatomy) - 60) < 3
    assert "two vessels touch and were parted at" in notes_of(anatomy) and abs(places_of(anatomy)[0][0] - 2.0) <= 0.5
    assert any("left out" in note and ("62 mm long" in note or "63 mm long" in note) for note in notes)


def test_a_second_inlet_is_named():
    trunk = line((-15, 0, 0), (0, 0, 25), (0, 0, 60))
    anatomy = extract_anatomy(lumen(tubes((trunk, 2.0), (line((15, 0, 0), (0, 0, 25)), 2.0))), name="two inlets")
    x = anatomy.insertion.position[0]
    assert any(abs(place[0] + np.sign(x) * 15.0) <= 2.0 for place in places_of(anatomy))
    assert "--ostium-mm chooses" in notes_of(anatomy)


def test_what_lies_behind_a_given_ostium_is_stated():
    mask = tubes((line((0, 0, 0), (0, 0, 60)), 1.6))
    anatomy = extract_anatomy(lumen(mask), name="mid", config=AnatomyConfig(ostium_mm=(0.0, 0.0, 30.0)))
    assert "of the lumen behind the ostium" in notes_of(anatomy)


def test_every_piece_of_some_length_that_is_left_out_is_named_with_its_place():
    pieces = [(line((20.0 * i, 0, 0), (20.0 * i, 0, 60 - 15 * i)), 1.5) for i in range(3)]
    anatomy = extract_anatomy(lumen(tubes(*pieces)), name="pieces")
    left = [note for note in anatomy.provenance["notes"] if "apart from the lumen left out" in note]
    assert len(left) == 2 and "at (19.0, " in left[0] and "at (39.0, " in left[1]


def test_a_mask_of_all_its_voxels_is_refused():
    full = Volume(np.ones((96, 16, 16), dtype=bool), np.full(3, 0.5), np.zeros(3), np.eye(3))
    with pytest.raises(InputError, match="every voxel belongs to it"):
        extract_anatomy(lumen(full), name="full")
