"""Write the table of processed images in docs/evidence/detection.md: `python docs/figures/xray_processing.py FILE`.

FILE holds what `python -m benchmarks xray-processing --json` prints.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill

HEAD = (
    "| images | along, across, pixels | missed, two views | one view | in own 95 % region | found where there is none "
    "| registration |"
)
SHARES = ("missed", "missed_one_view", "in_own_95", "false_alarms")


def table(rows: list[dict]) -> str:
    """Return the table as Markdown."""
    lines = [HEAD, "|---|---|---|---|---|---|---|"]
    for row in rows:
        errors = f"{row['along_px']:.2f}, {row['across_px']:.2f}"
        shares = (
            f"{row[name]:.0%}".replace("%", " %") for name in ("missed", "missed_one_view", "in_own_95", "false_alarms")
        )
        lines.append(f"| {row['images']} | {errors} | " + " | ".join(shares) + f" | {row['registration_mm']:.2f} mm |")
    return "\n".join(lines)


if __name__ == "__main__":
    text = table(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    fill("evidence/detection.md", "processing", text)
