"""`endopilot verify`: the rod core compared with closed forms and an independent engine."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from endopilot.cli.arguments import show_rows
from endopilot.verification.verify import run_verification

EXIT_FAILED = 1


def command(*, plots: Path | None = None, json: bool = False) -> None:
    """Compare the rod core with known solutions; print case, reference, value, error, bar and verdict.

    The exit code is 1 if an error exceeds its bar. Comparisons with MuJoCo are skipped where it is not installed.

    Args:
        plots: folder that takes a figure of each case; none is drawn if not given.
        json: print the rows as JSON.
    """
    rows = run_verification(plots)
    show_rows(rows if json else [_shown(row) for row in rows], as_json=json)
    if any(row["passed"] is False for row in rows):
        sys.exit(EXIT_FAILED)


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the table, in which a skipped case has no figures."""
    if row["passed"] is None:
        return {name: "-" if value is None else value for name, value in row.items()} | {"passed": "skipped"}
    return row
