"""The table of what was driven: a row for each task and policy on disk; `tabulate`, and `missing`, what is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from endopilot.errors import InputError
from endopilot.files import json_text, read_json
from endopilot.ladder.ladder import SCORES_FILE
from endopilot.ladder.scores import decision_ms, score_navigations
from endopilot.ladder.submission import read_submission
from endopilot.tasks.task import list_tasks

PLACES = ("submissions", "runs")
"""Folders that are looked in where none is given: what the leaderboard is made of, and what was driven here."""
PUBLIC = ("archvariety", "dualdevicenav")
"""Tasks of a public benchmark: `examples/steve_tasks.py` makes a folder of each."""
TITLES = {2: "Version 2", "coaxial": "Wire and catheter", 1: "Version 1"}
"""Of the shipped versions of the ladder."""
_SCORES = {"safe_%": "safe", "95_%": "interval", "X-rays": "exposures", "force_N": "peak_force_n", "time_s": "seconds"}
TABLED = {
    "task": "task",
    "policy": "policy",
    "n": "navigations",
    **_SCORES,
    "decide_ms": "decision_ms",
    "p99_ms": "p99_ms",
}
"""Titles that `shown_row` prints of a row of the table."""
CLIMBED = {"task": "task", "case": "case", **_SCORES, "missed_share": "missed_events", "plan_s": "planning_s"}
"""The same of what a policy has just climbed; its JSON has all scores."""
_Run = tuple[Mapping[str, Any], str, str, Mapping[str, list[dict[str, Any]]], tuple[float, float] | None]
"""Terms, policy, source, of each task the results of its navigations, and how long decisions took, ms."""


def tabulate(*folders: Path) -> list[dict[str, Any]]:
    """Return the table of the runs of `endopilot ladder` in and below folders, and of the submissions in them.

    A row holds `terms` (`Terms.key`; only rows of equal terms may be compared), `task`, or how many together, `policy`,
    `source` ("run": driven here; "file": as a submission says, which `--check` confirms or not), the number of
    `navigations`, what `score_navigations` gives, and how long decisions took, ms: `decision_ms` and `p99_ms`, their
    median and 99th percentile; of a submission as it says, over all its tasks. InputError where there is nothing, or
    the scores of an older version, which do not tell their terms.
    """
    rows = list[dict[str, Any]]()
    for terms, policy, source, results, took_ms in (run for folder in folders for run in _runs(folder)):
        together = [one for done in results.values() for one in done]
        tasks = {**results, f"all {len(results)}": together} if len(results) > 1 else results
        for task, done in tasks.items():
            row = {"terms": terms, "task": task, "policy": policy, "source": source, "navigations": len(done)}
            median, most = took_ms or decision_ms(done) or (None, None)
            rows.append(row | score_navigations(done) | {"decision_ms": median, "p99_ms": most})
    if not rows:
        where = ", ".join(map(str, folders)) or " and ".join(PLACES)
        raise InputError(f"{where}: no run of `endopilot ladder` and no submission; give their folder by --output")
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    return sorted(rows, key=lambda row: (json_text(row["terms"]), tasks.index(row["task"]), row["policy"]))


def missing(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row, of the source "none", for each task of the ladder and of the public benchmark that a policy of a
    table has no row of, on whatever terms."""
    public = "Public benchmark"
    wanted = {TITLES[version]: [task.name for task in list_tasks(version)] for version in (2, "coaxial")}
    done = {(row["policy"], TITLES.get(row["terms"]["ladder"], public), row["task"]) for row in rows}
    return [
        {"terms": {"ladder": title}, "task": task, "policy": policy, "source": "none", "navigations": 0}
        for policy in sorted({row["policy"] for row in rows})
        for title, tasks in {**wanted, public: PUBLIC}.items()
        for task in tasks
        if (policy, title, task) not in done
    ]


def _runs(folder: Path) -> Iterator[_Run]:
    for path in sorted(folder.rglob(SCORES_FILE)):
        content = read_json(path)
        if "thinking_s" not in content.get("key", ()):
            raise InputError(f"{path}: key: missing; the run is of an older version, climb again into another folder")
        names = [row["task"] for row in content["scores"] if row["level"] is not None]
        files = {name: sorted((path.parent / name).glob("*.json"))[: content["patients"]] for name in names}
        results = {name: list(map(read_json, files[name])) for name in names}
        yield content["key"], content["policy"], "run", results, None
    for path in sorted([*folder.glob("*.json"), *folder.glob("*/*.json")]):
        content = read_json(path)
        if isinstance(content, dict) and "navigations" in content and not path.with_name(SCORES_FILE).exists():
            read = read_submission(path)
            navigations = {name: [one.figures() for one in done] for name, done in read.navigations.items()}
            yield read.terms.key(), read.policy, "file", navigations, read.decision_ms


def shown_row(row: Mapping[str, Any], columns: Mapping[str, str]) -> dict[str, Any]:
    """Return what is printed of a row of scores, by title: those of the columns that it has, within 80 characters."""
    safe, *interval = (f"{100 * row[name]:.0f}" for name in ("safe_success", "safe_from", "safe_to"))
    figures = {**row, "safe": safe, "interval": "–".join(interval)}
    return {title: figures[name] for title, name in columns.items() if name in figures}


def terms_in_words(terms: Mapping[str, Any]) -> str:
    """Return what the rows of equal `Terms.key` have in common, in one line."""
    differs = [f"{name}: {terms[name]}" for name in ("robot", "world") if terms[name]]
    differs += ["test patients, drawn when asked"] * (terms["split"] == "test")
    differs += [f"{terms['thinking_s']:g} s of thinking a decision"] * bool(terms["thinking_s"])
    if done := terms.get("done"):
        differs.append(f"{len(done)} tasks, {max(done.values())} patients of each")
    hashes = [f"{name} {terms[name][:12]}" for name in ("tasks", "settings")]
    period = f"a decision every {terms['decision_period_s']:g} s"
    return ", ".join([TITLES.get(terms["ladder"], str(terms["ladder"])), *differs, *hashes, period])
