"""`endopilot verify`: the rod core against closed forms."""

from __future__ import annotations

import sys
from pathlib import Path

from endopilot.cli.arguments import show_rows
from endopilot.simulation.verify import run_verification

EXIT_FAILED = 1


def command(*, plots: Path | None = None, json: bool = False) -> None:
    """Run the rod core through cases whose answers are known, and print case, reference, value, error, bar, verdict.

    Leaves with exit code 1 if a case misses its bar.

    Args:
        plots: folder for a figure a case.
        json: print the rows as JSON.
    """
    rows = run_verification(plots)
    show_rows(rows, as_json=json)
    if not all(row["passed"] for row in rows):
        sys.exit(EXIT_FAILED)
