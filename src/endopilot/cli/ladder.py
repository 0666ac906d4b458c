"""`endopilot ladder`: a policy on twelve tasks in unseen patients -> scores, a page and a submission file."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from endopilot.cli.arguments import existing, show, show_rows
from endopilot.ladder.ladder import LadderConfig, climb

EXIT_FAILED = 1


def command(
    *,
    output: Annotated[Path | None, arg(name="output", aliases=("-o",), metavar="DIR")] = None,
    mismatch: float = 0.0,
    check: Path | None = None,
    page: bool = True,
    json: bool = False,
    config: LadderConfig = LadderConfig(),
) -> None:
    """Let a policy climb the ladder: twelve tasks, each in twenty synthetic patients. An interrupted run goes on.

    The output folder gets the scores, a page with pictures and replays, and submission.json: it holds all that others
    need to confirm the scores without the policy.

    Args:
        output: folder of the results; runs/ladder/POLICY if not given, or runs/ladder-mismatch/POLICY with --mismatch.
        mismatch: model mismatch, a share between 0 and 1 such as 0.2: friction, tip stiffness, latency and ostium
            differ by it from what the policy is given, one after another and together. The scores of each case are
            printed instead of the ladder's.
        check: a submission.json. Its recorded controls are driven again, without the policy, and its scores confirmed
            to the bit; exit code 1 if one differs. Nothing else is done.
        page: write index.html with pictures and replays; --no-page leaves it out.
        json: print the scores as JSON.
        config: which policy, tasks and patients.
    """
    if check is not None:
        _check(check, as_json=json)
        return
    from endopilot.ladder.mismatch import PICTURE_FILE, measure_mismatch
    from endopilot.ladder.submission import SUBMISSION_FILE
    from endopilot.report.ladder_page import write_page

    name = config.policy.replace(":", ".")
    folder = output or Path("runs") / ("ladder-mismatch" if mismatch else "ladder") / name
    rows = measure_mismatch(folder, config, mismatch) if mismatch else climb(folder, config)
    show_rows(rows, as_json=json)
    if mismatch:
        made = {"picture": folder / PICTURE_FILE}
    else:
        made = ({"page": write_page(folder)} if page else {}) | {"submission": folder / SUBMISSION_FILE}
    if not json:
        show({name: str(path) for name, path in made.items()}, as_json=False)


def _check(file: Path, *, as_json: bool) -> None:
    from endopilot.ladder.submission import check_submission

    checked = check_submission(existing(file))
    show({"confirmed": checked.difference is None} | asdict(checked), as_json=as_json)
    if checked.difference is not None:
        sys.exit(EXIT_FAILED)
