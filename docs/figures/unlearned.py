"""Score the recurrent policy on tasks that it has not learned, and write that into docs/evidence/environments.md.

`python docs/figures/unlearned.py STEVE`: STEVE is the folder of a public benchmark's tasks, which
`examples/steve_tasks.py` made. Runs lie in runs/unlearned and go on where they were left.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT))  # where `benchmarks` is

from benchmarks.figures import fill, markdown_table
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.submission import SUBMISSION_FILE, Submission, read_submission
from endopilot.tasks.task import NEWEST, LadderVersion, list_tasks

PAGE = "evidence/environments.md"
POLICY = f"{ROOT}/examples/recurrent_policy.py:Recurrent"
UPPER = tuple(task.name for task in list_tasks()[8:])
ARCHES = 6
"""Of the public benchmark's 49, the first."""


def drive(version: LadderVersion, tasks: tuple[str, ...], patients: int | None = None) -> Submission:
    """Return what the policy drove; what it has not yet driven is driven first."""
    folder = ROOT / "runs" / "unlearned" / f"recurrent-{'-'.join(tasks)}"
    climb(output=folder, config=LadderConfig(policy=POLICY, version=version, tasks=tasks, patients=patients))
    return read_submission(folder / SUBMISSION_FILE)


def rows(driven: Submission) -> list[tuple[str, ...]]:
    """Return the rows of the tasks that were driven, and of all together: safe, all successes, exposures."""
    done = {name: [one.figures() for one in each] for name, each in driven.navigations.items()}
    if len(done) > 1:
        done[f"all {len(done)}"] = [one for each in done.values() for one in each]
    return [_row(name, each, score_navigations(each)) for name, each in done.items()]


def _row(name: str, done: list[dict], scores: dict) -> tuple[str, ...]:
    safe, success = (f"{scores[share] * len(done):.0f}" for share in ("safe_success", "success"))
    low, high = (f"{100 * scores[bound]:.0f}" for bound in ("safe_from", "safe_to"))
    return name, f"{safe} ({success}) of {len(done)}", f"{low}–{high}", f"{scores['exposures']:.1f}"


def main() -> None:
    """Fill the page."""
    public = drive(sys.argv[1], tuple(task.name for task in list_tasks(sys.argv[1])), ARCHES)
    head = ("task", "safe (successes)", "95 % interval, %", "exposures")
    fill(PAGE, "unlearned", markdown_table(head, [*rows(drive(NEWEST, UPPER)), *rows(public)]))


if __name__ == "__main__":
    main()
