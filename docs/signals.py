"""Write the table of a trajectory's signals in docs/concepts/trajectory.md: `python docs/signals.py`."""

from __future__ import annotations

from pathlib import Path

from endopilot.simulation.signals import SIGNALS

PAGE = Path(__file__).parent / "concepts" / "trajectory.md"
BEGIN, END = "<!-- signals:begin -->", "<!-- signals:end -->"


def page() -> str:
    """Return the page as it is to be: what stands between the markers is made of the table of signals."""
    head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    rows = ["| array | axes | unit | columns of a table | meaning |", "| --- | --- | --- | --- | --- |"]
    for name, each in SIGNALS.items():
        columns = ", ".join(f"`{column}`" for column in each.columns)
        rows.append(f"| `{name}` | {each.axes} | {each.unit} | {columns} | {each.meaning} |")
    return f"{head}{BEGIN}\n" + "\n".join(rows) + f"\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
