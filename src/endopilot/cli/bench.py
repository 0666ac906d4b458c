"""`endopilot bench`: speed of the rod core with its accuracy and its robustness, and the quality of segmentation."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from endopilot.cli.arguments import show, show_rows
from endopilot.evaluation.imaging_bench import BARS, ImagingBenchConfig, bench_imaging
from endopilot.simulation.bench import bench_scaling, bench_simulation
from endopilot.simulation.robustness import RobustnessConfig, measure_robustness

EXIT_FAILED = 1


def command(
    subject: Positional[Literal["simulation", "scaling", "robustness", "imaging"]] = "simulation",
    /,
    *,
    json: bool = False,
    seed: int = 0,
    folder: Path | None = None,
    cases: int = ImagingBenchConfig.cases,
    rollouts: int = RobustnessConfig.rollouts,
    anatomies: int = RobustnessConfig.anatomies,
    seconds: float = RobustnessConfig.seconds,
    threads: int = RobustnessConfig.threads,
) -> None:
    """Measure the rod core (speed with its error, growth of cost, robustness), or the segmentation of coronary trees.

    `simulation` times the reference scenario. `scaling` varies the number of elements and of worlds. `robustness`
    drives every device through many anatomies and beyond their ends, and counts what goes wrong. `imaging` segments
    synthetic CT angiograms from the volume alone and compares with the truth. The last two leave with exit code 1 if a
    figure misses its bar, and go on where they were interrupted.

    Args:
        subject: what to measure.
        json: print the figures as JSON.
        seed: seed of `robustness` and `imaging`.
        folder: where these two keep their results; runs/SUBJECT by default.
        cases: CT angiograms of `imaging`.
        rollouts: rollouts of `robustness`, spread over the anatomies and the devices that fit.
        anatomies: synthetic anatomies of `robustness`.
        seconds: length of a rollout of `robustness`, s.
        threads: threads of the rod core in `robustness`; 0 for one a processor core.
    """
    folder = folder or Path("runs") / subject
    if subject == "simulation":
        show(bench_simulation(), as_json=json)
    elif subject == "scaling":
        show_rows(bench_scaling(), as_json=json)
    elif subject == "imaging":
        _leave(_show_imaging(bench_imaging(ImagingBenchConfig(cases=cases, seed=seed, folder=folder)), as_json=json))
    else:
        measured = measure_robustness(
            RobustnessConfig(
                rollouts=rollouts, anatomies=anatomies, seed=seed, seconds=seconds, threads=threads, folder=folder
            )
        )
        if json:
            show(measured, as_json=True)
        else:
            _show_robustness(measured)
        _leave(all(row["passed"] for row in measured["figures"]))


def _leave(passed: bool) -> None:
    if not passed:
        sys.exit(EXIT_FAILED)


def _show_imaging(measured: dict[str, Any], *, as_json: bool) -> bool:
    """Print the figures; return whether each meets its bar."""
    if as_json:
        show(measured, as_json=True)
    else:
        show_rows([{"figure": name} | measured[name] for name in BARS], as_json=False)
        show({name: value for name, value in measured.items() if name not in BARS}, as_json=False)
    return all(measured[name]["met"] for name in BARS)


def _show_robustness(measured: dict[str, Any]) -> None:
    groups = ("by_device", "by_manoeuvre")
    show_rows(measured["figures"], as_json=False)
    show_rows([{"group": name} | row for group in groups for name, row in measured[group].items()], as_json=False)
    rest = {name: value for name, value in measured.items() if name not in ("figures", *groups) and value}
    show(rest, as_json=False)
