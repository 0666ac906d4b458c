"""The figures of reports, and those of an evaluation."""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from endopilot.errors import InputError
from endopilot.evaluation.results import METRICS_FILE, RESULTS_FILE
from endopilot.imaging.overlay_picture import draw_slices
from endopilot.report import figures
from endopilot.report.report import report_evaluation
from endopilot.types import Insertion, LumenMask, Volume

TITLES = {"seen_test": "New navigations, known patients", "test": "New patients"}


def make_volume(direction: np.ndarray) -> tuple[Volume, LumenMask]:
    """A bright rod along z at x = 10, y = 4 mm, from z = 0 to 8 mm, stored along the axes that `direction` gives."""
    shape = (24, 24, 24)
    low = np.array([0.0, 0.0, 0.0])
    corners = np.where(direction.sum(axis=1) < 0, 23.0, 0.0)
    probe = Volume(np.zeros(shape, dtype=np.int16), np.ones(3), low + corners, direction)
    k, j, i = np.indices(shape)
    world = probe.index_to_world(np.stack([i, j, k], axis=-1).astype(float))
    inside = (np.hypot(world[..., 0] - 10, world[..., 1] - 4) < 2.5) & (world[..., 2] < 8.5)
    voxels = np.where(inside, 400, 0).astype(np.int16)
    ostium = Insertion(np.array([10.0, 4.0, 6.0]), np.array([0.0, 0.0, -1.0]))
    return Volume(voxels, probe.spacing_mm, probe.origin_mm, direction), LumenMask(
        Volume(inside, probe.spacing_mm, probe.origin_mm, direction), ostium
    )


@pytest.mark.parametrize(
    "direction",
    [np.eye(3), np.diag([-1.0, -1.0, 1.0]), np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])],
    ids=["LPS", "RAS", "sagittal"],
)
def test_the_ct_is_shown_as_radiologists_read_it_however_it_is_stored(direction):
    volume, mask = make_volume(direction)
    axial, coronal = Figure().subplots(1, 2)
    draw_slices([axial, coronal], volume, [(mask, "red")], through=mask.ostium.position)
    picture = np.asarray(axial.images[0].get_array())
    rows, columns = np.nonzero(picture > 200)
    # Nothing is cropped off at low x, y and z, so pixels are mm: +x to the right, +y downwards.
    assert columns.mean() == pytest.approx(10.0)
    assert rows.mean() == pytest.approx(4.0)
    assert axial.images[0].origin == "upper"
    rows, columns = np.nonzero(np.asarray(coronal.images[0].get_array()) > 200)
    assert (rows.min(), rows.max()) == (0, 8)  # +z upwards from the lowest row
    assert columns.mean() == pytest.approx(10.0)
    assert coronal.images[0].origin == "lower"


def test_the_tree_shows_every_section_in_its_colour(anatomy):
    ax = figures.tree_figure(anatomy).axes[0]
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["ostium", "1", "2"]


def test_series_are_drawn_with_their_values(results):
    table = figures.tip_error_table(results)
    ax = figures.tip_error_figure(table, TITLES).axes[0]
    line = next(line for line in ax.get_lines() if "P1" in str(line.get_label()))
    expected = table.query("split == 'seen_test' and series == 'P1'")["abscissa_mae_mm"]
    np.testing.assert_allclose(np.asarray(line.get_ydata(), dtype=float), expected)
    assert ax.get_xlabel().endswith(", s")
    assert ax.get_ylabel().endswith(", mm")


def test_both_safety_ratios_are_drawn_with_their_95_percent_quantile(results):
    table = figures.safety_table(results)
    axes = figures.safety_figure(table, TITLES).axes
    for ax, ratio in ((axes[1], "clearance"), (axes[3], "radius")):
        lines = [np.asarray(line.get_ydata(), dtype=float) for line in ax.get_lines()]
        for series in ("true", "P3", "P4"):
            part = table.query(f"split == 'test' and series == '{series}' and ratio == '{ratio}'")
            for column in ("median", "p95"):
                expected = part[column]
                assert any(len(line) == len(expected) and np.allclose(line, expected) for line in lines)
        assert any(np.allclose(line, 1.0) for line in lines)  # the wall
    assert axes[3].get_ylabel().endswith("γ / r")


def test_the_boxes_of_control_errors_are_those_of_the_series(results):
    table = figures.control_error_table(results)
    figure = figures.control_error_figure(table, TITLES)
    series = table["series"].unique()
    assert len(series) >= 4 and len(figure.axes) == 4
    medians = [line.get_xdata()[0] for line in figure.axes[2].lines if line.get_color() == figures.BLACK]
    shown = [
        np.median(table.query(f"split == 'test' and series == '{name}'")["translation_rmse_mm_s"]) for name in series
    ]
    np.testing.assert_allclose(medians[: len(shown)], shown)


@pytest.fixture(scope="module")
def reported(evaluated, tmp_path_factory):
    folder, metrics = evaluated
    copy = tmp_path_factory.mktemp("reported")
    for name in (RESULTS_FILE, METRICS_FILE):
        shutil.copy(folder / "evaluation" / name, copy)
    report_evaluation(copy)
    return copy, folder / "run", metrics


@pytest.mark.parametrize("name", ["tip_error", "safety_ratio", "control_error"])
def test_every_figure_has_its_table(reported, name):
    folder = reported[0] / "figures"
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert set(pd.read_csv(folder / f"{name}.csv")["split"]) == {"seen_test", "test"}


def test_the_evaluation_ends_with_a_report_that_needs_nothing_beside_it(reported):
    folder, run, metrics = reported
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert 'src="data:image/png' in page
    assert 'src="http' not in page
    assert f"endopilot evaluate {run} -o {folder}" in page
    assert f"{metrics['splits']['test']['tip']['P4']['abscissa']['0-10']['mae']:.2f}" in page


def test_a_folder_without_an_evaluation_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"metrics\.json: no such file"):
        report_evaluation(tmp_path)
    assert not any(tmp_path.iterdir())
