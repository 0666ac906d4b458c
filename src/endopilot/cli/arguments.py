"""Arguments that several commands share, and how commands print."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from tyro.conf import arg

from endopilot.cli.process import one_line
from endopilot.errors import InputError
from endopilot.files import json_text

OutputFolder = Annotated[Path, arg(name="output", aliases=("-o",), metavar="DIR")]
OutputFile = Annotated[Path, arg(name="output", aliases=("-o",), metavar="FILE")]
Point = tuple[float, float, float]


def existing(path: Path) -> Path:
    """Return `path` if it is there.

    Raises:
        InputError: there is no such file or folder, or it may not be looked at.
    """
    try:
        path.stat()
    except OSError as error:
        raise InputError(f"{path}: {(error.strerror or str(error)).lower()}; check the path") from error
    return path


def show(figures: Mapping[str, Any], *, as_json: bool) -> None:
    """Print named figures as JSON or as aligned lines."""
    if as_json:
        print(_json(figures))
        return
    width = max((len(name) for name in figures), default=0)
    for name, value in figures.items():
        sentences = isinstance(value, list) and any(" " in str(item) for item in value)
        lines = [str(item) for item in value] if sentences else [_text(value)]
        for title, line in zip([name, *[""] * len(lines)], lines, strict=False):
            print(f"{title:<{width}}  {one_line(line)}")


def show_rows(rows: Sequence[Mapping[str, Any]], *, as_json: bool) -> None:
    """Print rows of the same keys as JSON or as a table."""
    if as_json:
        print(_json(list(rows)))
        return
    table = Table(*(Column(escape(name), overflow="fold") for name in (rows[0] if rows else ())))
    for row in rows:
        table.add_row(*(escape(_text(value)) for value in row.values()))
    Console(width=None if Console().is_terminal else 160).print(table)


def _json(content: Any) -> str:
    """Return content as JSON that every program reads: what is no number or infinite is null."""
    plain = json.loads(json_text(content), parse_constant=lambda _: None)
    return json_text(plain)


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
