"""Measure the rod core and write the figures into docs/performance.md: `python docs/figures/performance.py`.

Takes some ten minutes; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from endopilot.files import processor_name
from endopilot.simulation.config import PRESETS

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "performance.md"
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


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows as a Markdown table."""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    lines += ["| " + " | ".join(str(value) for value in row.values()) + " |" for row in rows]
    return "\n".join(lines)


def fill(name: str, text: str) -> None:
    """Replace what stands between the page's marks of some name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(begin)[0], page.split(end)[1]
    PAGE.write_text(f"{head}{begin}\n{text}\n{end}{tail}", encoding="utf-8")


def main() -> None:
    """Run the measurements."""
    presets = {name: bench("simulation", "--preset", name) for name in PRESETS}
    figures = presets["default"]
    errors = figures["intervals"]
    nested = ("preset", "intervals", "by_anatomy", "reference_own_error", *errors)
    rows = [{"figure": name, "value": value} for name, value in figures.items() if name not in nested]
    fill("simulation", f"{processor_name()}:\n\n{table(rows)}")
    rows = [
        {"error": name, "all": figures[name], "90 % interval": " to ".join(map(str, interval))}
        | {anatomy: found[name] for anatomy, found in figures["by_anatomy"].items()}
        | {"of the reference": figures["reference_own_error"][name]}
        for name, interval in errors.items()
    ]
    fill("errors", table(rows))
    fill(
        "presets", table([{"preset": name} | {key: found[key] for key in COMPARED} for name, found in presets.items()])
    )
    for name, options in BESIDE.items():
        found = bench("simulation", *options)
        fill(name, table([{"figure": figure, "value": value} for figure, value in found.items()]))
    fill("scaling", table(bench("scaling")))
    fill("roofline", "```\n" + output("make", "-s", "roofline").rstrip() + "\n```")


if __name__ == "__main__":
    main()
