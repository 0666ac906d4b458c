"""`python -m benchmarks NAME [options]`: what the rod core and every stage are measured by, one function each.

The arguments of the function are the options. It returns its figures, which are printed as tables, or with `--json` as
JSON. Where figures have bars, the exit code is 1 if one does not meet its bar. With `--against CHECKOUT` the benchmark
runs in turns in another checkout and in this one, and the figures of both stand side by side.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from endopilot.errors import InputError
from endopilot.extras import what_is_missing

BENCHMARKS = {
    "simulation": "core.simulation:bench_simulation",
    "scaling": "core.simulation:bench_scaling",
    "env": "core.env:bench_env",
    "robustness": "core.robustness:measure_robustness",
    "verification": "verification.verification:bench_verification",
    "engine": "verification.kirchhoff:drive_engine",
    "published": "published.published:bench_published",
    "judges": "judges.judges:bench_judges",
    "robot-twist": "robot.twist:bench_twist",
    "robot-blind": "robot.blind:bench_blind",
    "robot-left-out": "robot.left_out:bench_left_out",
    "dataset": "dataset:bench_dataset",
    "cockpit": "cockpit:bench_cockpit",
    "anatomy": "anatomy.extraction:bench_anatomy",
    "labels": "anatomy.labels:measure_labels",
    "ostia": "anatomy.ostia:bench_ostia",
    "touching": "anatomy.touching:bench_touching",
    "imaging": "imaging.segmentation:bench_imaging",
    "xray": "imaging.xray:bench_xray",
    "xray-wires": "imaging.wires:bench_wires",
    "xray-processing": "imaging.processing:compare_processing",
    "angiograms": "imaging.angiograms:bench_angiograms",
    "lines": "imaging.lines:bench_lines",
    "wire-evidence": "imaging.wire_evidence:train_evidence",
    "agent-calibration": "agent.calibration:calibrate_agent",
    "agent-replanning": "agent.replanning:compare_replanning",
    "agent-samplers": "agent.samplers:compare_samplers",
    "coronary-navigation": "agent.coronary_navigation:navigate_coronaries",
    "ladder-patients": "agent.ladder_patients:choose_patients",
    "xray-conditions": "agent.xray_conditions:drive_under_conditions",
    "worlds": "agent.worlds:drive_in_worlds",
    "turn-network": "agent.turn_network:train_turns",
}
"""Name of each benchmark, and the function that measures: module and name."""
EXIT_FAILED, EXIT_BAD_INPUT = 1, 2


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what `arguments` name (those of the process by default), and leave with 1 if a bar is not met.

    Bad input gives one line on standard error and exit code 2.
    """
    name, *given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(overview())
        return
    common, options = _common().parse_known_args(given)
    if (name, common.against) == ("anatomy", Path("vmtk")):  # another program, no checkout
        name, options, common.against = "judges", ["--only", "vmtk", *options], None
    try:
        if name not in BENCHMARKS:
            raise InputError("there is none of this name; `python -m benchmarks --help` lists them")
        if common.against is None:
            figures = measure(name, options)
        else:
            from benchmarks.against import compare

            figures = compare(common.against, name, options, common.rounds)
    except (InputError, ModuleNotFoundError) as error:
        said = what_is_missing(error) if isinstance(error, ModuleNotFoundError) else str(error)
        if said is None:
            raise
        print(f"benchmarks {name}: {said}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)
    from benchmarks.figures import all_passed, show_figures

    if figures is not None:
        show_figures(figures, as_json=common.json)
    sys.exit(0 if all_passed(figures) else EXIT_FAILED)


def measure(name: str, options: Sequence[str]) -> Any:
    """Run a benchmark with options, and return its figures; None where it prints by itself.

    Raises:
        InputError: its input cannot be used.
    """
    from endopilot.cli.options import Command  # slow to import

    return Command(f"python -m benchmarks {name}", function_of(name)).run(options, shown=False)


def function_of(name: str) -> Callable[..., Any]:
    """Return the function of a benchmark."""
    module, function = BENCHMARKS[name].split(":")
    return getattr(importlib.import_module(f"benchmarks.{module}"), function)


def overview() -> str:
    """Return the text of `python -m benchmarks --help`."""
    lines = [f"  {name:<20} {(function_of(name).__doc__ or '').splitlines()[0]}" for name in BENCHMARKS]
    return "\n".join(
        [
            "usage: python -m benchmarks NAME ... [--json] [--against CHECKOUT [--rounds 3]]",
            "",
            *lines,
            "",
            "`python -m benchmarks NAME --help` gives the options of each. --json prints figures as JSON. --against",
            "runs the benchmark in turns in another checkout, which has a .venv of its own, and here;",
            "anatomy --against vmtk: VMTK's centerlines, radii and time beside ours.",
        ]
    )


def _common() -> argparse.ArgumentParser:
    """Return what reads the options of every benchmark."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--against", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    return parser


if __name__ == "__main__":  # worker processes import this module too
    main()
