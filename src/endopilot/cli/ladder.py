"""`endopilot ladder`: a policy on twelve tasks in unseen patients -> scores, a page and a submission file."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from endopilot.cli.arguments import Answer
from endopilot.extras import extras_present, require_extras
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.runs import Existing, OutputFolder


def ladder_command(
    *,
    output: OutputFolder | None = None,
    check: Existing | None = None,
    dataset: Path | None = None,
    table: bool = False,
    page: bool = True,
    config: LadderConfig = LadderConfig(),
) -> Answer:
    """Let a policy climb the ladder: twelve tasks, each in twenty synthetic patients. An interrupted run goes on.

    The output folder gets the scores, a page with pictures and replays, and submission.json: it holds all that others
    need to confirm the scores without the policy.

    Args:
        output: folder of the results; runs/ladder/POLICY if not given.
        check: a submission.json. Its recorded controls are driven again, a shipped policy, or that of --policy, also
            decides again, and what that gives is printed; exit code 1 if anything differs from the file, or cannot be
            judged here. No policy climbs then.
        dataset: folder of a LeRobot data set of the navigations, with X-ray images, their recordings being driven again
            (docs/concepts/dataset.md).
        table: print what lies on disk, and let no policy climb: a row for each task and policy of the submissions in
            the output folder, or in submissions and runs if not given, and of the runs in and below it, with the time
            that decisions took; then which tasks a policy has no row of.
        page: write index.html with pictures and replays; --no-page leaves it out.
    """
    if table:
        return _tabulated(output)
    if check is not None:
        return _confirmed(check, dataset, config.policy)
    if dataset is not None:
        require_extras("learn")  # before hours of work
    from endopilot.ladder.submission import SUBMISSION_FILE
    from endopilot.ladder.table import CLIMBED, shown_row

    folder = output or Path("runs") / "ladder" / config.policy.replace(":", ".")
    rows = climb(output=folder, config=config)
    if dataset is not None:
        _write_dataset(folder / SUBMISSION_FILE, dataset)
    made = (_page(folder) if page else {}) | {"submission": folder / SUBMISSION_FILE}
    return Answer(rows, [[shown_row(row, CLIMBED) for row in rows], made])


def _page(folder: Path) -> dict[str, Any]:
    if not extras_present()["report"]:
        return {"left_out": "the page, which needs: pip install 'endopilot[report]'"}
    from endopilot.report.ladder_page import write_ladder_page

    return {"page": write_ladder_page(folder)}


def _tabulated(folder: Path | None) -> Answer:
    from endopilot.ladder.table import PLACES, TABLED, missing, shown_row, tabulate, terms_in_words

    rows = tabulate(*([folder] if folder else filter(Path.is_dir, map(Path, PLACES))))
    shown, none = dict[str, list[dict[str, Any]]](), dict[tuple[str, str], list[str]]()
    for cell in missing(rows):
        none.setdefault((cell["policy"], cell["terms"]["ladder"]), []).append(cell["task"])
    for row in rows:
        title = terms_in_words(row["terms"]) + ("\nas submissions say" if row["source"] == "file" else "")
        shown.setdefault(title, []).append(shown_row(row, TABLED))
    parts = [part for title, some in shown.items() for part in (title, some, "")]
    parts += [f"No row of {policy}, {ladder}: {', '.join(tasks)}" for (policy, ladder), tasks in none.items()]
    return Answer(rows + missing(rows), parts)


def _confirmed(file: Path, dataset: Path | None, policy: str) -> Answer:
    from endopilot.ladder.submission import check_submission

    checked = check_submission(file, policy=policy)
    if checked.confirmed and dataset is not None:
        _write_dataset(file, dataset)
    about = {"confirmed": checked.confirmed} | asdict(checked)
    shown = [{name: value for name, value in about.items() if name != "scores"}, checked.scores]
    return Answer(about, shown, passed=checked.confirmed)


def _write_dataset(file: Path, dataset: Path) -> None:
    from endopilot.ladder.demonstrations import write_demonstrations  # extras bring its libraries

    write_demonstrations(file, output=dataset)
