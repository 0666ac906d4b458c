"""The plots that records draw of themselves."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest


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
    assert fork.plot(axes=right, view="above") is figure
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
