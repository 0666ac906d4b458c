"""Coronary arteries that lie otherwise than asked: what a refusal advises works when it is done."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial import KDTree

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.types import LumenMask
from endopilot.vessels.coronary_inlet import coronary_inlet
from endopilot.vessels.surface import Surface, surface_from_mask
from toy_coronaries import PLACE_MM, artery, mask_of_arteries

RAS = np.array([-1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def both():
    return mask_of_arteries(artery("rca"), artery("lca"))


def test_a_single_artery_in_ras_axes_is_never_taken_for_the_other_one():
    wall = surface_from_mask(mask_of_arteries(artery("lca")).volume)
    turned = Surface(wall.vertices * RAS, wall.faces)
    for asked in ("rca", "lca"):
        with pytest.raises(InputError, match="give --coordinates ras") as refused:
            coronary_inlet(turned, asked, "tree", "lps")
        assert "--vessel" not in str(refused.value)
    assert np.linalg.norm(coronary_inlet(wall, "lca", "tree", "ras").position - PLACE_MM["lca"]) < 4.0
    with pytest.raises(InputError, match="leave --coordinates ras out"):
        coronary_inlet(turned, "lca", "tree", "ras")


@pytest.mark.parametrize(
    ("turned", "exchanged"), [((1, 2), "left and right, front and back"), ((1,), "front and back")]
)
def test_a_mask_in_other_axes_names_those_that_are_exchanged(both, turned, exchanged):
    voxels = np.flip(both.volume.voxels, axis=turned).copy()
    with pytest.raises(InputError, match=f"with {exchanged} exchanged, .* mend the orientation") as refused:
        coronary_inlet(LumenMask(replace(both.volume, voxels=voxels)), "rca", "mask")
    assert "--vessel" not in str(refused.value)


def touching():
    """Both arteries in one piece: a bridge where they come nearest to each other beyond their first 40 mm."""
    mask = mask_of_arteries(artery("rca"), artery("lca"))
    pieces, _ = label(mask.volume.voxels, structure=np.ones((3, 3, 3)))
    one, two = (np.argwhere(pieces == number) for number in np.argsort(-np.bincount(pieces.ravel())[1:])[:2] + 1)
    places = [mask.volume.index_to_world(index[:, ::-1].astype(float)) for index in (one, two)]
    far = [np.linalg.norm(place[:, None] - list(PLACE_MM.values()), axis=-1).min(axis=1) > 40.0 for place in places]
    gap, nearest = KDTree(places[1][far[1]]).query(places[0][far[0]])
    start, end = one[far[0]][gap.argmin()], two[far[1]][nearest[gap.argmin()]]
    voxels = mask.volume.voxels.copy()
    for share in np.linspace(0.0, 1.0, 100):
        i, j, k = np.rint(start + share * (end - start)).astype(int)
        voxels[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2] = True
    return LumenMask(replace(mask.volume, voxels=voxels))


@pytest.mark.parametrize(("held", "asked"), [("rca", "lca"), ("lca", "rca")])
def test_the_other_vessel_is_advised_only_where_it_is_then_found(held, asked):
    mask = mask_of_arteries(artery(held))
    with pytest.raises(InputError, match=f"take --vessel {held}"):
        coronary_inlet(mask, asked, "mask")
    found = coronary_inlet(mask, held, "mask")
    assert np.linalg.norm(found.position - PLACE_MM[held]) < 4.0


def test_arteries_that_touch_are_told_as_that_and_the_place_advised_is_an_ostium():
    mask = touching()
    with pytest.raises(InputError, match="one lumen seems to hold both coronary arteries") as refused:
        coronary_inlet(mask, "lca", "mask")
    assert "--vessel" not in str(refused.value)
    advised = re.search(r"or --ostium-mm (-?\d+\.\d) (-?\d+\.\d) (-?\d+\.\d)", str(refused.value))
    place = tuple(float(value) for value in advised.groups())
    anatomy = extract_anatomy(mask, name="mask", config=AnatomyConfig(vessel="lca", ostium_mm=place))
    assert np.linalg.norm(anatomy.insertion.position - PLACE_MM["lca"]) < 4.0
