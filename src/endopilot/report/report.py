"""The report: one HTML file that needs nothing beside it; `report_evaluation` makes one of what `evaluate` left."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from endopilot.anatomy.io import read_anatomy
from endopilot.evaluation.results import (
    FIGURES_FOLDER,
    METRICS_FILE,
    REPORT_FILE,
    RESULTS_FILE,
    SplitResult,
    read_results,
)
from endopilot.files import json_text, read_json, write_whole
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.plotting import png
from endopilot.report import figures, report_text
from endopilot.report.scene import navigation_scene, scene_html
from endopilot.simulation.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class PatientContent:
    """One patient of a report: the folder of the anatomy, the CT and the mask on its grid, if there are, and the
    agreement with a known truth by names that end in their unit."""

    name: str
    anatomy: Path
    volume: Path | None = None
    mask: Path | None = None
    scores: Mapping[str, float] = field(default_factory=dict)


def write_report(
    output_html: Path,
    *,
    title: str,
    origin: str,
    command: str,
    patients: Sequence[PatientContent] = (),
    evaluation: Path | None = None,
    replay: tuple[Path, Trajectory] | None = None,
    navigation: Path | None = None,
    stage_seconds: Mapping[str, float] = MappingProxyType({}),
    manifest: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write the report as one HTML file; what is not given is left out. `origin` is one sentence that says what the
    patients are: real, or synthetic and how made. `evaluation` is a folder made by `endopilot evaluate`, `navigation`
    one by `endopilot navigate`, beside or below the report; `replay` is the folder of an anatomy, and navigations in it
    with `shape`, the first of which is shown in space; `manifest` says how everything was made (`files.manifest`).
    Raises InputError for a missing or damaged file, or a report that cannot be written."""
    write_page(
        output_html,
        "report.html.j2",
        title=title,
        origin=origin,
        command=command,
        stage_seconds=stage_seconds,
        metrics=read_json(evaluation / METRICS_FILE) if evaluation is not None else None,
        text=report_text,
        patients=[_patient(patient) for patient in patients],
        driven=_driven(navigation, output_html.parent),
        scene=_scene(replay or (patients[0].anatomy, None)) if replay or patients else None,
        figures={name: _stored_figure(evaluation, name) for name in report_text.EVALUATION_FIGURES},
        record=manifest,
        manifest=json_text(manifest) if manifest else "",
    )


def write_page(path: Path, template: str, **content: Any) -> None:
    """Write a page of the templates' folder with its style and its content; InputError if it cannot be written."""
    made = Environment(
        loader=PackageLoader("endopilot.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    css = (Path(__file__).parent / "templates" / "report.css").read_text(encoding="utf-8")
    page = made.get_template(template).render(css=Markup(css), **content)
    write_whole(path, page)


def _patient(patient: PatientContent) -> dict[str, Any]:
    anatomy = read_anatomy(patient.anatomy)
    if patient.volume is not None and patient.mask is not None:
        figure = figures.volume_figure(read_volume(patient.volume), read_mask(patient.mask), anatomy)
    else:
        figure = figures.tree_figure(anatomy)
    return {
        "name": patient.name,
        "picture": image(png(figure), f"{patient.name}: CT with the segmented lumen, and the centerline"),
        "facts": report_text.anatomy_facts(anatomy),
        "scores": dict(patient.scores),
    }


def _driven(navigation: Path | None, beside: Path) -> dict[str, Any] | None:
    if navigation is None:
        return None
    figures = read_json(navigation / "manifest.json")["figures"]
    picture = (navigation / "navigation.png").read_bytes()
    page = navigation / "navigation.html"
    return {
        "outcome": figures["outcome"],
        "picture": image(picture, "The navigation: the vessel with the tip's path, and its figures over time"),
        "href": Path(os.path.relpath(page, beside)).as_posix(),
    }


def _scene(shown: tuple[Path, Trajectory | None]) -> dict[str, Any]:
    anatomy, replay = read_anatomy(shown[0]), shown[1]
    figure, caption = navigation_scene(anatomy, replay), f"The vessel of {anatomy.name}."
    if replay is not None:
        seconds = replay.valid.shape[1] * replay.period_s
        caption = f"{seconds:g} s of navigation in {anatomy.name}, simulated with the Cosserat rod core."
    return {
        "html": scene_html(figure),
        "plotly": Markup(get_plotlyjs()),
        "caption": caption,
    }


def _stored_figure(evaluation: Path | None, name: str) -> Markup | None:
    path = None if evaluation is None else evaluation / FIGURES_FOLDER / f"{name}.png"
    if path is None or not path.exists():
        return None
    return image(path.read_bytes(), report_text.EVALUATION_FIGURES[name])


def image(png: bytes, description: str) -> Markup:
    """Return a PNG as an HTML element that needs no file."""
    data = base64.b64encode(png).decode("ascii")
    return Markup(f'<img alt="{html.escape(description)}" src="data:image/png;base64,{data}">')


def report_evaluation(folder: Path) -> Path:
    """Write the PNG and the CSV of each figure into `figures/`, and then `report.html`, one page that stands alone;
    return its path. Raises InputError where the folder holds no evaluation, or a damaged one."""
    metrics = read_json(folder / METRICS_FILE)
    titles = {split: of["title"] for split, of in metrics["splits"].items()}
    _write_figures(read_results(folder / RESULTS_FILE), titles, folder / FIGURES_FOLDER)
    return _write_page(folder, metrics)


def _write_figures(results: Mapping[str, SplitResult], titles: Mapping[str, str], folder: Path) -> None:
    drawn = {
        "tip_error": (figures.tip_error_table(results), figures.tip_error_figure),
        "safety_ratio": (figures.safety_table(results), figures.safety_figure),
        "control_error": (figures.control_error_table(results), figures.control_error_figure),
    }
    for name, (table, draw) in drawn.items():
        write_whole(folder / f"{name}.csv", table.to_csv(index=False))
        write_whole(folder / f"{name}.png", png(draw(table, titles)))


def _write_page(folder: Path, metrics: Mapping[str, Any]) -> Path:
    record, run, dataset = metrics["manifest"], metrics["run"], metrics["dataset"]
    command = ["endopilot", "evaluate", run, "-o", str(folder), "--dataset", dataset]
    for option in ("sequences", "seed"):
        value = record["config"][option]
        command += [] if value is None else [f"--{option}", str(value)]
    page = folder / REPORT_FILE
    write_report(
        page,
        title="endopilot: evaluation of a trained run",
        origin=f"The run {run}, on the dataset {dataset}.",
        command=" ".join(command),
        evaluation=folder,
        manifest=record,
    )
    return page
