from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from endopilot.anatomy.io import write_anatomy
from endopilot.errors import InputError
from endopilot.evaluation import evaluate
from endopilot.files import manifest, read_json, write_json
from endopilot.imaging.volume import write_mask, write_volume
from endopilot.report import report
from endopilot.report.report import PatientContent, write_report
from endopilot.report.report_text import tip_rows
from endopilot.types import LumenMask, Volume


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
