"""`endopilot bench`: speed of the rod core with its accuracy, how cost grows, its robustness; cost of a dataset."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from endopilot.cli.arguments import OutputFolder, show, show_rows
from endopilot.dataset.bench import bench_dataset
from endopilot.simulation.bench import bench_scaling, bench_simulation
from endopilot.simulation.robustness import RobustnessConfig, measure_robustness

EXIT_FAILED = 1


def command(
    subject: Positional[Literal["simulation", "scaling", "robustness", "dataset"]] = "simulation",
    /,
    *,
    output: OutputFolder = Path("runs/bench-dataset"),
    share: float = 0.05,
    json: bool = False,
    config: RobustnessConfig = RobustnessConfig(),
) -> None:
    """Measure the rod core: its speed with the error that goes with it, how cost grows, or its robustness.

    `simulation` times the reference scenario. `scaling` varies the number of elements and of worlds. `robustness`
    drives every device through many anatomies and beyond their ends, counts what goes wrong, and leaves with exit
    code 1 if a figure misses its bar; the options at the end are its own. `dataset` makes a slice of the paper's set of
    100 000 navigations, and says what all of it would take; an interrupted run goes on where it stopped.

    Args:
        subject: what to measure.
        output: folder of the slice that `dataset` makes.
        share: of the paper's set that `dataset` makes, 0 to 1.
        json: print the figures as JSON.
        config: the rollouts of `robustness`.
    """
    if subject == "simulation":
        show(bench_simulation(), as_json=json)
        return
    if subject == "scaling":
        show_rows(bench_scaling(), as_json=json)
        return
    if subject == "dataset":
        show(bench_dataset(output, share=share), as_json=json)
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
