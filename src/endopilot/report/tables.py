"""The tables behind the figures: each is what one figure draws, and is written beside it as CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from endopilot.anatomy.projection import safety_ratio
from endopilot.evaluation.metrics import control_rmse, mean_over_time, quantiles_over_time
from endopilot.evaluation.results import CONTROL_BASELINES, TIP_BASELINES, SplitResult

SAFETY_SERIES = ("true", "P3", "P4")


def tip_error_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return the mean |error| of Δtip and γtip over the sequences, mm, for each split, series and time."""
    pieces = []
    for split, result in results.items():
        for series in _ordered(result.tips, [name for key, names in TIP_BASELINES.items() for name in (key, *names)]):
            means = {
                f"{coordinate}_mae_mm": mean_over_time(result.error(series, coordinate))
                for coordinate in ("abscissa", "offset")
            }
            pieces.append(pd.DataFrame({"split": split, "series": series, "time_s": result.time_s, **means}))
    return pd.concat(pieces, ignore_index=True)


def safety_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return quantiles over the sequences of γ/r ("radius") and γ/(r − r_w) ("clearance") against time."""
    pieces = []
    for split, result in results.items():
        for series in _ordered({"true": None, **result.tips}, SAFETY_SERIES):
            tip = result.true if series == "true" else result.tips[series]
            for ratio, wire_radius in (("radius", 0.0), ("clearance", result.wire_radius_mm)):
                values = quantiles_over_time(safety_ratio(tip.offset, tip.radius, wire_radius))
                keys = {"split": split, "series": series, "ratio": ratio, "time_s": result.time_s}
                pieces.append(pd.DataFrame({**keys, **values}))
    return pd.concat(pieces, ignore_index=True)


def control_error_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return the RMSE of each sequence's controls, in mm/s and deg/s, for each split and series."""
    pieces = []
    for split, result in results.items():
        for series in _ordered(result.controls, ("P2", *CONTROL_BASELINES)):
            rmse = control_rmse(result.controls[series], result.true_control)
            columns = {"translation_rmse_mm_s": rmse[:, 0], "rotation_rmse_deg_s": rmse[:, 1]}
            anatomy = [result.anatomies[index] for index in result.anatomy]
            keys = {"split": split, "series": series, "anatomy": anatomy, "sequence": result.sequence}
            pieces.append(pd.DataFrame(keys | columns))
    return pd.concat(pieces, ignore_index=True)


def rows(table: pd.DataFrame, **equal: str) -> pd.DataFrame:
    """Return the rows in which each named column has the given value."""
    chosen = np.ones(len(table), dtype=bool)
    for column, value in equal.items():
        chosen &= np.asarray(table[column]) == value
    return pd.DataFrame(table[chosen])


def values(table: pd.DataFrame, column: str) -> np.ndarray:
    """Return a column of numbers."""
    return np.asarray(table[column], dtype=float)


def distinct(table: pd.DataFrame, column: str) -> list[str]:
    """Return the different values of a column in the order of their appearance."""
    return [str(value) for value in dict.fromkeys(table[column])]


def _ordered(available: Mapping[str, Any], order: Sequence[str]) -> list[str]:
    return [name for name in dict.fromkeys(order) if name in available]
