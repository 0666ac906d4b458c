"""`endopilot verify`: the rod core compared with closed forms."""

from __future__ import annotations

import sys

from endopilot.cli.arguments import show_rows
from endopilot.verification import free_rod
from endopilot.verification.case import run

EXIT_FAILED = 1


def command(*, json: bool = False) -> None:
    """Compare the rod core with closed forms of free rods; print one row a case and its verdict.

    A row holds case, reference, value, error and bar. The exit code is 1 if an error exceeds its bar. In the source
    tree, `python -m benchmarks verification` also compares drives, walls, friction, catheters, moving vessels and an
    independent engine, and `python -m benchmarks --help` lists what else is measured.

    Args:
        json: print the rows as JSON.
    """
    rows = [case.row() for case in run(free_rod.CASES)]
    show_rows(rows, as_json=json)
    if not json:
        print("more: `python -m benchmarks verification` in the source tree (drives, walls, catheters, MuJoCo)")
    if any(row["passed"] is False for row in rows):
        sys.exit(EXIT_FAILED)
