"""What the report says in words and in tables, made from the numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from endopilot.evaluation.metrics import DIVERGED_MM, SPANS_S, span_name
from endopilot.evaluation.results import SERIES_TITLES, TIP_BASELINES
from endopilot.types import Anatomy

EVALUATION_FIGURES: Mapping[str, str] = {
    "tip_error": "Mean tip error against time, networks beside baselines",
    "safety_ratio": "Safety ratio against time: recorded, predicted and simulated",
    "control_error": "Control error of each navigation: medians and quartiles",
}
"""Figures of an evaluation that the report shows, and what each is to someone who cannot see it."""

SPANS: tuple[str, ...] = tuple(span_name(span) for span in SPANS_S)
COORDINATES: Mapping[str, str] = {"abscissa": "Δtip", "offset": "γtip"}


class Row(NamedTuple):
    """One line of a table; `kind` is "network", "baseline" or "paper"."""

    title: str
    kind: str
    cells: list[str]


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
                cells = _tip_cells(tip[name])
                rows.append(Row(SERIES_TITLES[name], kind, [*cells, f"{100 * tip[name]['diverged_share']:.0f} %"]))
    spans = metrics["paper"].items()
    paper = {coordinate: {span: of.get(coordinate, {}) for span, of in spans} for coordinate in COORDINATES}
    return [*rows, Row("Kim et al. 2023, on data of their own", "paper", [*_tip_cells(paper), "–"])]


def _tip_cells(series: Mapping[str, Any]) -> list[str]:
    """Return a series' errors over the spans and its skill against the hardest baseline, of both coordinates."""
    cells = []
    for of in (series[coordinate] for coordinate in COORDINATES):
        skills = [skill for skill in of.get("all", {}).get("skill", {}).values() if skill is not None]
        cells += [*(_mean_sd(of.get(span, {})) for span in SPANS), _signed(min(skills, default=None))]
    return cells


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


def score_columns(patients: list[dict[str, Any]]) -> list[str]:
    """Return the names of all scores that any patient has."""
    return list(dict.fromkeys(name for patient in patients for name in patient["scores"]))


def _mm(series: Mapping[str, Any], coordinate: str) -> str:
    mae = series[coordinate]["all"]["mae"]
    return "–" if mae is None else f"{mae:.2f} mm"


def _mean_sd(statistics: Mapping[str, Any]) -> str:
    if statistics.get("mae") is None:
        return "–"
    return f"{statistics['mae']:.2f} ± {statistics['sd']:.2f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}".replace("-", "−")
