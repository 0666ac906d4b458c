"""What the report says in words and in tables, made from the numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from endopilot.evaluation.metrics import DIVERGED_MM, SPANS_S, span_name
from endopilot.evaluation.results import SERIES_TITLES, TIP_BASELINES
from endopilot.types import Anatomy

EVALUATION_FIGURES: Mapping[str, str] = {
    "tip_error": "Mean tip error against time, networks beside baselines",
    "safety_ratio": "Safety ratio against time: recorded, predicted and simulated",
    "control_error": "Histograms of the control error of each navigation",
}
"""Figures of an evaluation that the report shows, and what each is to someone who cannot see it."""

NETWORK_TITLES: Mapping[str, str] = {"ff": "Forward network", "if": "Inverse network"}

SPANS: tuple[str, ...] = tuple(span_name(span) for span in SPANS_S)
COORDINATES: Mapping[str, str] = {"abscissa": "Δtip", "offset": "γtip"}


@dataclass(frozen=True)
class Cell:
    """One number of a table: what is shown, and where in metrics.json it stands ("/" between keys)."""

    text: str
    key: str = ""


@dataclass(frozen=True)
class Row:
    """One line of a table; `kind` is "network", "baseline" or "paper"."""

    title: str
    kind: str
    cells: tuple[Cell, ...]


def headline_split(metrics: Mapping[str, Any]) -> str:
    """Return the split that the headline is about: new patients where there are any."""
    return "test" if "test" in metrics["splits"] else next(iter(metrics["splits"]))


def tiles(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the key numbers: value, what it is, and what to compare it with."""
    split = metrics["splits"][headline_split(metrics)]
    tip = split["tip"]
    skill = tip["P1"]["abscissa"]["all"]["skill"].get("hold_slack")
    return [
        (
            _mm(tip["P1"], "abscissa"),
            "mean error of the tip's predicted place along the vessel",
            f"baseline {_mm(tip['hold_slack'], 'abscissa')}",
        ),
        (
            _mm(tip["P4"], "abscissa"),
            "from the desired tip, where the controls that a network chose are simulated",
            f"baseline {_mm(tip['follow_slack'], 'abscissa')}",
        ),
        (_signed(skill), "skill of that prediction over holding the slack", "1 is perfect, 0 no better, below 0 worse"),
        (
            f"{100 * tip['P4']['diverged_share']:.0f} %",
            f"of these simulated navigations err by over {DIVERGED_MM:g} mm at some time",
            f"baseline {100 * tip['follow_slack']['diverged_share']:.0f} %",
        ),
    ]


def tip_rows(metrics: Mapping[str, Any], split: str) -> list[Row]:
    """Return the table of tip errors of one split: protocols, each followed by its baselines, and the paper."""
    tip = metrics["splits"][split]["tip"]
    rows, shown = [], set()
    for series, baselines in TIP_BASELINES.items():
        for name in (series, *baselines):
            if name in tip and name not in shown:
                shown.add(name)
                kind = "network" if name in TIP_BASELINES else "baseline"
                rows.append(Row(SERIES_TITLES[name], kind, _tip_cells(tip, split, name)))
    paper = tuple(
        Cell(_mean_sd(metrics["paper"].get(span, {}).get(coordinate, {})), f"paper/{span}/{coordinate}/mae")
        for coordinate in COORDINATES
        for span in SPANS
    )
    blank = Cell("–")
    rows.append(Row("Kim et al. 2023, on data of their own", "paper", (*paper[:3], blank, *paper[3:], blank, blank)))
    return rows


def _tip_cells(tip: Mapping[str, Any], split: str, series: str) -> tuple[Cell, ...]:
    cells: list[Cell] = []
    for coordinate in COORDINATES:
        where = f"splits/{split}/tip/{series}/{coordinate}"
        for span in SPANS:
            cells.append(Cell(_mean_sd(tip[series][coordinate].get(span, {})), f"{where}/{span}/mae"))
        skills = {k: v for k, v in tip[series][coordinate]["all"]["skill"].items() if v is not None}
        hardest = min(skills, key=lambda name: skills[name]) if skills else None
        cells.append(Cell(_signed(skills[hardest]), f"{where}/all/skill/{hardest}") if hardest else Cell("–"))
    cells.append(Cell(f"{100 * tip[series]['diverged_share']:.0f} %", f"splits/{split}/tip/{series}/diverged_share"))
    return tuple(cells)


def mean_errors(metrics: Mapping[str, Any], split: str) -> list[dict[str, str]]:
    """Return the mean absolute errors of one split, mm: a row a series, a column a coordinate and span."""
    tip = metrics["splits"][split]["tip"]
    return [
        {"series": series}
        | {
            f"{symbol} {span}": "–"
            if (mae := tip[series][coordinate].get(span, {}).get("mae")) is None
            else f"{mae:.3f}"
            for coordinate, symbol in COORDINATES.items()
            for span in (*SPANS, "all")
        }
        for series in tip
    ]


def interval_remark(metrics: Mapping[str, Any], split: str) -> str:
    """Return the interval of the headline error over patients, or why there is none."""
    record = metrics["splits"][split]
    intervals = record["tip"]["P1"]["abscissa"]["all"]["intervals"]
    if intervals is None:
        return f"With {_count(len(record['anatomies']), 'patient')} the spread between patients is unknown."
    low, high = intervals["mae"]
    return (
        f"Drawing the {len(record['anatomies'])} patients again (bootstrap), the mean error of Δtip in P1 lies between "
        f"{low:.2f} and {high:.2f} mm in 95 % of draws; so few patients bound it only roughly."
    )


def anatomy_facts(anatomy: Anatomy) -> list[tuple[str, str]]:
    """Return the key facts of a vessel."""
    tree = anatomy.tree
    longest = tree.longest_path()
    chord = float(np.linalg.norm(longest.points[-1] - longest.points[0]))
    return [
        ("longest path", f"{longest.abscissa[-1]:.0f} mm"),
        ("branches", f"{len(tree.branches)}"),
        ("lumen radius", f"{np.median(longest.radius):.1f} mm (median on that path)"),
        ("tortuosity", f"{longest.abscissa[-1] / max(chord, 1e-6):.2f}"),
        ("sections", ", ".join(tree.sections_present)),
    ]


def training_budget(record: Mapping[str, Any]) -> str:
    """Return how long the networks were trained, as a sentence."""
    parts = [
        f"{NETWORK_TITLES[network].lower()} {_count(len(result['curve']), 'epoch')}, in all "
        f"{sum(epoch['steps'] for epoch in result['curve']):,} steps in {result['seconds']:.0f} s"
        for network, result in record.items()
    ]
    return f"Training: {'; '.join(parts)}. The paper trained for 20 epochs on 80,000 navigations."


def score_columns(patients: list[dict[str, Any]]) -> list[str]:
    """Return the names of all scores that any patient has."""
    return list(dict.fromkeys(name for patient in patients for name in patient["scores"]))


SCORE_TITLES: Mapping[str, str] = {
    "dice": "Dice",
    "cldice": "clDice",
    "overlap": "centerline overlap",
    "inside_accuracy_mm": "centerline error, mm",
    "radius_mae_mm": "radius error, mm",
    "ostium_error_mm": "ostium error, mm",
    "false_length_mm": "false branches, mm",
}
"""Headings of the anatomy's scores; others are shown by their names."""


def score_title(name: str) -> str:
    """Return a score's heading."""
    return SCORE_TITLES.get(name, name.replace("_", " "))


def _mm(series: Mapping[str, Any], coordinate: str) -> str:
    mae = series[coordinate]["all"]["mae"]
    return "–" if mae is None else f"{mae:.2f} mm"


def _mean_sd(statistics: Mapping[str, Any]) -> str:
    if statistics.get("mae") is None:
        return "–"
    return f"{statistics['mae']:.2f} ± {statistics['sd']:.2f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}".replace("-", "−")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
