"""Lumens that hold more than the one vessel: both coronary arteries, or a piece of the aorta."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_shapes import mask_of

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.errors import InputError
from endopilot.vessels.surface import Surface, surface_from_mask
from toy_coronaries import artery, mask_of_arteries

HALF_MM = (22.0, 12.0, 34.0)


def upright(points, x, low, radius=1.5):
    """A vessel along z from `low` to 30 mm at (x, 0)."""
    z = np.clip(points[..., 2], low, 30.0)
    return radius - np.sqrt((points[..., 0] - x) ** 2 + points[..., 1] ** 2 + (points[..., 2] - z) ** 2)


def two_arteries(points):
    return np.maximum(upright(points, -10.0, -20.0), upright(points, 10.0, -30.0))


def artery_from_aorta(points):
    """A vessel that leaves a ball of 9 mm radius around (0, 0, 22); a bulge of 4 mm stands 20 mm below its end."""
    aorta = 9.0 - np.linalg.norm(points - [0.0, 0.0, 22.0], axis=-1)
    bulge = 4.0 - np.linalg.norm(points - [0.0, 0.0, -12.0], axis=-1)
    return np.maximum.reduce([upright(points, 0.0, -32.0), aorta, bulge])


def test_of_two_vessels_the_larger_is_taken_and_the_other_named():
    mask = mask_of(two_arteries, HALF_MM, (0.6, 0.6, 0.6))
    for source in (mask, surface_from_mask(mask.volume)):
        anatomy = extract_anatomy(source, name="both")
        assert abs(anatomy.insertion.position[0] - 10.0) < 1.0
        assert any("other large piece" in note for note in anatomy.provenance["notes"])


@pytest.mark.parametrize("vessel", ["rca", "lca"])
def test_straight_tubes_are_not_answered_as_coronary_arteries(vessel):
    with pytest.raises(InputError, match="--ostium-mm"):
        extract_anatomy(mask_of(two_arteries, HALF_MM, (0.6, 0.6, 0.6)), config=AnatomyConfig(vessel=vessel))


def test_coronary_ostium_is_where_the_vessel_leaves_the_aorta():
    mask = mask_of(artery_from_aorta, HALF_MM, (0.6, 0.6, 0.6))
    anatomy = extract_anatomy(mask, name="root", config=AnatomyConfig(vessel="rca"))
    assert anatomy.provenance["ostium_rule"] == "where the vessel leaves the aorta"
    assert np.linalg.norm(anatomy.insertion.position - [0.0, 0.0, 13.0]) < 2.0
    assert anatomy.insertion.direction[2] < -0.9
    assert anatomy.tree.longest_path().radius[0] < 2.5
    assert anatomy.tree.longest_path().abscissa[-1] > 40.0  # on through the aneurysm, to the end


def test_surface_exported_twice_is_read_once():
    mask = mask_of(lambda points: upright(points, 0.0, -30.0), HALF_MM, (0.6, 0.6, 0.6))
    wall = surface_from_mask(mask.volume)
    anatomy = extract_anatomy(Surface(wall.vertices, np.concatenate([wall.faces, wall.faces])), name="twice")
    assert abs(anatomy.tree.longest_path().abscissa[-1] - 60.0) < 4.0


def test_aneurysm_low_in_the_tree_is_not_taken_for_the_aorta():
    lumen = artery("rca")
    index = np.indices(lumen.values.shape)[::-1].reshape(3, -1).T
    place = (lumen.origin_mm + lumen.spacing_mm * index).reshape(*lumen.values.shape, 3)
    low = place[lumen.values > 1.0]
    sac = 5.0 - np.linalg.norm(place - low[low[:, 2].argmin()], axis=-1)
    mask = mask_of_arteries(replace(lumen, values=np.maximum(lumen.values, sac)))
    anatomy = extract_anatomy(mask, name="sac", config=AnatomyConfig(vessel="rca"))
    assert anatomy.provenance["ostium_rule"] == "shape of the coronary arteries"
    assert np.linalg.norm(anatomy.insertion.position) < 3.0
    assert anatomy.tree.longest_path().radius.max() > 3.5
