"""Write the figures of `python -m benchmarks robustness --json > FILE` into docs/evidence/robustness.md.

`python docs/figures/robustness.py FILE`, or `... FILE catheters` for a run with `--catheters`. Each run takes half
an hour on two quiet cores.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill


def text(measured: dict) -> str:
    """Return the figures beside their bars, those of each device and manoeuvre, and every invalid world."""
    fitting = measured["penetration_p999_where_devices_fit_mm"]
    lines = [
        f"Of {measured['rollouts']} rollouts ({measured['simulated_hours']:.0f} simulated hours):",
        "",
        "| figure | value | bar |",
        "|---|---|---|",
        *(f"| {row['figure']} | {row['value']:g} | {row['bar']:g} |" for row in measured["figures"]),
        "",
        f"The largest force of a drive is {measured['drive_over_limit_max']:g} times its limit; in "
        f"{100 * measured['share_over_limit_by_6_percent']:.2g} % of the samples one is beyond 1.06 times.",
        "",
        f"In {100 * measured['wedged_share']:.2g} % of the samples a device has come through a lumen narrower than "
        f"itself. In the others the 99.9th percentile of penetration is {fitting:g} mm.",
        "",
        "| group | rollouts | invalid | penetration p99, mm | p99.9, mm | largest, mm |",
        "|---|---|---|---|---|---|",
    ]
    for group in ("by_device", "by_manoeuvre"):
        for name, row in measured[group].items():
            depths = (row[f"penetration_{which}_mm"] for which in ("p99", "p999", "max"))
            lines.append(f"| {name} | {row['rollouts']} | {row['invalid']} | " + " | ".join(map(str, depths)) + " |")
    failed = measured["invalid_worlds"] + measured["crashed"]
    return "\n".join([*lines, "", "Invalid worlds:", "", *(f"- {line}" for line in failed or ["none"])])


def main(file: str, kind: str = "robustness") -> None:
    """Replace what stands between the page's marks of one kind."""
    fill("evidence/robustness.md", kind, text(json.loads(Path(file).read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main(*sys.argv[1:])
