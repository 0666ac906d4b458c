"""Write the tables of fields and of shipped worlds in docs/worlds.md: `python docs/worlds.py`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import docstring_parser

from endopilot.simulation.world import NOMINAL, Stenosis, World, list_worlds, read_world

PAGE = Path(__file__).with_suffix(".md")


def page() -> str:
    """Return the page as it is to be: what stands between the markers is made of the record and its files."""
    text = PAGE.read_text(encoding="utf-8")
    shipped = [f"| `{name}` | {read_world(name).about} |" for name in list_worlds() if name != NOMINAL]
    tables = {
        "fields": _fields(World()),
        "stenosis": _fields(Stenosis()),
        "shipped": ["| world | what it is |", "| --- | --- |", *shipped],
    }
    for name, rows in tables.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        head, rest = text.split(begin)
        text = f"{head}{begin}\n" + "\n".join(rows) + f"\n{end}{rest.split(end)[1]}"
    return text


def _fields(defaults: World | Stenosis) -> list[str]:
    """Return a table of the fields of settings: name, default and docstring."""
    meanings = {
        one.arg_name: one.description or "" for one in docstring_parser.parse_from_object(type(defaults)).params
    }
    rows = ["| field | as given | in reality |", "| --- | --- | --- |"]
    for each in fields(defaults):
        value, meaning = getattr(defaults, each.name), " ".join(meanings[each.name].split())
        shown = "" if value in (None, "", ()) else f"`{list(value) if isinstance(value, tuple) else value}`"
        rows.append(f"| `{each.name}` | {shown} | {meaning} |")
    return rows


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
