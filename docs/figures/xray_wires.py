"""Write the table of wires in real arteries in docs/evidence/detection.md: `python docs/figures/xray_wires.py FILE`.

FILE holds what `python -m benchmarks xray-wires --json` prints.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.files import processor_name

HEAD = (
    "| | wires | missed, two views | one view | wrong and said so | called found and missed | doubted though right "
    "| in own 95 % region |"
)
SHARES = (
    "missed_share",
    "missed_share_one_view",
    "said_share",
    "surely_wrong_share",
    "doubted_share",
    "inside_own_95_share",
)


def table(found: dict) -> str:
    """Return the table as Markdown."""
    lines = [HEAD, "|---|---|---|---|---|---|---|---|"]
    for name, row in {"all": found, **found["by"]}.items():
        shares = ("–" if row[one] is None else f"{row[one]:.0%}".replace("%", " %") for one in SHARES)
        lines.append(f"| {name} | {row['wires']} | " + " | ".join(shares) + " |")
    limits = (f"{found['bars'][name]:.0%}".replace("%", " %") for name in SHARES[:3])
    lines.append("| bar | | ≤ {} | ≤ {} | ≥ {} | | | 92 to 97 % |".format(*limits))
    false, most_ms = f"{found['false_alarms_share']:.0%}".replace("%", " %"), found["bars"]["ms_a_view"]
    lines += [
        "",
        f"A wire is found in {false} of the exposures without one. A detection takes {found['ms_a_view']:.0f} ms of "
        f"one core's time a view (median; bar ≤ {most_ms:g}), on {processor_name()} that others use too.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    text = table(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    fill("evidence/detection.md", "wires", text)
