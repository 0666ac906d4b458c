"""Coronary arteries in other axes than their file is read in: the axes are named, never the other artery advised."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask
from endopilot.types import LumenMask
from endopilot.vessels.coronary_inlet import coronary_inlet
from endopilot.vessels.surface import Surface, surface_from_mask
from toy_coronaries import PLACE_MM, artery, mask_of_arteries

REAL = Path(__file__).parents[3] / "shared/data/real_coronaries"
RAS = np.array([-1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def both():
    return mask_of_arteries(artery("rca"), artery("lca"))


@pytest.fixture(scope="module", params=["rca", "lca"])
def alone(request):
    wall = surface_from_mask(mask_of_arteries(artery(request.param)).volume)
    return request.param, Surface(wall.vertices * RAS, wall.faces)


def test_a_single_artery_in_ras_axes_is_never_taken_for_the_other_one(alone):
    vessel, wall = alone
    for asked in ("rca", "lca"):
        with pytest.raises(InputError, match="give --coordinates ras") as refused:
            coronary_inlet(wall, asked, "tree", "lps")
        assert "--vessel" not in str(refused.value)
    found = coronary_inlet(Surface(wall.vertices * RAS, wall.faces), vessel, "tree", "ras")
    assert np.linalg.norm(found.position - PLACE_MM[vessel]) < 4.0


def test_arteries_that_are_in_lps_though_ras_was_given_are_told(both):
    wall = surface_from_mask(both.volume)
    with pytest.raises(InputError, match="leave --coordinates ras out"):
        coronary_inlet(Surface(wall.vertices * RAS, wall.faces), "lca", "tree", "ras")


@pytest.mark.parametrize(
    ("turned", "exchanged"),
    [((1, 2), "left and right, front and back"), ((2,), "left and right"), ((1,), "front and back")],
    ids=["ras", "mirrored across", "mirrored in depth"],
)
def test_a_mask_in_other_axes_names_those_that_are_exchanged(both, turned, exchanged):
    voxels = np.flip(both.volume.voxels, axis=turned).copy()
    for vessel in ("rca", "lca"):
        with pytest.raises(InputError, match=f"with {exchanged} exchanged, .* mend the orientation") as refused:
            coronary_inlet(LumenMask(replace(both.volume, voxels=voxels)), vessel, "mask")
        assert "--vessel" not in str(refused.value)


@pytest.mark.skipif(not REAL.exists(), reason="the real coronary arteries are not here")
def test_a_left_artery_that_may_be_a_right_one_in_other_axes_has_a_note():
    mask = read_mask(REAL / "0491.nii.gz", label=1)
    assert coronary_inlet(mask, "rca", "mask").notes == ()
    turned = LumenMask(replace(mask.volume, voxels=np.flip(mask.volume.voxels, axis=(1, 2)).copy()))
    (note,) = coronary_inlet(turned, "lca", "mask").notes
    assert "left and right, front and back exchanged, this would be a right coronary artery" in note
