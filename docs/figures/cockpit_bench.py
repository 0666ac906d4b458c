"""Measure the cockpit's speed and write it into docs/cockpit.md: `python docs/figures/cockpit_bench.py [alone] [pair]`.

Runs `endopilot bench cockpit` five times, which takes four minutes, and three times more with a catheter; nothing else
should run meanwhile. `pair` is the second alone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median

from endopilot.benchmarks.cockpit import BARS
from endopilot.files import processor_name

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "cockpit.md"
COMMAND = (sys.executable, "-m", "endopilot.cli", "bench", "cockpit", "--json")
RUNS = {"alone": 5, "pair": 3}
CATHETER = "microcatheter-1.7f"
QUIET = 2.5
"""Mean number of busy programs over five minutes, the measurement's own among them, below which nothing else ran."""
MARKS = {"alone": "bench", "pair": "bench-pair"}
WHAT = {
    "realtime_reserve": "simulated time over the time that it takes",
    "latency_p95_ms": "from the key to the first frame with the wire moved, the robot's latency of 50 ms included",
    "frames_per_second": "the fewer of the two views, 512 × 512 pixels of X-ray at 30 pulses a second",
    "ready_seconds": "from the command to the first frame",
}


def others() -> str:
    """Return what else ran lately, in words."""
    load = os.getloadavg()[1]
    return "nothing else running" if load < QUIET else f"other work running beside (load {load:.0f})"


def main() -> None:
    """Fill the tables that are asked for."""
    for kind in sys.argv[1:] or RUNS:
        fill(kind)


def fill(kind: str) -> None:
    """Fill the table of a wire `alone` or of a `pair` between the page's marks."""
    command = [*COMMAND, *(["--catheter", CATHETER] if kind == "pair" else [])]
    runs = RUNS[kind]
    found = [json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout) for _ in range(runs)]
    lines = [
        f"{processor_name()}, two cores, {others()}, {runs} runs:",
        "",
        "| figure | median | from | to | bar | met in |",
        "|---|---|---|---|---|---|",
    ]
    for name in BARS:
        values = [run[name] for run in found]
        met = sum(run["passed"][name] for run in found)
        lines.append(
            f"| `{name}`: {WHAT[name]} | {median(values):.4g} | {min(values):.4g} | {max(values):.4g} | "
            f"{found[0]['bars'][name].replace('>=', '≥').replace('<=', '≤')} | {met} of {runs} |"
        )
    begin, end = f"<!-- {MARKS[kind]}:begin -->", f"<!-- {MARKS[kind]}:end -->"
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(begin)[0] + "\n".join([begin, *lines, end]) + page.split(end)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
