"""Reports, their figures, those of an evaluation, and the scene of a navigation."""

from __future__ import annotations

import dataclasses
import html
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.wall_mesh import wall_mesh
from endopilot.devices.catheter import read_catheter
from endopilot.devices.stack import SHOWN_BEHIND_MM, Stack
from endopilot.errors import InputError
from endopilot.evaluation import evaluate
from endopilot.evaluation.results import METRICS_FILE, RESULTS_FILE
from endopilot.files import manifest, read_json, write_json
from endopilot.imaging.overlay_picture import draw_slices
from endopilot.imaging.volume import write_mask, write_volume
from endopilot.report import figures, report, still
from endopilot.report.report import PatientContent, report_evaluation, write_report
from endopilot.report.report_text import tip_rows
from endopilot.report.scene import navigation_scene, visible_devices
from endopilot.report.still import LIBRARIES_MISSING, render_still
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import DistanceMap, Insertion, LumenMask, TipProjection, Volume


class Page:
    """What a test wants to know of a page: ids of its sections, what it loads, and its words."""

    def __init__(self, text: str):
        text = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL)
        self.sections = re.findall('<section id="([^"]+)"', text)
        self.loaded = re.findall('(?:src|srcset|data|poster)="([^"]*)"|<link[^>]*href="([^"]*)"', text)
        self.words = html.unescape(re.sub(r"<[^>]*>", " ", text))


@pytest.fixture(scope="module")
def material(tmp_path_factory, anatomy, results):
    """Return a folder with an anatomy, its CT and mask, and an evaluation."""
    folder = tmp_path_factory.mktemp("material")
    write_anatomy(anatomy, output=folder / "anatomy")
    inside = np.asarray(anatomy.distance_map.values) > 0
    grid = (np.full(3, anatomy.distance_map.spacing_mm), anatomy.distance_map.origin_mm, np.eye(3))
    write_volume(Volume(np.where(inside, 400, -80).astype(np.int16), *grid), folder / "ct.nii.gz")
    write_mask(LumenMask(Volume(inside, *grid), anatomy.insertion), folder / "mask.nii.gz", manifest={})
    write_json(folder / "evaluation" / "metrics.json", evaluate._metrics(results, {"a", "b"}, 0))
    titles = {"seen_test": "New navigations, known patients", "test": "New patients"}
    report._write_figures(results, titles, folder / "evaluation" / "figures")
    return folder


def make_content(folder, rollout) -> dict[str, Any]:
    patient = PatientContent(
        name="tube <1>",
        anatomy=folder / "anatomy",
        volume=folder / "ct.nii.gz",
        mask=folder / "mask.nii.gz",
        scores={"dice": 0.9123, "radius_mae_mm": 0.1},
    )
    return {
        "title": "A tube",
        "origin": "One tube, made up for a test.",
        "command": "endopilot demo --seed 7",
        "patients": (patient,),
        "evaluation": folder / "evaluation",
        "replay": (folder / "anatomy", rollout),
        "stage_seconds": {"atlas": 1.5, "training": 20.25},
        "manifest": manifest(config={"patients": 1}, seed=7),
    }


def write_page(tmp_path, **content) -> Page:
    write_report(tmp_path / "report.html", **content)
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(material, rollout, tmp_path_factory) -> Page:
    return write_page(tmp_path_factory.mktemp("page"), **make_content(material, rollout))


def test_every_section_is_there(page):
    expected = ["result", "patients", "navigation-in-space", "tip", "safety", "control", "stages", "repeat"]
    assert page.sections == expected


def test_nothing_is_loaded_from_outside(page):
    assert len(page.loaded) == 4
    assert all(source.startswith("data:") for source, _ in page.loaded)
    style = (Path(report.__file__).parent / "templates" / "report.css").read_text(encoding="utf-8")
    assert not re.search(r"url\(|@import", style)


def test_the_numbers_of_the_tables_are_those_of_metrics_json(material):
    metrics = read_json(material / "evaluation" / "metrics.json")
    first, *_, paper = tip_rows(metrics, "test")
    tip, shown = metrics["splits"]["test"]["tip"]["P1"], iter(first.cells)
    for of in (tip["abscissa"], tip["offset"]):
        for span in ("0-10", "10-30", "30-45"):
            assert next(shown) == f"{of[span]['mae']:.2f} ± {of[span]['sd']:.2f}"
        assert next(shown).replace("−", "-") == f"{min(of['all']['skill'].values()):+.2f}"
    assert next(shown) == f"{100 * tip['diverged_share']:.0f} %"
    assert ",".join(paper.cells) == "0.25 ± 0.22,0.31 ± 0.27,0.62 ± 0.60,–,0.09 ± 0.10,0.12 ± 0.14,0.14 ± 0.16,–,–"


@pytest.mark.parametrize(
    "words",
    [
        "New patients, P4: Δtip loses to a baseline",
        "Generalisation gap, P1: mean error in new patients against known ones",
        "endopilot demo --seed 7",
        "seed 7",
        "tube <1>",  # a name cannot break the page
        "0.62 ± 0.60",  # the paper's error, beside ours
    ],
)
def test_words_of_the_page(page, words):
    assert words in page.words


def test_sections_with_nothing_to_show_are_left_out(material, tmp_path):
    patient = PatientContent(name="mesh", anatomy=material / "anatomy")
    page = write_page(tmp_path, title="T", origin="O", command="C", patients=(patient,))
    assert page.sections == ["result", "patients", "navigation-in-space", "repeat"]
    assert "Nothing was evaluated" in page.words


def test_one_known_patient_alone_is_reported(material, results, tmp_path):
    write_json(tmp_path / "e" / "metrics.json", evaluate._metrics({"seen_test": results["test"]}, {"c"}, 0))
    page = write_page(tmp_path, title="T", origin="O", command="C", evaluation=tmp_path / "e")
    assert "Of new navigations, known patients; the first 15 s" in page.words


def test_a_failed_report_leaves_nothing_behind(material, rollout, tmp_path):
    content = make_content(material, rollout) | {"evaluation": tmp_path / "nowhere"}
    with pytest.raises(InputError, match=r"metrics\.json"):
        write_report(tmp_path / "report.html", **content)
    assert list(tmp_path.iterdir()) == []


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


CENTRE, SQUEEZE = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 1.5])


def egg(radius_mm: float, spacing_mm: float, origin_mm: np.ndarray) -> DistanceMap:
    """Return an ellipsoid with three different axes as (about) a distance map."""
    axes = [np.arange(low, low + 24.0, spacing_mm) for low in origin_mm]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    squeezed = (np.stack([x, y, z], axis=-1) - CENTRE) * SQUEEZE
    return DistanceMap(radius_mm - np.linalg.norm(squeezed, axis=-1), spacing_mm, origin_mm)


@pytest.mark.parametrize("max_triangles", [100_000, 2_000])
def test_the_wall_lies_where_the_distance_is_zero(max_triangles):
    surface = wall_mesh(egg(8.0, 0.5, np.array([-11.0, -10.0, -9.0])), max_triangles=max_triangles)
    assert len(surface.triangles) <= max_triangles
    distance = np.linalg.norm((surface.vertices - CENTRE) * SQUEEZE, axis=1)
    np.testing.assert_allclose(distance, 8.0, atol=0.1)


def test_a_lumen_that_reaches_the_edge_of_its_map_is_closed_there():
    surface = wall_mesh(egg(8.0, 0.5, np.array([1.0, -10.0, -9.0])))
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_the_wire_is_shown_from_its_tip_to_just_behind_the_ostium(rollout):
    (wire,) = visible_devices(rollout, 0, 3)
    np.testing.assert_array_equal(wire[0], rollout.tip_position[0, 3, 0])
    length = np.linalg.norm(np.diff(wire, axis=0), axis=1).sum()
    assert (
        rollout.inserted_length[0, 3, 0] + SHOWN_BEHIND_MM - 2.0
        < length
        <= rollout.inserted_length[0, 3, 0] + SHOWN_BEHIND_MM
    )


def test_every_sample_is_a_frame_and_a_step_of_the_slider(anatomy, rollout):
    figure = navigation_scene(anatomy, rollout)
    frames = list(figure.frames)
    assert [frame.name for frame in frames] == [str(sample) for sample in range(6)]
    steps = figure.layout.sliders[0].steps
    assert [step.label for step in steps] == ["0.5", "1", "1.5", "2", "2.5", "3"]
    np.testing.assert_allclose(np.array(frames[4].data[0].z)[0], rollout.tip_position[0, 4, 0, 2])
    assert "Δtip = 24.0 mm" in frames[4].data[0].hovertemplate
    # The frames replace the wire, its trail and its tip, not the vessel.
    assert [figure.data[index].name for index in frames[4].traces] == ["Guidewire", "Tip, last 20 s", "Tip"]


@pytest.fixture
def pair(rollout) -> Trajectory:
    """Return the wire with a catheter that stays behind it until the last sample, in which it leads by 2 mm."""
    inserted = np.array([0.0, 3.0, 7.0, 9.0, 12.0, 30.0])[None, :, None]
    deepest = np.maximum(rollout.inserted_length, inserted)
    shape = rollout.shape.copy()
    shape[..., 2] = -deepest + 2.0 * np.arange(shape.shape[2])
    both = {
        each.name: np.repeat(value, 2, axis=2)
        for each in dataclasses.fields(rollout)
        if each.name != "shape" and np.ndim(value := getattr(rollout, each.name)) > 2 and value.shape[1] == 6
    }
    both["inserted_length"][:, :, 1:] = inserted
    both["rotation"][:, :, 1] = np.pi
    both["tip_position"][:, :, 1, 2] = -inserted[..., 0]
    both["drive_force"][:] = 0.5, 0.25
    tip = TipProjection(**{name: np.repeat(value, 2, axis=2) for name, value in vars(rollout.tip).items()})
    start = np.repeat(rollout.start, 2, axis=1)
    return dataclasses.replace(rollout, shape=shape, tip=tip, start=start, **both)


@pytest.fixture
def devices(wire):
    """Return a wire and a catheter around it."""
    return Stack(wire, (read_catheter("microcatheter-2.4f"),)).devices


def test_a_catheter_covers_its_wire_and_both_are_named(anatomy, pair, devices):
    wire, catheter, *others = navigation_scene(anatomy, pair, devices=devices).frames[2].data
    assert (wire.name, catheter.name) == ("Guidewire workhorse-014", "Catheter microcatheter-2.4f")
    assert [trace.name for trace in others] == ["Tip, last 20 s", "Tip"]
    assert wire.line.color != catheter.line.color
    assert catheter.line.width / wire.line.width == pytest.approx(devices[1].diameter_mm / 0.36, rel=0.05)
    z = np.array(wire.z), np.array(catheter.z)
    np.testing.assert_allclose(z[0], [-16.0, -14.0, -12.0, -10.0, -8.0, -7.0])
    np.testing.assert_allclose(z[1][[0, 1, -1]], [-7.0, -6.0, SHOWN_BEHIND_MM])
    assert "Δtip = 16.0 mm" in wire.hovertemplate and "push of its drive = 0.50 N" in wire.hovertemplate
    for state in ("Δ = 7.0 mm", "φ = 180°", "push of its drive = 0.25 N"):
        assert state in catheter.hovertemplate


def dies(*given):
    os.abort()


def test_a_renderer_that_dies_is_one_line_and_no_picture(anatomy, tmp_path, monkeypatch):
    monkeypatch.setattr(still, "render", dies)
    assert render_still(anatomy, [], tmp_path / "scene.png") == LIBRARIES_MISSING
    assert "apt-get install" in LIBRARIES_MISSING
    assert "\n" not in LIBRARIES_MISSING
    assert list(tmp_path.iterdir()) == []


def test_the_still_picture_shows_vessel_wire_and_catheter(anatomy, pair, devices, tmp_path):
    from matplotlib.image import imread

    if render_still(anatomy, visible_devices(pair, 0, 4), tmp_path / "scene.png", devices=devices) is not None:
        pytest.skip("VTK finds no graphics library here")
    picture = imread(tmp_path / "scene.png")[..., :3]
    turquoise = (picture[..., 1:].min(axis=-1) > picture[..., 0] + 0.3).mean()
    reddish = (picture[..., 0] > picture[..., 2] + 0.1).mean()
    assert turquoise > 1e-3 and 0.01 < reddish < 0.6  # the catheter and the vessel
    assert (picture.min(axis=-1) > 0.6).mean() > 1e-4  # the wire
