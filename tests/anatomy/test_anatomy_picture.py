"""The picture of an anatomy: drawn without a screen, with the wall's outline and the section colours in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from analytic_shapes import forked_tree
from matplotlib.image import imread

from endopilot.anatomy.anatomy_picture import draw_anatomy
from endopilot.anatomy.extract import extract_anatomy
from endopilot.types import VesselTree, Volume


def share_of(image: np.ndarray, colour: tuple[float, float, float]) -> float:
    return float((np.abs(image[..., :3] - colour).max(axis=-1) < 0.12).mean())


def test_picture_shows_the_wall_the_inscribed_circle_and_the_ct(tmp_path):
    anatomy = extract_anatomy(forked_tree(), name="fork")
    field = anatomy.distance_map
    grid = (np.full(3, field.spacing_mm), field.origin_mm, np.eye(3))
    ct = Volume(np.where(field.values > 0, 400, -80).astype(np.int16), *grid)
    images = {}
    for name, volume in (("distance", None), ("ct", ct)):
        draw_anatomy(anatomy, tmp_path / f"{name}.png", volume=volume)
        images[name] = imread(tmp_path / f"{name}.png")
        assert share_of(images[name], (0.0, 1.0, 0.0)) > 5e-5  # the wall
        assert share_of(images[name], (1.0, 1.0, 0.0)) > 2e-4  # the inscribed circles
    assert share_of(images["ct"], (0.75, 0.3, 0.25)) < share_of(images["distance"], (0.75, 0.3, 0.25))


def test_the_list_of_many_sections_lies_within_the_picture(tmp_path):
    """The names of 99 sections, some of them odd or long, do not reach the picture's edge."""
    anatomy, begin, branches = extract_anatomy(forked_tree(), name="fork"), 0, []
    total = sum(len(branch.section) for branch in anatomy.tree.branches)
    for branch in anatomy.tree.branches:
        branches.append(replace(branch, section=(np.arange(len(branch.section)) + begin) * 99 // total))
        begin += len(branch.section)
    names = ("_first", "$second", "a very long name of a section of this vessel", *map(str, range(96)))
    draw_anatomy(replace(anatomy, tree=VesselTree(tuple(branches), names)), tmp_path / "many.png")
    image = imread(tmp_path / "many.png")[..., :3]
    assert image[-2:].min() == image[:, :2].min() == image[:, -2:].min() == 1.0
