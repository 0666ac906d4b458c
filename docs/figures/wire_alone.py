"""Measures how far a wire alone comes in the tasks of wire and catheter, for a table of docs/evidence/ladder.md.

`python docs/figures/wire_alone.py FOLDER [PATIENTS]`: FOLDER gets a file for each navigation; those that are there are
kept. The simple policies drive in all patients of a task, the agent in the first PATIENTS of them, 5 if not given.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill, markdown_table
from endopilot.files import read_json, write_json
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.ladder.scores import score_navigations
from endopilot.runs import make_missing
from endopilot.tasks.task import Task, find_task, list_tasks

SIMPLE, PLANS = ("forward", "spin"), "agent"


def navigate(path: Path) -> None:
    """Let a policy drive the wire of a task without its catheter, from the task's start and with its seed."""
    policy, name, place = path.parts[-3], path.parts[-2], int(path.stem)
    task = find_task(name, version="coaxial")
    navigation = replace(task.ladder_navigation(place), catheters=(), arrives="wire", start_catheter_mm=0.0)
    write_json(path, attempt(policy, navigation, seed=navigation_seed(task, place)))


def paths_of(folder: Path, policy: str, task: Task, patients: int) -> list[Path]:
    """Return the files of a policy's navigations in a task."""
    count = patients if policy == PLANS else len(task.ladder.numbers)
    return [folder / policy / task.name / f"{place:02d}.json" for place in range(count)]


def table(folder: Path, patients: int) -> list[str]:
    """Return the table: safe success, and in brackets success, %."""
    policies, rows = (*SIMPLE, PLANS), []
    together: dict[str, list[dict[str, Any]]] = {policy: [] for policy in policies}
    for task in list_tasks("coaxial"):
        results = {
            policy: [read_json(path) for path in paths_of(folder, policy, task, patients)] for policy in policies
        }
        rows.append((task.name, *(cell(results[policy]) for policy in policies)))
        for policy in policies:
            together[policy] += results[policy]
    rows.append(("all coaxial", *(cell(together[policy]) for policy in policies)))
    counts = [len(together[policy]) // len(list_tasks("coaxial")) for policy in policies]
    return markdown_table(("task", *(f"`{policy}`" for policy in policies)), [*rows, ("patients a task", *counts)])


def cell(results: list[dict[str, Any]]) -> str:
    """Return the scores of some navigations."""
    scores = score_navigations(results)
    return f"{100 * scores['safe_success']:.0f} ({100 * scores['success']:.0f})"


def main() -> None:
    """Do what is missing, and fill the page."""
    folder, patients = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 5
    for policy in (*SIMPLE, PLANS):
        paths = [path for task in list_tasks("coaxial") for path in paths_of(folder, policy, task, patients)]
        make_missing(f"Wire alone, {policy}", paths, navigate)
    fill("evidence/ladder.md", "wire alone", table(folder, patients))


if __name__ == "__main__":
    main()
