"""Measure the rod core and write the figures into docs/performance.md: `python docs/figures/performance.py`.

Takes some three minutes; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from endopilot.files import processor_name

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "performance.md"


def output(*command: str) -> str:
    """Return what a command prints."""
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def bench(subject: str) -> object:
    """Return the figures of `endopilot bench`."""
    return json.loads(output(sys.executable, "-m", "endopilot.cli", "bench", subject, "--json"))


def table(rows: list[dict[str, object]]) -> str:
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
    """Run the three measurements."""
    figures = bench("simulation")
    assert isinstance(figures, dict)
    rows = [{"figure": name, "value": value} for name, value in figures.items()]
    fill("simulation", f"{processor_name()}:\n\n{table(rows)}")
    scaling = bench("scaling")
    assert isinstance(scaling, list)
    fill("scaling", table(scaling))
    fill("roofline", "```\n" + output("make", "-s", "roofline").rstrip() + "\n```")


if __name__ == "__main__":
    main()
