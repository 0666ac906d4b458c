"""Measure extraction, write the figures into docs/evidence/anatomy.md and draw its picture.

`python docs/figures/anatomy.py [FOLDER]`, where the folder holds rca_cl.vtp and lca_cl.vtp of a real patient; takes
some five minutes. With `--from FILE` it takes the figures from what `python -m benchmarks anatomy --json` printed, with
`--touching FILE` those of `python -m benchmarks touching --json`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.anatomy.extraction import extraction_errors
from benchmarks.figures import DOCS, fill
from endopilot.anatomy.anatomy_picture import draw_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient


def tables(rows: list[dict]) -> str:
    """Return the figures of the analytic tubes as one row a case, and the others below."""
    tubes = [row for row in rows if "voxel" in row["case"]]
    columns = list(dict.fromkeys(row["figure"] for row in tubes))
    bars = {row["figure"]: row["bar"] for row in tubes}
    lines = ["| lumen | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    lines.append(
        "| *bar* | " + " | ".join("–" if bars[name] is None else f"*{bars[name]:g}*" for name in columns) + " |"
    )
    for case in dict.fromkeys(row["case"] for row in tubes):
        lines.append(f"| {case} | " + " | ".join(text(row) for row in tubes if row["case"] == case) + " |")
    lines += ["", "| case | figure | value | bar |", "|---|---|---|---|"]
    for row in rows:
        if row not in tubes:
            lines.append(f"| {row['case']} | {row['figure']} | {text(row)} | {row['bar']:g} |")
    return "\n".join(lines)


def touching(figures: dict) -> str:
    """Return what is said of what touches, and what large inputs cost."""
    lines = ["| lumen | as | cases | figure | value |", "|---|---|---|---|---|"]
    lines += [f"| {r['kind']} | {r['source']} | {r['cases']} | {r['figure']} | {text(r)} |" for r in figures["touching"]]
    lines += ["", "| input | figure | value | bar |", "|---|---|---|---|"]
    lines += [f"| {r['case']} | {r['figure']} | {text(r)} | {r['bar']:g} |" for r in figures["cost"]]
    return "\n".join(lines)


def text(row: dict) -> str:
    """Return a value, in bold where it exceeds its bar."""
    return f"**{row['value']:.3g}**" if row["passed"] is False else f"{row['value']:.3g}"


def main(arguments: list[str]) -> None:
    """Measure, write and draw."""
    if arguments[:1] == ["--touching"]:
        fill("evidence/anatomy.md", "touching", touching(json.loads(Path(arguments[1]).read_text(encoding="utf-8"))))
        return
    if arguments[:1] == ["--from"]:
        rows = json.loads(Path(arguments[1]).read_text(encoding="utf-8"))
    else:
        rows = extraction_errors(Path(arguments[0]) if arguments else None)
    fill("evidence/anatomy.md", "bench", tables(rows))
    draw_anatomy(make_patient(AtlasConfig(seed=1), 0), DOCS / "images" / "anatomy.png")


if __name__ == "__main__":
    main(sys.argv[1:])
