"""What commands take, and how they print what they return."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from tyro.conf import arg

from endopilot.cli.process import one_line
from endopilot.errors import InputError
from endopilot.files import json_text, regular
from endopilot.settings import Text, Within, settings

EXIT_FAILED = 1
Figures = Mapping[str, Any] | Sequence[Mapping[str, Any]]


def existing(path: Path) -> Path:
    """Return `path` if a file or a folder is there; InputError if not, or if it may not be looked at."""
    try:
        path.stat()
    except OSError as error:
        raise InputError(f"{path}: {(error.strerror or str(error)).lower()}; check the path") from error
    return regular(path)


def _named(path: Path, what: str, suffix: str) -> Path:
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: a {what} is written as {suffix[1:].upper()}; name it with {suffix}")
    return path


@settings
class ListenConfig:
    """Where a server listens."""

    host: Text = "127.0.0.1"
    """Address to listen on; by default only this machine can connect. 0.0.0.0 or :: for all addresses of this
    machine."""
    port: Annotated[int, Within(0, 65535)] = 0
    """TCP port; 0 for a free one."""


MUST_EXIST = "must exist"
Existing = Annotated[Path, MUST_EXIST]  # a file or folder that must be there when the command begins
IS_FOLDER, IS_FILE = "folder that is written", "file that is written"
Picture = Annotated[Path, AfterValidator(partial(_named, what="picture", suffix=".png")), IS_FILE]
Page = Annotated[Path, AfterValidator(partial(_named, what="page", suffix=".html")), IS_FILE]
OutputFolder = Annotated[Path, arg(aliases=("-o",), metavar="DIR"), IS_FOLDER]
OutputFile = Annotated[Path, arg(aliases=("-o",), metavar="FILE"), IS_FILE]


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


def show_answer(answer: Answer | Figures | None, *, as_json: bool) -> None:
    """Print what a command returns, as JSON or as text, and leave with exit code 1 if a figure misses its bar."""
    if answer is None:
        return
    full = answer if isinstance(answer, Answer) else Answer(answer)
    for part in [full.figures] if as_json or full.shown is None else full.shown:
        if isinstance(part, str):
            print(part)
        elif isinstance(part, Mapping):
            show(part, as_json=as_json)
        else:
            show_rows(part, as_json=as_json)
    if not full.passed:
        sys.exit(EXIT_FAILED)


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
    named = [escape(name.replace("_", "\n")) for name in (rows[0] if rows else ())]  # a line a word: narrow columns
    columns = (Column(name, overflow="fold", no_wrap=name == named[0]) for name in named)
    table = Table(*columns, box=None, padding=(0, 1, 0, 0))
    for row in rows:
        table.add_row(*(escape(_text(value)) for value in row.values()))
    Console(width=None if Console().is_terminal else 80).print(table)


def _json(content: Any) -> str:
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
