from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from endopilot.anatomy.io import write_anatomy
from endopilot.errors import InputError
from endopilot.evaluation import evaluate
from endopilot.files import manifest, read_json, write_json
from endopilot.imaging.volume import write_mask, write_volume
from endopilot.report import report
from endopilot.report.report import PatientContent, ReportContent, write_report
from endopilot.report.still import LIBRARIES_MISSING
from endopilot.types import LumenMask, Volume


class Page(HTMLParser):
    """What a test wants to know of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.sections: list[str] = []
        self.loaded: list[str] = []
        self.cells: dict[str, str] = {}
        self.words = ""
        self._key: str | None = None
        self._silent = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag == "section":
            self.sections.append(attributes["id"])
        self.loaded += [attributes[name] for name in ("src", "srcset", "data", "poster") if name in attributes]
        self.loaded += [attributes["href"]] if tag == "link" else []
        self._key = attributes.get("data-key") if tag == "td" else None
        self._silent = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._silent = False

    def handle_data(self, data):
        if self._key:
            self.cells[self._key] = data
            self._key = None
        self.words += "" if self._silent else data


@pytest.fixture(scope="module")
def material(tmp_path_factory, anatomy, results):
    """Return a folder with an anatomy, its CT and mask, an evaluation and a training record."""
    folder = tmp_path_factory.mktemp("material")
    write_anatomy(anatomy, output=folder / "anatomy")
    inside = np.asarray(anatomy.distance_map.values) > 0
    grid = (np.full(3, anatomy.distance_map.spacing_mm), anatomy.distance_map.origin_mm, np.eye(3))
    write_volume(Volume(np.where(inside, 400, -80).astype(np.int16), *grid), folder / "ct.nii.gz")
    write_mask(LumenMask(Volume(inside, *grid), anatomy.insertion), folder / "mask.nii.gz", manifest={})
    write_json(folder / "evaluation" / "metrics.json", evaluate._metrics(results, {"a", "b"}, 0))
    titles = {"seen_test": "New navigations, known patients", "test": "New patients"}
    report._write_figures(results, titles, folder / "evaluation" / "figures")
    curve = [{"epoch": n, "steps": 20, "loss": 1.0 / n, "validation_loss": None} for n in (1, 2, 3)]
    record = {"seconds": 12.0, "curve": curve}
    write_json(folder / "run" / "training.json", {"ff": record, "if": record})
    return folder


def make_content(folder, rollout) -> ReportContent:
    patient = PatientContent(
        name="tube <1>",
        anatomy=folder / "anatomy",
        volume=folder / "ct.nii.gz",
        mask=folder / "mask.nii.gz",
        scores={"dice": 0.9123, "radius_mae_mm": 0.1},
    )
    return ReportContent(
        title="A tube",
        origin="One tube, made up for a test.",
        command="endopilot demo --seed 7",
        patients=(patient,),
        evaluation=folder / "evaluation",
        run=folder / "run",
        replay=rollout,
        replay_anatomy=folder / "anatomy",
        stage_seconds={"atlas": 1.5, "training": 20.25},
        manifest=manifest(config={"patients": 1}, seed=7),
    )


@pytest.fixture
def no_still(monkeypatch):
    monkeypatch.setattr(report, "render_still", lambda *_: LIBRARIES_MISSING)


def write_page(tmp_path, content) -> Page:
    write_report(tmp_path / "report.html", content)
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(material, rollout, tmp_path_factory) -> Page:
    with patch.object(report, "render_still", lambda *_: LIBRARIES_MISSING):
        return write_page(tmp_path_factory.mktemp("page"), make_content(material, rollout))


def test_every_section_is_there(page):
    expected = ["result", "patients", "navigation-in-space", "tip", "safety", "control", "stages", "repeat"]
    assert page.sections == expected


def test_nothing_is_loaded_from_outside(page):
    assert len(page.loaded) == 4
    assert all(source.startswith("data:") for source in page.loaded)


def test_style_sheets_load_nothing():
    assert not re.search(
        r"url\(|@import", (Path(report.__file__).parent / "templates" / "report.css").read_text(encoding="utf-8")
    )


def test_the_numbers_of_the_tables_are_those_of_metrics_json(page, material):
    metrics = read_json(material / "evaluation" / "metrics.json")
    assert len(page.cells) > 100
    for key, text in page.cells.items():
        value = metrics
        for name in key.split("/"):
            value = value[name]
        shown = float(text.split(" ")[0].replace("−", "-"))
        scale = 100 if text.endswith("%") else 1
        assert shown == pytest.approx(scale * value, abs=0.51 if scale == 100 else 0.0051), key


def test_the_papers_errors_stand_beside_ours(page):
    assert page.cells["paper/30-45/abscissa/mae"] == "0.62 ± 0.60"
    assert page.cells["paper/0-10/offset/mae"] == "0.09 ± 0.10"


def test_losses_are_named_in_words(page):
    assert "New patients, P4: Δtip loses to a baseline" in page.words
    assert "Generalisation gap, P1: mean error in new patients against known ones" in page.words
    assert "forward network 3 epochs, in all 60 steps in 12 s" in page.words


def test_how_to_repeat_it(page):
    assert "endopilot demo --seed 7" in page.words
    assert "seed 7" in page.words


def test_names_cannot_break_the_page(page):
    assert "tube <1>" in page.words


def test_a_missing_graphics_library_is_named_and_the_report_goes_on(material, rollout, tmp_path, no_still):
    remarks = write_report(tmp_path / "report.html", make_content(material, rollout))
    assert remarks == [LIBRARIES_MISSING]
    assert "apt-get install libegl1" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_sections_with_nothing_to_show_are_left_out(material, tmp_path, no_still):
    patient = PatientContent(name="mesh", anatomy=material / "anatomy")
    page = write_page(tmp_path, ReportContent(title="T", origin="O", command="C", patients=(patient,)))
    assert page.sections == ["result", "patients", "navigation-in-space", "repeat"]
    assert "Nothing was evaluated" in page.words


def test_one_known_patient_alone_is_reported(material, results, tmp_path, no_still):
    write_json(tmp_path / "e" / "metrics.json", evaluate._metrics({"seen_test": results["test"]}, {"c"}, 0))
    content = ReportContent(title="T", origin="O", command="C", evaluation=tmp_path / "e")
    page = write_page(tmp_path, content)
    assert "Of new navigations, known patients; the first 15 s" in page.words
    assert "With 1 patient the spread between patients is unknown" in page.words


def test_a_failed_report_leaves_nothing_behind(material, rollout, tmp_path, no_still):
    content = dataclasses.replace(make_content(material, rollout), run=tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"training\.json"):
        write_report(tmp_path / "report.html", content)
    assert list(tmp_path.iterdir()) == []
