"""Write the table of all claims into docs/evidence/index.md: `python docs/claims.py`.

docs/evidence/claims.yaml says what is claimed; the figures, and the machine that made them, are read from the pages.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import yaml

sys.path.append(str(Path(__file__).parents[1]))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill, find_row, markdown_table

PAGE = "evidence/index.md"


def claims() -> dict[str, list[dict[str, str]]]:
    """Return what each page of evidence claims: `claim`, `figure` and `command`."""
    return yaml.safe_load((DOCS / "evidence" / "claims.yaml").read_text(encoding="utf-8"))


def cell(page: str, place: str) -> tuple[str, str]:
    """Return a cell of a page, and when and on what machine it was made.

    Args:
        page: name of the page of evidence.
        place: the table's marks, the row's cells and the column, as claims.yaml has them.

    Raises:
        LookupError: the page has no such cell.
    """
    mark, row, column = (part.strip() for part in place.split("|"))
    found = find_row(f"evidence/{page}.md", mark, *(part.strip() for part in row.split("&")))
    columns = [place for place, heading in enumerate(found.head) if heading.startswith(column)]
    if not (columns or column.isdigit()):
        raise LookupError(f"evidence/{page}.md: no column {column!r} beside {row!r}")
    return found.cells[int(column) if column.isdigit() else columns[0]], found.made


def rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield claim, figure, day and machine, command, and link of each claim."""
    for page, claimed in claims().items():
        for each in claimed:
            parts = re.split(r"{(.+?)}", each["figure"])
            cells = [cell(page, place) for place in parts[1::2]]
            parts[1::2] = [figure for figure, _ in cells]
            yield each["claim"], "".join(parts), cells[0][1] or "–", f"`{each['command']}`", f"[{page}]({page}.md)"


def table() -> list[str]:
    """Return the table of all claims."""
    return markdown_table(("claim", "figure", "made on", "command", "page"), rows())


if __name__ == "__main__":
    fill(PAGE, "claims", table(), dated=False)
