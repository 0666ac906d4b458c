"""`endopilot ladder`: a policy on twelve tasks in unseen patients -> scores and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from endopilot.cli.arguments import show, show_rows
from endopilot.ladder.ladder import LadderConfig, climb


def command(
    *,
    output: Annotated[Path | None, arg(name="output", aliases=("-o",), metavar="DIR")] = None,
    off: float = 0.0,
    page: bool = True,
    json: bool = False,
    config: LadderConfig = LadderConfig(),
) -> None:
    """Let a policy climb the ladder: twelve tasks, each in twenty synthetic patients. An interrupted run goes on.

    Args:
        output: folder of the results; runs/ladder/POLICY if not given, or runs/ladder-mismatch/POLICY with --off.
        off: share, such as 0.2, by which friction, tip stiffness, latency and ostium are off from what the policy is
            told, one after another and together; a table of how its scores degrade takes the place of the ladder's.
        page: write index.html with pictures and replays.
        json: print the scores as JSON.
        config: which policy, tasks and patients.
    """
    from endopilot.ladder.mismatch import PICTURE_FILE, measure_mismatch
    from endopilot.report.ladder_page import write_page

    folder = output or Path("runs") / ("ladder-mismatch" if off else "ladder") / config.policy
    rows = measure_mismatch(folder, config, off) if off else climb(folder, config)
    show_rows(rows, as_json=json)
    made = {"picture": folder / PICTURE_FILE} if off else {"page": write_page(folder)} if page else {}
    if made and not json:
        show({name: str(path) for name, path in made.items()}, as_json=False)
