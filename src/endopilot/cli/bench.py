"""`endopilot bench`: speed of the rod core with its accuracy, how cost grows, its robustness; accuracy of anatomies."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from endopilot.anatomy.bench import bench_anatomy
from endopilot.cli.arguments import existing, show, show_rows
from endopilot.simulation.bench import bench_scaling, bench_simulation
from endopilot.simulation.robustness import RobustnessConfig, measure_robustness

EXIT_FAILED = 1


def command(
    subject: Positional[Literal["simulation", "scaling", "robustness", "anatomy"]] = "simulation",
    /,
    *,
    json: bool = False,
    centerlines: Path | None = None,
    config: RobustnessConfig = RobustnessConfig(),
) -> None:
    """Measure the rod core (speed with its error, how cost grows, robustness), or the accuracy of anatomies.

    `simulation` times the reference scenario. `scaling` varies the number of elements and of worlds. `robustness`
    drives every device through many anatomies and beyond their ends, counts what goes wrong, and leaves with exit
    code 1 if a figure misses its bar; the options below are its own. `anatomy` extracts lumens whose truth is known and
    prints each error beside its bar, with the same exit code.

    Args:
        subject: what to measure.
        json: print the figures as JSON.
        centerlines: for `anatomy`, a folder with VMTK's rca_cl.vtp and lca_cl.vtp of a real patient.
        config: the rollouts of `robustness`.
    """
    if subject == "simulation":
        show(bench_simulation(), as_json=json)
        return
    if subject == "scaling":
        show_rows(bench_scaling(), as_json=json)
        return
    if subject == "anatomy":
        rows = bench_anatomy(None if centerlines is None else existing(centerlines))
        show_rows(rows, as_json=json)
        if any(row["passed"] is False for row in rows):
            sys.exit(EXIT_FAILED)
        return
    measured = measure_robustness(config)
    if json:
        show(measured, as_json=True)
    else:
        _show_robustness(measured)
    if not all(row["passed"] for row in measured["figures"]):
        sys.exit(EXIT_FAILED)


def _show_robustness(measured: dict[str, Any]) -> None:
    groups = ("by_device", "by_manoeuvre")
    show_rows(measured["figures"], as_json=False)
    show_rows([{"group": name} | row for group in groups for name, row in measured[group].items()], as_json=False)
    rest = {name: value for name, value in measured.items() if name not in ("figures", *groups) and value}
    show(rest, as_json=False)
