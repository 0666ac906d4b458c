"""The plots that records draw of themselves, and the picture of an anatomy."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.image import imread

from benchmarks.anatomy.analytic_lumens import forked_tree
from endopilot.anatomy.anatomy_picture import draw_anatomy
from endopilot.anatomy.extract import extract_anatomy
from endopilot.types import VesselTree, Volume


@pytest.fixture(autouse=True)
def _no_figures_left():
    yield
    plt.close("all")


def test_an_anatomy_is_seen_across_its_largest_extents(fork) -> None:
    points = np.concatenate([branch.centerline.points for branch in fork.tree.branches])
    shown = [axis for axis in range(3) if axis != np.argmin(np.ptp(points, axis=0))]
    (axes,) = fork.plot().axes
    assert [axes.get_xlabel()[0], axes.get_ylabel()[0]] == ["xyz"[axis] for axis in shown]
    drawn = np.concatenate([path.vertices for lines in axes.collections for path in lines.get_paths()])
    np.testing.assert_allclose(np.unique(drawn, axis=0), np.unique(points[:, shown], axis=0))
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert names == ["ostium", *fork.tree.sections_present]


def test_an_anatomy_is_drawn_into_given_axes(fork) -> None:
    figure, (left, right) = plt.subplots(1, 2)
    assert fork.plot(axes=right, view="above", color="red") is figure
    assert right.get_legend() is None
    assert not left.collections
    assert right.get_xlabel().startswith("x") and right.get_ylabel().startswith("y")


def test_a_trajectory_shows_one_world(rollout) -> None:
    two = replace(rollout, wall_force=rollout.wall_force + 1.0)
    length, offset, force = two.plot().axes
    time_s = two.period_s * np.arange(1, two.command.shape[1] + 1)
    for axes, wanted in (
        (length, (two.inserted_length[0, :, 0], two.tip.abscissa[0, :, 0])),
        (offset, (two.tip.offset[0, :, 0],)),
        (force, (two.wall_force[0],)),
    ):
        for line, values in zip(axes.lines, wanted, strict=True):
            np.testing.assert_array_equal(line.get_xydata(), np.column_stack([time_s, values]))
            assert line.get_label() in [text.get_text() for text in axes.get_legend().get_texts()]
        assert axes.get_ylabel().endswith((", mm", ", N"))
    assert force.get_xlabel() == "time, s"


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
