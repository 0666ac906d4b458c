"""Write the cockpit's speed into docs/evidence/cockpit.md: `python docs/figures/cockpit_bench.py [alone] [pair]`.

Runs `python -m benchmarks cockpit` five times, then three times in turn with a catheter, which takes ten minutes;
nothing else should run meanwhile. `alone` and `pair` make one of the two tables.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.cockpit import BARS
from benchmarks.figures import fill

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, "-m", "benchmarks", "cockpit", "--json")
RUNS, PAIR_RUNS = 5, 3
CATHETER = "microcatheter-1.7f"
QUIET = 2.5
"""Mean number of busy programs over five minutes, the measurement's own among them, below which nothing else ran."""
WHAT = {
    "realtime_reserve": "simulated time over the time that it takes",
    "latency_p95_ms": "from the key to the first frame with the wire moved, the robot's latency of 50 ms included",
    "frames_per_second": "the fewer of the two views, 512 × 512 pixels of X-ray at 30 pulses a second",
    "frames_per_second_thinking": "the same while the agent searches and drives",
    "ready_seconds": "from the command to the first frame",
}


def main() -> None:
    """Fill the tables that are asked for."""
    makers = {"alone": alone, "pair": pair}
    for name in sys.argv[1:] or makers:
        makers[name]()


def alone() -> None:
    """Fill the table of a wire alone."""
    found = [measured() for _ in range(RUNS)]
    rows = ["| figure | median | from | to | bar | met in |", "|---|---|---|---|---|---|"]
    for name in BARS:
        values = [run[name] for run in found]
        met = sum(run["passed"][name] for run in found)
        rows.append(
            f"| `{name}`: {WHAT[name]} | {median(values):.4g} | {min(values):.4g} | {max(values):.4g} | "
            f"{BARS[name]} | {met} of {RUNS} |"
        )
    write("bench", RUNS, rows)


def pair() -> None:
    """Fill the table of a wire in a catheter, measured in turn with the wire alone."""
    found = [(measured(), measured("--catheter", CATHETER)) for _ in range(PAIR_RUNS)]
    rows = ["| figure, median | wire alone | wire and catheter | bar |", "|---|---|---|---|"]
    for name in BARS:
        middle = [median(both[which][name] for both in found) for which in (0, 1)]
        rows.append(f"| `{name}` | {middle[0]:.4g} | {middle[1]:.4g} | {BARS[name]} |")
    write("bench-pair", PAIR_RUNS, rows)


def measured(*more: str) -> dict[str, Any]:
    """Return what `python -m benchmarks cockpit` prints."""
    return json.loads(subprocess.run([*COMMAND, *more], cwd=ROOT, capture_output=True, text=True).stdout)


def write(mark: str, runs: int, rows: list[str]) -> None:
    """Write a table between the page's marks."""
    load = os.getloadavg()[1]
    others = "nothing else running" if load < QUIET else f"other work running beside (load {load:.0f})"
    fill("evidence/cockpit.md", mark, [f"Two cores, {others}, {runs} runs:", "", *rows])


if __name__ == "__main__":
    main()
