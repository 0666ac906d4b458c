"""The figures and the page of an evaluation, made from what `evaluate` left on disk: `report_evaluation`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from endopilot.evaluation.results import (
    FIGURES_FOLDER,
    METRICS_FILE,
    REPORT_FILE,
    RESULTS_FILE,
    SplitResult,
    read_results,
)
from endopilot.files import read_json, writing
from endopilot.models.config import run_path
from endopilot.plotting import png
from endopilot.report import figures, tables
from endopilot.report.report import ReportContent, write_report


def report_evaluation(folder: Path) -> Path:
    """Write the PNG and the CSV of each figure into `figures/`, and then `report.html`, one page that stands alone.

    Args:
        folder: what `evaluate` wrote; the figures and the page go there too.

    Returns:
        The page's path.

    Raises:
        InputError: the folder holds no evaluation, or a damaged one.
    """
    metrics = read_json(folder / METRICS_FILE)
    titles = {split: of["title"] for split, of in metrics["splits"].items()}
    _write_figures(read_results(folder / RESULTS_FILE), titles, folder / FIGURES_FOLDER)
    return _write_page(folder, metrics)


def _write_figures(results: Mapping[str, SplitResult], titles: Mapping[str, str], folder: Path) -> None:
    drawn = {
        "tip_error": (tables.tip_error_table(results), figures.tip_error_figure),
        "safety_ratio": (tables.safety_table(results), figures.safety_figure),
        "control_error": (tables.control_error_table(results), figures.control_error_figure),
        "drive_difference": (tables.drive_difference_table(results), figures.drive_difference_figure),
    }
    for name, (table, draw) in drawn.items():
        with writing(folder / f"{name}.csv") as partial:
            table.to_csv(partial, index=False)
        with writing(folder / f"{name}.png") as partial:
            partial.write_bytes(png(draw(table, titles)))


def _write_page(folder: Path, metrics: Mapping[str, Any]) -> Path:
    record, run, dataset = metrics["manifest"], metrics["run"], metrics["dataset"]
    command = ["endopilot", "evaluate", run, "-o", str(folder), "--dataset", dataset]
    for option in ("sequences", "seed"):
        value = record["config"][option]
        command += [] if value is None else [f"--{option}", str(value)]
    content = ReportContent(
        title="endopilot: evaluation of a trained run",
        origin=f"The run {run}, on the dataset {dataset}.",
        command=" ".join(command),
        evaluation=folder,
        run=run_path(Path(run)),
        manifest=record,
    )
    page = folder / REPORT_FILE
    write_report(page, content)
    return page
