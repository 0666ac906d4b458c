"""Write tasks and scores into docs/ladder.md: `python docs/figures/ladder.py [FOLDER]`.

FOLDER, runs/ladder if not given, holds what `endopilot ladder` made of each policy.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from endopilot.env.tasks import ladder_tasks

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "ladder.md"


def fill(name: str, lines: list[str]) -> None:
    """Replace what stands between the page's marks of some name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    page, text = PAGE.read_text(encoding="utf-8"), "\n".join(lines)
    PAGE.write_text(f"{page.split(begin)[0]}{begin}\n{text}\n{end}{page.split(end)[1]}", encoding="utf-8")


def tasks() -> list[str]:
    """Return the table of the tasks."""
    lines = ["| level | task | what | atlas | wire, tip | time, s | patients |", "|---|---|---|---|---|---|---|"]
    for task in ladder_tasks():
        tip = f"{task.device}, {task.tip_bend_deg:g}° over {task.tip_bend_mm:g} mm"
        what = f"{task.title}: {task.depth_mm:g} mm into {task.section}"
        row = (task.level, task.name, what, task.anatomy, tip, f"{task.seconds:g}", task.chosen_for)
        lines.append("| " + " | ".join(str(cell) for cell in row) + " |")
    return lines


def scores(folder: Path) -> list[str]:
    """Return one table of the policies' scores: safe success, and in brackets success, %."""
    done = {
        path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*/ladder.json"))
    }
    tables = {name: {row["task"]: row for row in content["scores"]} for name, content in done.items()}
    names = list(dict.fromkeys(task for table in tables.values() for task in table))
    lines = ["| task | " + " | ".join(tables) + " |", "|---|" + "---|" * len(tables)]
    for name in names:
        cells = []
        for table in tables.values():
            row = table.get(name)
            cells.append("–" if row is None else f"{100 * row['safe_success']:.0f} ({100 * row['success']:.0f})")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for title, key in (("peak force, median, N", "peak_force_n"), ("exposures, mean", "exposures")):
        rows = [table.get("all twelve") or table.get("upper eight") for table in tables.values()]
        lines.append(f"| {title} | " + " | ".join("–" if row is None else f"{row[key]:.3g}" for row in rows) + " |")
    return lines


def main() -> None:
    """Fill the page."""
    fill("tasks", tasks())
    fill("scores", scores(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "runs" / "ladder"))


if __name__ == "__main__":
    main()
