"""Measure the cockpit's speed and write it into docs/cockpit.md: `python docs/figures/cockpit_bench.py`.

Runs `endopilot bench cockpit` five times, which takes four minutes; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from statistics import median

from endopilot.benchmarks.cockpit import BARS
from endopilot.files import processor_name

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "cockpit.md"
COMMAND = (sys.executable, "-m", "endopilot.cli", "bench", "cockpit", "--json")
RUNS = 5
WHAT = {
    "realtime_reserve": "simulated time over the time that it takes",
    "latency_p95_ms": "from the key to the first frame with the wire moved, the robot's latency of 50 ms included",
    "frames_per_second": "the fewer of the two views, 512 × 512 pixels of X-ray at 30 pulses a second",
    "ready_seconds": "from the command to the first frame",
}


def main() -> None:
    """Fill the table between the page's marks."""
    found = [json.loads(subprocess.run(COMMAND, cwd=ROOT, capture_output=True, text=True).stdout) for _ in range(RUNS)]
    lines = [
        f"{processor_name()}, two cores, nothing else running, {RUNS} runs:",
        "",
        "| figure | median | from | to | bar | met in |",
        "|---|---|---|---|---|---|",
    ]
    for name in BARS:
        values = [run[name] for run in found]
        met = sum(run["passed"][name] for run in found)
        lines.append(
            f"| `{name}`: {WHAT[name]} | {median(values):.4g} | {min(values):.4g} | {max(values):.4g} | "
            f"{found[0]['bars'][name].replace('>=', '≥').replace('<=', '≤')} | {met} of {RUNS} |"
        )
    begin, end = "<!-- bench:begin -->", "<!-- bench:end -->"
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.split(begin)[0] + "\n".join([begin, *lines, end]) + page.split(end)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
