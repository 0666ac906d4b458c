"""`endopilot ladder`: a policy on twelve tasks in unseen patients -> scores and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from endopilot.cli.arguments import show, show_rows
from endopilot.evaluation.ladder import LadderConfig, climb


def command(
    *,
    output: Annotated[Path | None, arg(name="output", aliases=("-o",), metavar="DIR")] = None,
    page: bool = True,
    json: bool = False,
    config: LadderConfig = LadderConfig(),
) -> None:
    """Let a policy climb the ladder: twelve tasks, each in twenty synthetic patients. An interrupted run goes on.

    Args:
        output: folder of the results; runs/ladder/POLICY if not given.
        page: write index.html with pictures and replays.
        json: print the scores as JSON.
        config: which policy, tasks and patients.
    """
    from endopilot.evaluation.ladder_page import write_page

    folder = output or Path("runs/ladder") / config.policy
    rows = climb(folder, config)
    show_rows(rows, as_json=json)
    if page:
        made = write_page(folder)
        if not json:
            show({"page": str(made)}, as_json=False)
