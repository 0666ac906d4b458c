"""Write docs/commands.md and a page of each group of commands in docs/commands: `python docs/commands.py`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from endopilot.cli import COMMANDS, GROUPS, command_of
from endopilot.cli.options import Command, Option

PAGE = Path(__file__).with_suffix(".md")
BEGIN, END = "<!-- commands:begin -->", "<!-- commands:end -->"


def pages() -> dict[Path, str]:
    """Return the pages as they are to be: a list of all commands between the markers, and a page of each group."""
    head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    places, sections, rows = {}, dict[Path, list[str]](), ["| command | what it does |", "| --- | --- |"]
    for name, summary in COMMANDS.items():
        if name in GROUPS:
            places[name] = PAGE.with_suffix("") / (re.sub(r"\W+", "-", GROUPS[name].lower()) + ".md")
            sections[places[name]] = [f"# Commands: {GROUPS[name]}"]
        place = [*places.values()][-1]
        rows.append(f"| [`endopilot {name}`](commands/{place.name}#endopilot-{name}) | {summary} |")
        sections[place] += [f"## endopilot {name}", *_described(command_of(name))]
    contents = ["", "```{toctree}", ":hidden:", *(f"commands/{place.stem}" for place in places.values()), "```"]
    table = "\n".join([*rows, *contents])
    made = {place: "\n\n".join(parts) + "\n" for place, parts in sections.items()}
    return {PAGE: f"{head}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}"} | made


def _described(command: Command) -> Iterable[str]:
    options = command.options()
    yield command.summary
    if alone := [one for one in options if not one.group]:
        yield _table(alone)
    for group in options:
        for one in (group, *group.group):
            if one.group:
                yield f"`{one.name}` in the file: {one.meaning}"
                yield _table(leaf for leaf in one.group if not leaf.group)


def _table(options: Iterable[Option]) -> str:
    return "\n".join(["| option | takes | default | meaning |", "| --- | --- | --- | --- |", *map(_row, options)])


def _row(one: Option) -> str:
    default = one.default if one.required or not one.default else f"`{one.default}`"
    cells = (f"`{', '.join(one.flags)}`", f"`{one.takes}`" if one.takes else "", default, one.meaning)
    kind = f"{cells[1]}, {one.range}" if one.range else cells[1]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in (cells[0], kind, *cells[2:])) + " |"


if __name__ == "__main__":
    PAGE.with_suffix("").mkdir(exist_ok=True)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
