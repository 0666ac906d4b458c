"""Measure the rod core and write the figures into docs/evidence/performance.md: `python docs/figures/performance.py`.

Takes some ten minutes; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill, markdown_table
from endopilot.simulation.config import PRESETS

ROOT = Path(__file__).parents[2]
PAGE = "evidence/performance.md"
COMPARED = (
    "realtime_factor_per_core",
    "node_iterations_per_second",
    "true_tip_error_median_mm",
    "true_tip_error_p95_mm",
    "true_tip_error_p95_before_fork_mm",
    "branch_agreement",
    "wall_force_error_p95_n",
)
"""Figures of the presets that stand side by side."""


BESIDE = {"catheter": ("--catheter", "microcatheter-2.4f"), "motion": ("--motion", "both")}
"""What is measured beside the wire alone in a vessel at rest."""


def output(*command: str) -> str:
    """Return what a command prints; a benchmark exits with 1 where a bar is missed."""
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    if done.returncode > 1:
        sys.exit(f"{' '.join(command)}: {done.stderr}")
    return done.stdout


def bench(*subject: str) -> Any:
    """Return the figures of `python -m benchmarks`."""
    return json.loads(output(sys.executable, "-m", "benchmarks", *subject, "--json"))


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return rows as a Markdown table."""
    return markdown_table(rows[0], (row.values() for row in rows))


def main() -> None:
    """Run the measurements."""
    presets = {name: bench("simulation", "--preset", name) for name in PRESETS}
    figures = presets["default"]
    errors = figures["intervals"]
    nested = ("preset", "intervals", "by_anatomy", "reference_own_error", *errors)
    rows = [{"figure": name, "value": value} for name, value in figures.items() if name not in nested]
    fill(PAGE, "simulation", table(rows))
    rows = [
        {"error": name, "all": figures[name], "90 % interval": " to ".join(map(str, interval))}
        | {anatomy: found[name] for anatomy, found in figures["by_anatomy"].items()}
        | {"of the reference": figures["reference_own_error"][name]}
        for name, interval in errors.items()
    ]
    fill(PAGE, "errors", table(rows))
    fill(
        PAGE,
        "presets",
        table([{"preset": name} | {key: found[key] for key in COMPARED} for name, found in presets.items()]),
    )
    for name, options in BESIDE.items():
        found = bench("simulation", *options)
        fill(PAGE, name, table([{"figure": figure, "value": value} for figure, value in found.items()]))
    fill(PAGE, "scaling", table(bench("scaling")))
    fill(PAGE, "roofline", "```\n" + output("make", "-s", "roofline").rstrip() + "\n```")


if __name__ == "__main__":
    main()
