"""From predicted arrays to metrics.json: every number of the report is made here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from endopilot.anatomy.projection import safety_ratio
from endopilot.evaluation.metrics import (
    OFF_WALL_MM,
    by_depth,
    control_rmse,
    distribution,
    diverged_share,
    error_statistics,
    rmse_of_sequences,
    skill,
    span_slices,
    tip_statistics,
    worst_anatomy,
)
from endopilot.evaluation.results import CONTROL_BASELINES, REPLAYED, TIP_BASELINES, SplitResult, TipSeries

SPLIT_TITLES: Mapping[str, str] = {"seen_test": "New navigations, known patients", "test": "New patients"}
"""What a reader calls the splits of a result."""


def summarize(result: SplitResult, *, seed: int) -> dict[str, Any]:
    """Return the figures of one split: tips, controls, safety ratios and forces of drive, by series."""
    baselines = [name for names in TIP_BASELINES.values() for name in names]
    shown = [name for name in dict.fromkeys((*TIP_BASELINES, *baselines, *REPLAYED)) if name in result.tips]
    return {
        "anatomies": list(result.anatomies),
        "episodes": len(result.anatomy),
        "event_shares": {name: float(where.mean()) for name, where in result.events.items()},
        "tip": {series: _tip(result, series, seed) for series in shown},
        "control": _control(result),
        "safety": {series: _safety(result, series) for series in ("true", *shown)},
        "drive": {series: _drive(result, series) for series in result.base_force if series != "true"},
    }


def _tip(result: SplitResult, series: str, seed: int) -> dict[str, Any]:
    baselines = [name for name in TIP_BASELINES.get(series, ()) if name in result.tips]
    lost = result.lost(series)
    out: dict[str, Any] = {
        coordinate: tip_statistics(
            result.error(series, coordinate),
            radius=result.true.radius,
            baselines={name: result.error(name, coordinate) for name in baselines},
            anatomy=result.anatomy,
            sample_period_s=result.sample_period_s,
            seed=seed,
        )
        | {"by_depth": by_depth(result.error(series, coordinate), result.true.abscissa)}
        for coordinate in ("abscissa", "offset")
    }
    clearance = result.true.radius - result.wire_radius_mm - result.true.offset
    off_wall = clearance > OFF_WALL_MM
    error = result.error(series, "abscissa")
    out["offset_off_wall"] = error_statistics(np.where(off_wall, result.error(series, "offset"), np.nan))
    out["off_wall_share"] = float(off_wall.mean())
    out["diverged_share"] = diverged_share(error, lost)
    out["lost_share"] = float(lost.mean())
    out["worst_anatomy"] = worst_anatomy(error, result.anatomy, result.anatomies)
    if series in result.tip_distance:
        out["distance_3d"] = error_statistics(result.tip_distance[series])
    return out


def over_seeds(result: SplitResult, tips: Sequence[TipSeries]) -> dict[str, Any]:
    """Return the mean absolute errors of several seeds' tips, by coordinate and span: each, their mean and their SD."""
    out: dict[str, Any] = {}
    for coordinate in ("abscissa", "offset"):
        errors = [getattr(tip, coordinate) - getattr(result.true, coordinate) for tip in tips]
        out[coordinate] = {}
        spans = span_slices(errors[0].shape[1], result.sample_period_s) | {"all": slice(None)}
        for span, samples in spans.items():
            each = [error_statistics(error[:, samples])["mae"] for error in errors]
            known = [mae for mae in each if mae is not None]
            mean, sd = (float(np.mean(known)), float(np.std(known, ddof=1))) if len(known) > 1 else (None, None)
            out[coordinate][span] = {"mae": each, "mean": mean, "sd": sd}
    return out


def _control(result: SplitResult) -> dict[str, Any]:
    """Return the errors of the controls that each series chose, over all samples and as RMSE of each sequence."""
    scale = np.array([1.0, np.rad2deg(1.0)])
    errors = {name: (control - result.true_control) * scale for name, control in result.controls.items()}
    out: dict[str, Any] = {}
    for name in ("P2", *CONTROL_BASELINES):
        if name not in errors:
            continue
        per_sequence = control_rmse(result.controls[name], result.true_control)
        out[name] = {}
        for axis, key in enumerate(("translation_mm_s", "rotation_deg_s")):
            statistics: dict[str, Any] = dict(error_statistics(errors[name][..., axis]))
            statistics["rmse_of_sequences"] = distribution(per_sequence[:, axis])
            if name == "P2":
                statistics["skill"] = {
                    other: skill(errors[name][..., axis], errors[other][..., axis])
                    for other in CONTROL_BASELINES
                    if other in errors
                }
            out[name][key] = statistics
    return out


def _safety(result: SplitResult, series: str) -> dict[str, Any]:
    tip = result.true if series == "true" else result.tips[series]
    return {
        "over_radius": distribution(safety_ratio(tip.offset, tip.radius, 0.0).ravel()),
        "over_clearance": distribution(safety_ratio(tip.offset, tip.radius, result.wire_radius_mm).ravel()),
    }


def _drive(result: SplitResult, series: str) -> dict[str, Any]:
    out = {}
    for key, signal in (("force_n", "force"), ("torque_nmm", "torque")):
        difference = result.drive_difference(series, signal)
        of_sequences = distribution(rmse_of_sequences(difference))
        out[key] = error_statistics(difference) | {"rmse_of_sequences": of_sequences}
    return out


def generalisation_gap(splits: Mapping[str, Any]) -> dict[str, Any]:
    """Return how much larger the mean absolute errors are in new patients than in those that were trained on.

    By series, coordinate and span: `difference` (mm) and `ratio`; None where an error is not known or is 0. Empty
    unless there are both kinds of patients.
    """
    if not {"seen_test", "test"} <= splits.keys():
        return {}
    known, new = splits["seen_test"], splits["test"]
    return {
        series: {
            coordinate: {
                span: _gap(known["tip"][series][coordinate][span]["mae"], new["tip"][series][coordinate][span]["mae"])
                for span in new["tip"][series][coordinate]
                if span != "by_depth"
            }
            for coordinate in ("abscissa", "offset")
        }
        for series in TIP_BASELINES
        if series in known["tip"] and series in new["tip"]
    }


def _gap(known: float | None, new: float | None) -> dict[str, float | None]:
    if known is None or new is None:
        return {"difference": None, "ratio": None}
    return {"difference": new - known, "ratio": new / known if known else None}


BASELINE_WORDS: Mapping[str, str] = {
    "hold_slack": "holding slack and offset",
    "training_mean": "the training mean",
    "hold_control": "holding the last control",
    "follow_slack": "driving by the held slack",
}


def findings(metrics: Mapping[str, Any]) -> list[str]:
    """Return in words, from the numbers alone, where the networks beat their baselines and where they lose."""
    sentences = []
    for split in metrics["splits"].values():
        for series in TIP_BASELINES:
            if series not in split["tip"]:
                continue
            parts = [
                _verdict(split["tip"][series][coordinate]["all"]["skill"], symbol)
                for coordinate, symbol in (("abscissa", "Δtip"), ("offset", "γtip"))
            ]
            verdicts = "; ".join(part for part in parts if part)
            if verdicts:
                sentences.append(f"{split['title']}, {series.replace('_', ' ')}: {verdicts}.")
    for series, gap in metrics.get("generalisation_gap", {}).items():
        gaps = " and ".join(
            f"{gap[coordinate]['all']['difference']:+.2f} mm for {symbol} ({gap[coordinate]['all']['ratio']:.2f} times)"
            for coordinate, symbol in (("abscissa", "Δtip"), ("offset", "γtip"))
            if gap[coordinate]["all"]["ratio"] is not None
        )
        if gaps:
            words = series.replace("_", " ")
            sentences.append(f"Generalisation gap, {words}: mean error in new patients against known ones {gaps}.")
    return sentences


def _verdict(skills: Mapping[str, float | None], symbol: str) -> str:
    """Return whether the hardest baseline is beaten in one coordinate; empty where there is none."""
    known = {name: value for name, value in skills.items() if value is not None}
    if not known:
        return ""
    hardest = min(known, key=lambda name: known[name])
    verdict = "beats every baseline" if known[hardest] > 0 else "loses to a baseline"
    return f"{symbol} {verdict} (skill {known[hardest]:+.2f} against {BASELINE_WORDS[hardest]})"
