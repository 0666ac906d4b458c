"""Let policies climb in realities that they were not made for, and write their scores into docs/evidence/ladder.md.

`python docs/figures/realities.py [POLICY ...]`: policies that are not named, where some are, keep their rows. Each run
lies in runs/realities/REALITY/POLICY and goes on where it was left; take a folder away to have its policy drive again.
Rows of the rod core are of the first patients in submissions/.
"""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill, markdown_table
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.submission import SUBMISSION_FILE, Submission, read_submission
from endopilot.tasks.task import list_tasks

PAGE = "evidence/ladder.md"
RUNS, SUBMISSIONS = ROOT / "runs" / "realities", ROOT / "submissions"
REALITIES: dict[str, dict[str, Any]] = {
    "other engine": {"world": "other-engine"},
    "measured robot": {"robot": "kweon-2021-3d"},
    "real time": {"thinking_s": 0.5},
}
"""On what terms a policy climbs; the rod core's are the usual ones."""
POLICIES = {
    "forward": "forward",
    "recurrent": f"{ROOT}/examples/recurrent_policy.py:Recurrent",
    "cloned": "cloned",
    "agent": "agent",
}
PATIENTS = 2
NAMES = [task.name for task in list_tasks()]
LOWER, UPPER = NAMES[:8], NAMES[8:]
"""Tasks that all have learned, and the others."""
EVERYWHERE = ("agent", "forward")
"""Who drives the upper tasks too."""
LEFT_OUT = {("other engine", "forward")}
"""A wire that is caught and pushed on takes minutes there."""


def drive(reality: str, name: str) -> Submission:
    """Return what a policy drove in a reality; what it has not yet driven is driven first."""
    if reality not in REALITIES:
        return read_submission(SUBMISSIONS / f"{name}.json")
    tasks = tuple(NAMES if name in EVERYWHERE else LOWER)
    config = {"policy": POLICIES[name], "tasks": tasks, "patients": PATIENTS}
    folder = RUNS / reality.replace(" ", "-") / name
    climb(output=folder, config=LadderConfig(**config, **REALITIES[reality]))
    return read_submission(folder / SUBMISSION_FILE)


def cells(driven: Submission) -> tuple[str, ...]:
    """Return the scores of a policy in the first patients: safe successes of both groups of tasks, and medians."""
    lower, upper = ([each.figures() for name in names for each in _first(driven, name)] for names in (LOWER, UPPER))
    scores = score_navigations(lower)
    median, most = driven.decision_ms or ("–", "–")
    figures = (scores["exposures"], f"{scores['peak_force_n']:.3f}", scores["seconds"], f"{median:g}, {most:g}")
    return (_safe(lower), _safe(upper) if upper else "–", *map(str, figures))


def _first(driven: Submission, task: str) -> tuple[Any, ...]:
    return driven.navigations.get(task, ())[:PATIENTS]


def _safe(done: list[dict[str, Any]]) -> str:
    scores = score_navigations(done)
    low, high = (f"{100 * scores[name]:.0f}" for name in ("safe_from", "safe_to"))
    return f"{scores['safe_success'] * len(done):.0f} of {len(done)} ({low}–{high} %)"


def kept() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Return the rows that stand in the page, by reality and policy."""
    text = (DOCS / PAGE).read_text(encoding="utf-8").partition("<!-- realities:begin -->")[2]
    lines = text.partition("<!-- realities:end -->")[0].splitlines()
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines if line.startswith("|")]
    return {row[:2]: row for row in rows}


def main() -> None:
    """Fill the page."""
    head = (
        "reality",
        "policy",
        "lower eight tasks, safe",
        "upper four",
        "exposures",
        "force, N",
        "time, s",
        "decision, ms",
    )
    rows, found = list[tuple[str, ...]](), kept()
    for reality, name in product(("rod core", *REALITIES), POLICIES):
        own = (reality, f"`{name}`")
        if (reality, name) in LEFT_OUT:
            continue
        if name in (sys.argv[1:] or POLICIES):
            rows.append((*own, *cells(drive(reality, name))))
        elif own in found:
            rows.append(found[own])
    fill(PAGE, "realities", markdown_table(head, rows))


if __name__ == "__main__":
    main()
