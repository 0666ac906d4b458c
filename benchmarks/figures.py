"""What benchmarks share: bars, times and spreads of figures, and how figures are judged, shown and written."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from endopilot.cli.arguments import show
from endopilot.files import processor_name

T = TypeVar("T")
Number = float | int
DOCS = Path(__file__).parents[1] / "docs"
REPEATS = 3
"""Times that work is done for its timing; the fastest counts."""


@dataclass(frozen=True)
class Bar:
    """A limit that a figure keeps: at most `limit`, or at least."""

    limit: Number
    at_least: bool = False

    def met(self, value: Number) -> bool:
        """Return whether a figure meets the bar; one that is no number does not."""
        return bool(value >= self.limit if self.at_least else value <= self.limit)

    def __str__(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {self.limit:g}"

    def row(self, figure: str, value: Number) -> dict[str, Any]:
        """Return a figure beside its bar, as a row of a table."""
        return {"figure": figure, "value": value, "bar": self.limit, "passed": self.met(value)}


def judged(figures: Mapping[str, Any], bars: Mapping[str, Bar]) -> dict[str, Any]:
    """Return figures with the limits of their `bars`, and which of them `passed`."""
    return {
        **figures,
        "bars": {name: bar.limit for name, bar in bars.items()},
        "passed": {name: bar.met(figures[name]) for name, bar in bars.items()},
    }


def all_passed(figures: Any) -> bool:
    """Return whether no `passed` among figures, rows and groups is false."""
    if isinstance(figures, Mapping):
        own = figures.get("passed")
        verdicts = own.values() if isinstance(own, Mapping) else (own,)
        return not any(verdict is False for verdict in verdicts) and all(map(all_passed, figures.values()))
    return not isinstance(figures, list) or all(map(all_passed, figures))


def show_figures(figures: Any, *, as_json: bool) -> None:
    """Print rows, or single figures, then those of several parts and groups of rows as tables; text as it is."""
    if isinstance(figures, str):
        print(figures)
    elif isinstance(figures, list):
        _table(figures, as_json=as_json)
    elif as_json:
        show(figures, as_json=True)
    else:
        single = {name: value for name, value in figures.items() if not _is_group(value)}
        show({name: value for name, value in single.items() if not isinstance(value, Mapping)}, as_json=False)
        parts: dict[tuple[str, ...], dict[str, Any]] = {}
        for name, value in single.items():
            if isinstance(value, Mapping) and value:
                parts.setdefault(tuple(value), {})[name] = value
        groups = [("figure", group) for group in parts.values()]
        groups += [(name, value) for name, value in figures.items() if _is_group(value)]
        for name, group in groups:
            _table(_rows_of(name, group) if isinstance(group, Mapping) else group, as_json=False)


def _is_group(value: Any) -> bool:
    """Return whether a figure is rows, or a row for each name."""
    rows = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return bool(rows) and all(isinstance(row, Mapping) for row in rows)


def _rows_of(name: str, group: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each name in a group, or where it has more figures than names, a row for each figure."""
    figures = list({figure: None for row in group.values() for figure in row})
    if len(figures) <= len(group):
        return [{name: one} | dict(row) for one, row in group.items()]
    return [{name: figure} | {one: row.get(figure) for one, row in group.items()} for figure in figures]


def _table(rows: list[dict[str, Any]], *, as_json: bool) -> None:
    columns = {name: None for row in rows for name in row}
    show(rows if as_json else [columns | row for row in rows], as_json=as_json)


def timed(work: Callable[[], T]) -> tuple[T, float, float]:
    """Do some work, and return what it returns, the wall time and the processor time, s."""
    wall, processor = time.perf_counter(), time.process_time()
    done = work()
    return done, time.perf_counter() - wall, time.process_time() - processor


def in_turns(*works: Callable[[], T]) -> list[tuple[T, float, float]]:
    """Do each piece of work `REPEATS` times, in turns, and return what `timed` does, with the least times.

    A busy machine slows all alike.
    """
    rounds = [[timed(work) for work in works] for _ in range(REPEATS)]
    turns = [list(zip(*runs, strict=True)) for runs in zip(*rounds, strict=True)]
    return [(done[-1], min(wall), min(processor)) for done, wall, processor in turns]


def spread(name: str, values_mm: np.ndarray, *, digits: int = 5) -> dict[str, float]:
    """Return mean, median, 95th percentile and maximum of distances, mm, as `NAME_mean_mm` and so on."""
    found = {
        "mean": np.mean(values_mm),
        "median": np.median(values_mm),
        "p95": np.percentile(values_mm, 95),
        "max": np.max(values_mm),
    }
    return {f"{name}_{what}_mm": round(float(value), digits) for what, value in found.items()}


def made_on() -> str:
    """Return the line that ends a table of measured figures in the documentation: the day and the processor."""
    return f"Made on {date.today()}, {processor_name()}."


def markdown_table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a table of the documentation."""
    titles = [str(cell) for cell in head]
    lines = [titles, *([str(cell) for cell in row] for row in rows)]
    first, *others = ["| " + " | ".join(line) + " |" for line in lines]
    return [first, "|" + "---|" * len(titles), *others]


@dataclass(frozen=True)
class Row:
    """A row of a table of the documentation.

    Attributes:
        head: the table's headings.
        cells: the row's cells.
        made: when and on what machine the table was made, as the page says below it; empty if the page does not say.
    """

    head: list[str]
    cells: list[str]
    made: str


def find_row(page: str, mark: str, first: str, *others: str) -> Row:
    """Return the first row of a page's tables whose first cell begins so, and that has the other cells.

    Args:
        page: the page's path in `docs`.
        mark: name of the marks between which the table stands; empty for anywhere in the page.
        first: beginning of the first cell.
        others: beginnings of other cells of the row.

    Raises:
        LookupError: there is no such row.
    """
    text = (DOCS / page).read_text(encoding="utf-8")
    if mark:
        text = text.partition(f"<!-- {mark}:begin -->")[2].partition(f"<!-- {mark}:end -->")[0]
    head, rest = [], iter(text.splitlines())
    for line in rest:
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not (head and cells):
            head = cells
        elif cells[0].startswith(first) and all(any(map(_begins(one), cells[1:])) for one in others):
            made = re.search(r"^Made on (.+)\.$|on (\d+ cores \(.+\)):", "\n".join(rest), re.MULTILINE)
            return Row(head, cells, "" if made is None else made[1] or made[2])
    raise LookupError(f"{page}: no row {' & '.join((first, *others))!r} in the table {mark!r}")


def _begins(text: str) -> Callable[[str], bool]:
    return lambda cell: cell.startswith(text)


def fill(page: str, mark: str, lines: str | Iterable[str], *, dated: bool = True) -> None:
    """Write lines between the marks of some name in a page of the documentation.

    Args:
        page: the page's path in `docs`.
        mark: name of the marks.
        lines: what is to stand there.
        dated: end it with the day and the processor, as measured figures need.
    """
    begin, end = f"<!-- {mark}:begin -->\n", f"<!-- {mark}:end -->"
    text = (lines if isinstance(lines, str) else "\n".join(lines)).rstrip("\n")
    whole = f"{text}\n\n{made_on()}" if dated else text
    path = DOCS / page
    head, rest = path.read_text(encoding="utf-8").split(begin)
    path.write_text(f"{head}{begin}{whole}\n{end}{rest.split(end)[1]}", encoding="utf-8")
