"""`endopilot verify`: the rod core compared with closed forms."""

from __future__ import annotations

from endopilot.cli.arguments import Answer
from endopilot.verification import free_rod
from endopilot.verification.case import run


def command() -> Answer:
    """Compare the rod core with closed forms of free rods; print one row a case and its verdict.

    A row holds case, reference, value, error and bar. The exit code is 1 if an error exceeds its bar. In the source
    tree, `python -m benchmarks verification` also compares drives, walls, friction, catheters, moving vessels and an
    independent engine, and `python -m benchmarks --help` lists what else is measured.
    """
    rows = [case.row() for case in run(free_rod.CASES)]
    more = "more: `python -m benchmarks verification` in the source tree (drives, walls, catheters, MuJoCo)"
    return Answer(rows, [rows, more], passed=all(row["passed"] is not False for row in rows))
