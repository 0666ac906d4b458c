"""What commands take, and how they print what they return."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from endopilot.cli.process import one_line
from endopilot.files import json_text

Figures = Mapping[str, Any] | Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Answer:
    """What a command returns that shows less, or more, than its figures, or whose figures miss a bar.

    Attributes:
        figures: all of them, which `--json` prints.
        shown: what is printed else, one below another; `figures` if not given.
        passed: whether the command leaves with exit code 0, and not 1.
    """

    figures: Figures
    shown: Sequence[Figures | str] | None = None
    passed: bool = True


def show(part: Figures | str, *, as_json: bool = False) -> None:
    """Print a line of text; or named figures as aligned lines and rows of the same keys as a table, or both as JSON."""
    if isinstance(part, str):
        print(part)
    elif as_json:
        print(json_text(json.loads(json_text(part), parse_constant=lambda _: None)))
    elif isinstance(part, Mapping):
        width = max((len(name) for name in part), default=0)
        for name, value in part.items():
            sentences = isinstance(value, list) and any(" " in str(item) for item in value)
            lines = [str(item) for item in value] if sentences else [_text(value)]
            for title, line in zip([name, *[""] * len(lines)], lines, strict=False):
                print(f"{title:<{width}}  {one_line(line)}")
    else:
        _show_rows(part)


def _show_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    named = [escape(name.replace("_", "\n")) for name in (rows[0] if rows else ())]  # a line a word: narrow columns
    columns = (Column(name, overflow="fold", no_wrap=name == named[0]) for name in named)
    table = Table(*columns, box=None, padding=(0, 1, 0, 0))
    for row in rows:
        table.add_row(*(escape(_text(value)) for value in row.values()))
    Console(width=None if Console().is_terminal else 80).print(table)


def _text(value: Any) -> str:
    if value is None or (isinstance(value, list | tuple | Mapping) and not value):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    return str(value)
