"""The numbers that say how good a prediction is. Errors are `predicted − true`; NaN marks a sample that counts for
nothing, where the truth is not valid. A prediction that is not finite where the truth is counts as lost, its sequence
as diverged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

SPANS_S: tuple[tuple[float, float], ...] = ((0.0, 10.0), (10.0, 30.0), (30.0, 45.0))
"""Spans of time after the given states over which errors are reported, s: those of the paper."""

PAPER_ERRORS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "0-10": {"abscissa": {"mae": 0.25, "sd": 0.22}, "offset": {"mae": 0.09, "sd": 0.10}},
    "10-30": {"abscissa": {"mae": 0.31, "sd": 0.27}, "offset": {"mae": 0.12, "sd": 0.14}},
    "30-45": {"abscissa": {"mae": 0.62, "sd": 0.60}, "offset": {"mae": 0.14, "sd": 0.16}},
}
"""Mean and SD of the absolute tip error, mm, as Kim et al. publish them (Hamlyn 2023, arXiv 2304.09286)."""

DIVERGED_MM = 2.0  # a rollout whose absolute error of Δtip passes this, mm, once or more, has diverged
_STEPS = 2000


def span_name(span: tuple[float, float]) -> str:
    """Return the key of a span in metrics.json, such as "10-30"."""
    return f"{span[0]:g}-{span[1]:g}"


def span_slices(n_samples: int, sample_period_s: float) -> dict[str, slice]:
    """Return the samples of each span that a prediction of `n_samples` reaches into: prediction k (from 0) is the state
    k + 1 periods after the last given one, and belongs to the span with start < time ≤ end."""
    slices = {}
    for span in SPANS_S:
        start, stop = (round(edge / sample_period_s) for edge in span)
        if start < n_samples:
            slices[span_name(span)] = slice(start, min(stop, n_samples))
    return slices


def error_statistics(error: Float[np.ndarray, "episodes samples"]) -> dict[str, float | int | None]:
    """Return the statistics of the absolute error over finite samples, in its unit (None without any): `mae` and `sd`
    of it (what the paper publishes), `rmse`, quantiles, and `bias`, the mean of the signed error."""
    finite = error[np.isfinite(error)]
    if finite.size == 0:
        return dict.fromkeys(("mae", "sd", "median", "p95", "rmse", "bias"), None) | {"count": 0}
    absolute = np.abs(finite)
    return {
        "mae": float(absolute.mean()),
        "sd": float(absolute.std()),
        "median": float(np.median(absolute)),
        "p95": float(np.quantile(absolute, 0.95)),
        "rmse": float(np.sqrt(np.mean(finite**2))),
        "bias": float(finite.mean()),
        "count": int(finite.size),
    }


def skill(
    error: Float[np.ndarray, "episodes samples"], baseline: Float[np.ndarray, "episodes samples"]
) -> float | None:
    """Return 1 − RMSE/RMSE of the baseline, over the samples where both are finite: 1 is perfect, 0 no better than the
    baseline. None where no sample has both, or where the baseline is without error."""
    both = np.isfinite(error) & np.isfinite(baseline)
    reference = float(np.sum(baseline[both] ** 2))
    if reference == 0.0:
        return None
    return 1.0 - float(np.sqrt(np.sum(error[both] ** 2) / reference))


def bootstrap_intervals(
    error: Float[np.ndarray, "episodes samples"], anatomy: Int[np.ndarray, "episodes"], *, seed: int, draws: int = 1000
) -> dict[str, tuple[float, float]] | None:
    """Return the 95 % percentile intervals of mae, sd, rmse and p95 when anatomies are drawn with replacement (cluster
    bootstrap: Davison & Hinkley 1997, §3.8); None with fewer than two. Of p95 the next of 2000 steps counts."""
    finite = np.isfinite(error)
    absolute = np.abs(error[finite])
    names, owner = np.unique(np.broadcast_to(anatomy[:, None], error.shape)[finite], return_inverse=True)
    if len(names) < 2:
        return None
    chosen = np.random.Generator(np.random.Philox(seed)).integers(len(names), size=(draws, len(names)))
    times = np.zeros((draws, len(names)))
    np.add.at(times, (np.arange(draws)[:, None], chosen), 1.0)
    count = times @ np.bincount(owner)
    mean = times @ np.bincount(owner, absolute) / count
    square = times @ np.bincount(owner, absolute**2) / count
    steps = np.unique(np.quantile(absolute, np.linspace(0.0, 1.0, _STEPS + 1), method="higher"))
    step = np.searchsorted(steps, absolute)
    filled = np.bincount(owner * len(steps) + step, minlength=len(names) * len(steps)).reshape(len(names), -1)
    below = np.cumsum(times @ filled, axis=1)
    drawn = {
        "mae": mean,
        "sd": np.sqrt(np.maximum(square - mean**2, 0.0)),
        "rmse": np.sqrt(square),
        "p95": steps[(below < 0.95 * count[:, None]).sum(axis=1)],
    }
    bounds = {name: np.quantile(values, [0.025, 0.975]) for name, values in drawn.items()}
    return {name: (float(low), float(high)) for name, (low, high) in bounds.items()}


def diverged_share(error: Float[np.ndarray, "episodes samples"], lost: Bool[np.ndarray, "episodes samples"]) -> float:
    """Return the share of sequences whose absolute error of Δtip passes `DIVERGED_MM`, or that lost a sample."""
    large = np.abs(np.nan_to_num(error, nan=0.0)) > DIVERGED_MM
    return float(np.mean((large | lost).any(axis=1)))


def quantiles_over_time(values: Float[np.ndarray, "episodes samples"]) -> dict[str, Float[np.ndarray, "samples"]]:
    """Return q25, median, q75 and p95 over the sequences at each time; NaN where no sequence has a value."""
    levels = {"q25": 0.25, "median": 0.5, "q75": 0.75, "p95": 0.95}
    out = {name: np.full(values.shape[1], np.nan) for name in levels}
    known = np.isfinite(values).any(axis=0)
    for name, level in levels.items():
        out[name][known] = np.nanquantile(values[:, known], level, axis=0)
    return out


def mean_over_time(error: Float[np.ndarray, "episodes samples"]) -> Float[np.ndarray, "samples"]:
    """Return the mean absolute error over the sequences at each time; NaN where no sequence has a value."""
    return _mean_of_finite(np.abs(error), axis=0)


def rmse_of_sequences(error: Float[np.ndarray, "episodes samples"]) -> Float[np.ndarray, "episodes"]:
    """Return the RMSE of each sequence over its finite samples, in the unit of the error; NaN where it has none."""
    return np.sqrt(_mean_of_finite(error**2, axis=1))


def _mean_of_finite(values: Float[np.ndarray, "episodes samples"], axis: int) -> Float[np.ndarray, "n"]:
    finite = np.isfinite(values)
    count, total = finite.sum(axis=axis), np.where(finite, values, 0.0).sum(axis=axis)
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)


def control_rmse(
    predicted: Float[np.ndarray, "episodes samples 2"], true: Float[np.ndarray, "episodes samples 2"]
) -> Float[np.ndarray, "episodes 2"]:
    """Return the RMSE of each sequence's control, mm/s and deg/s; NaN where no sample is finite in both."""
    error = (predicted - true) * np.array([1.0, np.rad2deg(1.0)])
    return np.stack([rmse_of_sequences(error[..., axis]) for axis in range(2)], axis=-1)


def distribution(values: Float[np.ndarray, "n"]) -> dict[str, float | int | None]:
    """Return median, quartiles, 95 % quantile, mean and count of the finite values."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return dict.fromkeys(("q25", "median", "q75", "p95", "mean"), None) | {"count": 0}
    q25, median, q75, p95 = (float(q) for q in np.quantile(finite, [0.25, 0.5, 0.75, 0.95]))
    return {"q25": q25, "median": median, "q75": q75, "p95": p95, "mean": float(finite.mean()), "count": finite.size}


def tip_statistics(
    error: Float[np.ndarray, "episodes samples"],
    *,
    baselines: Mapping[str, Float[np.ndarray, "episodes samples"]],
    anatomy: Int[np.ndarray, "episodes"],
    sample_period_s: float,
    seed: int,
) -> dict[str, dict]:
    """Return for each span and for "all" samples the statistics of a tip coordinate's error, mm. `baselines` has errors
    on the same samples, mm, by name."""
    spans: dict[str, slice] = {**span_slices(error.shape[1], sample_period_s), "all": slice(None)}
    statistics = {}
    for name, samples in spans.items():
        part = error[:, samples]
        statistics[name] = error_statistics(part) | {
            "intervals": bootstrap_intervals(part, anatomy, seed=seed),
            "skill": {key: skill(part, other[:, samples]) for key, other in baselines.items()},
        }
    return statistics
