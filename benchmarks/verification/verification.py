"""Every case of the rod core against closed forms and an independent engine, each with its equation and source.

Every case drives the same C++ core as the product, through `simulation.core.run_core`, on rods of its own making.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.verification import contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes
from benchmarks.verification.plots import draw
from endopilot.verification import free_rod
from endopilot.verification.free_rod import run


def bench_verification(*, plots: Path | None = None) -> list[dict[str, Any]]:
    """Compare the rod core with closed forms and an independent engine: case, reference, value, error, bar, verdict.

    Comparisons with MuJoCo are skipped where it is not installed.

    Args:
        plots: folder that takes a figure of each case; none is drawn if not given.

    Returns:
        One row a comparison: case, reference, value, error, bar, passed (None if it was skipped).
    """
    cases = run(
        [
            group
            for module in (free_rod, transmission, stability, contact, tube, tubes, motion, engine, kirchhoff, order)
            for group in module.CASES
        ]
    )
    if plots is not None:
        draw(cases, plots)
    return [case.row() for case in cases]
