"""What a refusal advises works when it is done: no advice leads to another refusal, or back to where it came from."""

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
from toy_coronaries import PLACE_MM, artery, mask_of_arteries


def place_advised(message):
    found = re.search(r"--ostium-mm (-?\d+\.\d) (-?\d+\.\d) (-?\d+\.\d)", message)
    assert found is not None
    return tuple(float(value) for value in found.groups())


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
    for vessel in ("rca", "lca"):
        with pytest.raises(InputError, match="one lumen seems to hold both coronary arteries") as refused:
            coronary_inlet(mask, vessel, "mask")
        assert "--vessel" not in str(refused.value)
        place = place_advised(str(refused.value))
        assert np.linalg.norm(place - PLACE_MM[vessel]) < 5.0
    anatomy = extract_anatomy(mask, name="mask", config=AnatomyConfig(vessel="lca", ostium_mm=place))
    assert np.linalg.norm(anatomy.insertion.position - PLACE_MM["lca"]) < 4.0
