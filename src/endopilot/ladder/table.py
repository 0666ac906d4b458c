"""The table of what was driven: a row for each task and policy of the runs on disk; `tabulate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.errors import InputError
from endopilot.files import json_text, read_json
from endopilot.ladder.ladder import SCORES_FILE
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.submission import read_submission
from endopilot.tasks.navigation import DECISION_PERIOD_S

TITLES = {2: "Version 2", "coaxial": "Wire and catheter", 1: "Version 1"}
"""Of the shipped versions of the ladder."""
_Run = tuple[Mapping[str, Any], str, str, Mapping[str, list[dict[str, Any]]]]
"""Terms, policy, source, and of each task the results of its navigations."""


def tabulate(folder: Path) -> list[dict[str, Any]]:
    """Return the table of the runs of `endopilot ladder` in and below a folder, and of the submissions in it.

    A row holds `terms` (`Terms.key`; only rows of equal terms may be compared), `task`, or how many together, `policy`,
    `source` ("run": driven here; "file": as a submission says, which `--check` confirms or not), the number of
    `navigations`, what `score_navigations` gives, and how long decisions took: `decision_ms` and `p99_ms`, their median
    and 99th percentile, and `late`, the share that took longer than the time until the next, which no robot waits for.

    Raises:
        InputError: there is nothing, or the scores of an older version, which do not tell their terms.
    """
    rows = list[dict[str, Any]]()
    for terms, policy, source, results in _runs(folder):
        together = [one for done in results.values() for one in done]
        tasks = {**results, f"all {len(results)}": together} if len(results) > 1 else results
        for task, done in tasks.items():
            row = {"terms": terms, "task": task, "policy": policy, "source": source, "navigations": len(done)}
            rows.append(row | score_navigations(done) | _decisions(done))
    if not rows:
        raise InputError(
            f"{folder}: holds no run of `endopilot ladder` and no submission; give their folder by --output"
        )
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    return sorted(rows, key=lambda row: (json_text(row["terms"]), tasks.index(row["task"]), row["policy"]))


def _runs(folder: Path) -> Iterator[_Run]:
    for path in sorted(folder.rglob(SCORES_FILE)):
        content = read_json(path)
        if "key" not in content:
            raise InputError(f"{path}: key: missing; the run is of an older version, climb again into another folder")
        names = [row["task"] for row in content["scores"] if row["level"] is not None]
        files = {name: sorted((path.parent / name).glob("*.json"))[: content["patients"]] for name in names}
        yield content["key"], content["policy"], "run", {name: list(map(read_json, files[name])) for name in names}
    for path in sorted(folder.glob("*.json")):
        content = read_json(path)
        if isinstance(content, dict) and "navigations" in content and not path.with_name(SCORES_FILE).exists():
            read = read_submission(path)
            navigations = {name: [one.figures() for one in done] for name, done in read.navigations.items()}
            yield read.terms.key(), read.policy, "file", navigations


def shown_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is printed of a row, within 80 columns: shares in %, the interval in one."""
    safe, *interval = (f"{100 * row[name]:.0f}" for name in ("safe_success", "safe_from", "safe_to"))
    figures = {"task": row["task"], "policy": row["policy"], "n": row["navigations"]}
    figures |= {"safe_%": safe, "95_%": "–".join(interval), "X-rays": row["exposures"], "force_N": row["peak_force_n"]}
    figures |= {"time_s": row["seconds"], "decide_ms": row["decision_ms"], "p99_ms": row["p99_ms"]}
    return figures | {"late_%": None if row["late"] is None else f"{100 * row['late']:.1f}"}


def _decisions(done: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    took_s = np.concatenate([one.get("decision_s", ()) for one in done])
    if not len(took_s):
        return {"decision_ms": None, "p99_ms": None, "late": None}
    median, most = (1e3 * np.quantile(took_s, [0.5, 0.99])).round(2).tolist()
    return {"decision_ms": median, "p99_ms": most, "late": round(float((took_s > DECISION_PERIOD_S).mean()), 4)}


def terms_in_words(terms: Mapping[str, Any]) -> str:
    """Return what the rows of equal `Terms.key` have in common, in one line."""
    differs = [f"{name}: {terms[name]}" for name in ("robot", "world") if terms[name]]
    differs += [f"patients: {terms['patients']}"] * (terms["patients"] == "drawn")
    hashes = [f"{name} {terms[name][:12]}" for name in ("tasks", "settings")]
    period = f"a decision every {terms['decision_period_s']:g} s"
    return ", ".join([TITLES.get(terms["ladder"], str(terms["ladder"])), *differs, *hashes, period])
