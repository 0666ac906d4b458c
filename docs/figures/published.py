"""Write the figures of `python -m benchmarks published --json > FILE` into docs/evidence/bench.md.

`python docs/figures/published.py FILE`. The run itself takes ten minutes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill

TITLES = {
    "prediction": "Predictions",
    "unpublished": "Predictions that no published figure can judge",
    "sensitivity": "The same with one assumption changed: what the figures depend on",
    "calibration": "Calibrations and what was drawn, which are no predictions",
}


def text(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table for each kind."""
    lines: list[str] = []
    for kind, title in TITLES.items():
        lines += [f"{title}:", "", "| test | published | ours: median [5-95 %] | draws within | verdict | remarks |"]
        lines += ["|---|---|---|---|---|---|", *(_line(row) for row in rows if _table(row) == kind), ""]
    return "\n".join(lines).rstrip()


def _table(row: dict[str, Any]) -> str:
    """Return which of the tables a row belongs to."""
    return "unpublished" if row["kind"] == "prediction" and row["published_least"] is None else row["kind"]


def _line(row: dict[str, Any]) -> str:
    least, largest, unit = row["published_least"], row["published_largest"], row["unit"]
    if least is None:
        published = "no figure"
    else:
        published = (f"{least:g} {unit}" if least == largest else f"{least:g} to {largest:g} {unit}").rstrip()
    ours = f"{row['ours']:g} [{row['ours_p5']:g} to {row['ours_p95']:g}]" if row["draws"] > 1 else f"{row['ours']:g}"
    ours += f" {unit}" if least is None and unit else ""
    within = "" if row["share_within"] is None or row["draws"] == 1 else f"{100 * row['share_within']:.0f} %"
    error = f"{100 * (row['ours'] / least - 1):+.1f} %" if least is not None and least == largest else ""
    verdict = error or row["verdict"] or ("not judged" if row["kind"] == "prediction" else "")
    case = row["case"].replace("pushed through ", "")
    return f"| {case} | {published} | {ours} | {within} | {verdict} | {row['note']} |"


def main(file: str) -> None:
    """Replace what stands between the page's marks."""
    fill("evidence/bench.md", "published", text(json.loads(Path(file).read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main(sys.argv[1])
