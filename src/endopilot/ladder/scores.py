"""Scores of navigations of the ladder: `score`, whose figure is safe success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from endopilot.tasks.task import Task

UPPER = range(5, 13)
"""Levels of the upper eight tasks, which pushing alone must not solve."""
COAXIAL = range(13, 17)
"""Levels of the tasks of wire and catheter, which a wire alone must not solve."""


def score(tasks: Sequence[Task], results: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the scores of tasks, and where all were done, over the lower four, upper eight, twelve, and coaxial ones.

    `safe_success` is the share of navigations that reached the target with no wall force beyond the task's limit, from
    `safe_from` to `safe_to` its 95 % interval over patients. `seconds` and `path_ratio` (the tip's path over the
    centerline) are medians of those that arrived, `peak_force_n` (N) that of all, `exposures` the mean. Rows of `agent`
    have `missed_events`, the share of events that X-ray did not show, of tasks with `near_mm` `near`, the share that
    came so near, and of policies that search `planning_s`, the mean time of a navigation's searches, s.
    """
    rows = [{"level": task.level, "task": task.name} | score_navigations(results[task.name]) for task in tasks]
    levels = {task.level: task.name for task in tasks}
    groups = {"lower four": range(1, 5), "upper eight": UPPER, "all twelve": range(1, 13), "all coaxial": COAXIAL}
    for title, wanted in groups.items():
        if all(level in levels for level in wanted):
            together = [result for level in wanted for result in results[levels[level]]]
            rows.append({"level": None, "task": title} | score_navigations(together))
    return rows


def score_navigations(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the scores of some navigations together, see `score`."""
    reached = [result for result in results if result["success"]]

    def median(name: str, of: Sequence[Mapping[str, Any]], digits: int) -> float | None:
        return round(float(np.median([result[name] for result in of])), digits) if of else None

    def mean(name: str) -> float:
        return round(float(np.mean([result[name] for result in results])), 1)

    events = [result["events"] for result in results if "events" in result]
    missed = round(sum(unseen for _, unseen in events) / max(sum(count for count, _ in events), 1), 4)
    safe = sum(result["success"] and result["safe"] for result in results)
    low, high = interval(safe, len(results))
    return {
        "safe_success": round(safe / len(results), 4),
        "safe_from": round(low, 4),
        "safe_to": round(high, 4),
        "success": round(len(reached) / len(results), 4),
        **({"near": round(float(np.mean([r["near"] for r in results])), 4)} if "near" in results[0] else {}),
        "seconds": median("seconds", reached, 1),
        "path_ratio": median("path_ratio", reached, 3),
        "peak_force_n": median("peak_force_n", results, 4),
        "exposures": mean("exposures"),
        **({"missed_events": missed} if len(events) == len(results) else {}),
        **({"planning_s": mean("planning_s")} if all("planning_s" in result for result in results) else {}),
    }


def decision_ms(results: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """Return how long the decisions of some navigations took, ms, median and 99th percentile; None if untold."""
    took_s = np.concatenate([(), *(one.get("decision_s", ()) for one in results)])
    if not len(took_s):
        return None
    median, most = (1e3 * np.quantile(took_s, [0.5, 0.99])).round(2).tolist()
    return median, most


def interval(reached: int, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share (J. Am. Stat. Assoc. 22, 209, 1927)."""
    found = binomtest(reached, count).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def submitted(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores of a row that stand in a submission: the same in every run, and each by itself."""
    return {name: value for name, value in scores.items() if name not in ("planning_s", "safe_from", "safe_to")}
