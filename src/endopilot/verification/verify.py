"""Verification: the rod core against closed forms, each with its equation and source.

Every case drives the same C++ core as the product, through `simulation.core.run_core`, on rods of its own making.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from endopilot.progress import progress
from endopilot.verification import contact, engine, free_rod, motion, order, stability, tube, tubes
from endopilot.verification.case import Case
from endopilot.verification.plots import draw


def run_verification(plots: Path | None = None) -> list[dict[str, Any]]:
    """Run every case.

    Args:
        plots: folder for a figure of each case.

    Returns:
        One row a comparison: case, reference, value, error, bar, passed (None if it was skipped).
    """
    modules = (free_rod, stability, contact, tube, tubes, motion, engine, order)
    groups: list[Callable[[], list[Case]]] = [group for module in modules for group in module.CASES]
    cases: list[Case] = []
    with progress("Verifying the rod core", total=len(groups)) as advance:
        for group in groups:
            cases.extend(group())
            advance()
    if plots is not None:
        draw(cases, Path(plots))
    return [case.row() for case in cases]
