"""Errors of simulated worlds against a converged solution, as figures with bootstrap intervals over worlds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from benchmarks.core.scenes import Solution

_INTERVAL = (5.0, 95.0)
"""Percentiles of the resampled figures: a 90 % interval."""
_RESAMPLES = 500
_SMALL_MM = 1.0
"""A tip farther from the true one has snapped to another place; the mean is taken of the others."""
_LARGE_MM = 0.1


def error_figures(found: Solution, exact: Solution) -> dict[str, float | None]:
    """Return how far a solution is from the converged one, over all samples that are valid in both.

    Returns:
        Of the distance of the tips, mm: its median, its mean below 1 mm, the share of samples above 0.1 mm, its 95th
        percentile, and that of the samples before the first bifurcation; the share of samples whose tip lies in the
        same branch; and the 95th percentiles of the errors of the wall's largest force on 2 mm of the wire, of its
        largest force on a node (which depends on the elements), of the base's force (N) and of its torque (N·mm). None
        where there is no such sample.
    """
    return {name: _rounded(value) for name, value in _figures(_errors(found, exact)).items()}


def error_intervals(
    found: Solution, exact: Solution, scene: Int[np.ndarray, "worlds"]
) -> dict[str, list[float | None]]:
    """Return a 90 % interval of each figure: a bootstrap over the worlds of every scene.

    Args:
        found: the solution.
        exact: the converged one.
        scene: number of each world's scene.
    """
    errors, random = _errors(found, exact), np.random.default_rng(0)
    members = [np.flatnonzero(scene == number) for number in np.unique(scene)]
    drawn = []
    for _ in range(_RESAMPLES):
        rows = np.concatenate([random.choice(own, len(own)) for own in members])
        drawn.append(_figures({name: values[rows] for name, values in errors.items()}))
    return {
        name: [_rounded(float(bound)) for bound in _percentiles(np.array([figures[name] for figures in drawn]))]
        for name in drawn[0]
    }


def _errors(found: Solution, exact: Solution) -> dict[str, np.ndarray]:
    return {
        "tip": np.linalg.norm(found.tip_position - exact.tip_position, axis=-1),
        "same_branch": found.branch == exact.branch,
        "wall_force": np.abs(found.wall_force - exact.wall_force),
        "node_force": np.abs(found.contact_force_max - exact.contact_force_max),
        "base_force": np.abs(found.base_force - exact.base_force),
        "base_torque": np.abs(found.base_torque - exact.base_torque),
        "valid": found.valid & exact.valid,
        "before_fork": exact.before_fork,
    }


def _figures(errors: Mapping[str, np.ndarray]) -> dict[str, float]:
    valid = errors["valid"]
    tip = errors["tip"][valid]
    return {
        "true_tip_error_median_mm": _percentile(tip, 50.0),
        "true_tip_error_mean_below_1mm_mm": _mean(tip[tip < _SMALL_MM]),
        "true_tip_error_share_over_0p1mm": _mean(tip > _LARGE_MM),
        "true_tip_error_p95_mm": _percentile(tip, 95.0),
        "true_tip_error_p95_before_fork_mm": _percentile(errors["tip"][valid & errors["before_fork"]], 95.0),
        "branch_agreement": _mean(errors["same_branch"][valid]),
        "wall_force_error_p95_n": _percentile(errors["wall_force"][valid], 95.0),
        "node_force_error_p95_n": _percentile(errors["node_force"][valid], 95.0),
        "base_force_error_p95_n": _percentile(errors["base_force"][valid], 95.0),
        "base_torque_error_p95_n_mm": _percentile(errors["base_torque"][valid], 95.0),
    }


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 5)


def _percentile(values: np.ndarray, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _percentiles(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "2"]:
    known = values[~np.isnan(values)]
    return np.percentile(known, _INTERVAL) if len(known) else np.full(2, np.nan)
