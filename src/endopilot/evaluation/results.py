"""What an evaluation predicted, as arrays from which figures and tables are drawn, and metrics.json made of them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.projection import safety_ratio
from endopilot.evaluation.metrics import (
    control_rmse,
    distribution,
    diverged_share,
    error_statistics,
    skill,
    span_slices,
    tip_statistics,
)
from endopilot.files import stored_arrays, writing

METRICS_FILE, RESULTS_FILE, FIGURES_FOLDER, REPORT_FILE = "metrics.json", "evaluation.npz", "figures", "report.html"
"""What an evaluation writes into its folder."""

SPLITS: tuple[str, ...] = ("seen_test", "test")  # navigations of patients known to the run, and of all others

SERIES_TITLES: Mapping[str, str] = {
    "P1": "Forward network, true controls (P1)",
    "P2": "Inverse network (P2)",
    "P3": "Inverse into forward network (P3)",
    "P4": "Controls of P3, simulated (P4)",
    "P2_replayed": "Controls of P2, simulated",
    "hold_slack": "Baseline: hold slack and offset",
    "training_mean": "Baseline: training mean",
    "hold_control": "Baseline: hold the last control",
    "follow_slack": "Baseline: drive by the held slack",
    "true_replay": "True controls, simulated again",
    "friction_90": "True controls, simulated with 10 % less friction",
    "friction_110": "True controls, simulated with 10 % more friction",
}
"""What a reader calls each predicted series."""

TIP_BASELINES: Mapping[str, tuple[str, ...]] = {
    "P1": ("hold_slack", "training_mean"),
    "P3": ("hold_control", "follow_slack"),
    "P4": ("hold_control", "follow_slack"),
    "P2_replayed": ("hold_control", "follow_slack"),
}
"""Baselines that stand beside each protocol's tip errors. Those of P1 know the true controls, as it does; those of P3
and P4 choose controls, which are then simulated."""

REPLAYED: Mapping[str, float] = {"true_replay": 1.0, "friction_90": 0.9, "friction_110": 1.1}
"""Series that simulate the true controls again, and the factor on friction of each."""

CONTROL_BASELINES: tuple[str, ...] = ("hold_control", "training_mean", "follow_slack")
"""Baselines that stand beside the inverse network's control errors (P2)."""


@dataclass(frozen=True, eq=False)
class TipSeries:
    """Where tips were predicted to be (Δtip, γtip and the lumen radius there, mm); NaN where that failed."""

    abscissa: Float[np.ndarray, "episodes samples"]
    offset: Float[np.ndarray, "episodes samples"]
    radius: Float[np.ndarray, "episodes samples"]


def tip_series(tip: Float[np.ndarray, "episodes samples 2"]) -> TipSeries:
    """Return a predicted (Δtip, γtip), mm, as a series; its radius is left NaN."""
    return TipSeries(tip[..., 0], tip[..., 1], np.full(tip.shape[:2], np.nan))


@dataclass(frozen=True, eq=False)
class SplitResult:
    """Everything predicted on one split, over the samples after the given states.

    Attributes:
        anatomy: index in `anatomies` of each episode; `sequence` among those of its anatomy.
        true_control: the recorded control, (mm/s, rad/s); `controls` the predicted ones by series.
        tips: predicted tips by series (see `SERIES_TITLES`).
        tip_distance: distance between the simulated and the recorded tip in space, by simulated series, mm.
    """

    sample_period_s: float
    anatomies: tuple[str, ...]
    anatomy: Int[np.ndarray, "episodes"]
    sequence: Int[np.ndarray, "episodes"]
    wire_radius_mm: float
    true: TipSeries
    true_control: Float[np.ndarray, "episodes samples 2"]
    tips: Mapping[str, TipSeries]
    controls: Mapping[str, Float[np.ndarray, "episodes samples 2"]]
    tip_distance: Mapping[str, Float[np.ndarray, "episodes samples"]]

    @property
    def time_s(self) -> Float[np.ndarray, "samples"]:
        """Time of each sample after the last given state, s."""
        return (np.arange(self.true.abscissa.shape[1]) + 1) * self.sample_period_s

    def error(self, series: str, coordinate: str) -> Float[np.ndarray, "episodes samples"]:
        """Return predicted − true "abscissa" or "offset" of a series, mm; NaN where the prediction failed."""
        return getattr(self.tips[series], coordinate) - getattr(self.true, coordinate)

    def lost(self, series: str) -> Bool[np.ndarray, "episodes samples"]:
        """Return where a series has no finite tip."""
        tip = self.tips[series]
        return ~(np.isfinite(tip.abscissa) & np.isfinite(tip.offset))


def _flat(value: Any, name: str) -> dict[str, np.ndarray]:
    """Return the arrays in records and mappings, by the names on the way to them with "/" between."""
    if not isinstance(value, Mapping | SplitResult | TipSeries):
        return {name: np.asarray(value)}
    parts = value if isinstance(value, Mapping) else vars(value)
    return {
        key: array for part, of in parts.items() for key, array in _flat(of, f"{name}/{part}" if name else part).items()
    }


def write_results(results: Mapping[str, SplitResult], path: Path) -> None:
    """Write the results of all splits as one .npz, keys "split/field" or "split/field/series", whole or not at all."""
    with writing(path) as partial, partial.open("wb") as stream:
        # As keywords the keys would have to be identifiers for the type checker only; numpy takes any name.
        np.savez_compressed(stream, **_flat(results, ""))  # pyright: ignore[reportArgumentType]


def read_results(path: Path) -> dict[str, SplitResult]:
    """Read what `write_results` wrote; InputError if it is missing or damaged."""
    nested = dict[str, Any]()
    with stored_arrays(path, "evaluation", "run `endopilot evaluate` again") as file:
        for key, array in file.items():
            *way, last = key.split("/")
            functools.reduce(lambda parts, part: parts.setdefault(part, {}), way, nested)[last] = array
        return {split: _read_split(**fields) for split, fields in nested.items()}


def _read_split(
    *, anatomies: Any, sample_period_s: Any, wire_radius_mm: Any, true: Any, tips: Any, **arrays: Any
) -> SplitResult:
    return SplitResult(
        sample_period_s=float(sample_period_s),
        anatomies=tuple(map(str, anatomies)),
        wire_radius_mm=float(wire_radius_mm),
        true=TipSeries(**true),
        tips={name: TipSeries(**fields) for name, fields in tips.items()},
        **arrays,
    )


SPLIT_TITLES: Mapping[str, str] = {"seen_test": "New navigations, known patients", "test": "New patients"}
"""What a reader calls the splits of a result."""


def summarize(result: SplitResult, *, seed: int) -> dict[str, Any]:
    """Return the figures of one split: tips, controls and safety ratios, by series."""
    baselines = [name for names in TIP_BASELINES.values() for name in names]
    shown = [name for name in dict.fromkeys((*TIP_BASELINES, *baselines, *REPLAYED)) if name in result.tips]
    return {
        "anatomies": list(result.anatomies),
        "episodes": len(result.anatomy),
        "tip": {series: _tip(result, series, seed) for series in shown},
        "control": _control(result),
        "safety": {series: _safety(result, series) for series in ("true", *shown)},
    }


def _tip(result: SplitResult, series: str, seed: int) -> dict[str, Any]:
    baselines = [name for name in TIP_BASELINES.get(series, ()) if name in result.tips]
    lost = result.lost(series)
    out: dict[str, Any] = {
        coordinate: tip_statistics(
            result.error(series, coordinate),
            baselines={name: result.error(name, coordinate) for name in baselines},
            anatomy=result.anatomy,
            sample_period_s=result.sample_period_s,
            seed=seed,
        )
        for coordinate in ("abscissa", "offset")
    }
    out["diverged_share"] = diverged_share(result.error(series, "abscissa"), lost)
    out["lost_share"] = float(lost.mean())
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


def generalisation_gap(splits: Mapping[str, Any]) -> dict[str, Any]:
    """Return how much larger mean absolute errors are in new patients than in those trained on: by series, coordinate
    and span `difference` (mm) and `ratio`, None where unknown; empty without both kinds of patients."""
    if not {"seen_test", "test"} <= splits.keys():
        return {}
    known, new = splits["seen_test"], splits["test"]
    return {
        series: {
            coordinate: {
                span: _gap(known["tip"][series][coordinate][span]["mae"], new["tip"][series][coordinate][span]["mae"])
                for span in new["tip"][series][coordinate]
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
    return f"{symbol} {verdict} (skill {known[hardest]:+.2f} against {SERIES_TITLES[hardest].lower()})"
