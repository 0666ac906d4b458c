"""Write the list of commands and their options in docs/commands.md: `python docs/commands.py`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from endopilot.cli import COMMANDS, command_of
from endopilot.cli.options import Command, Option

PAGE = Path(__file__).with_suffix(".md")
BEGIN, END = "<!-- commands:begin -->", "<!-- commands:end -->"


def page() -> str:
    """Return the page as it is to be: what stands between the markers is made of the commands themselves."""
    head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    rows = (f"| [`endopilot {name}`](#endopilot-{name}) | {summary} |" for name, summary in COMMANDS.items())
    table = "\n".join(["| command | what it does |", "| --- | --- |", *rows])
    sections = [_section(name) for name in COMMANDS]
    return f"{head}{BEGIN}\n" + "\n\n".join([table, *sections]) + f"\n{END}{rest.split(END)[1]}"


def _section(name: str) -> str:
    """Return the section about a command."""
    return "\n\n".join([f"## endopilot {name}", *_described(command_of(name))])


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
    PAGE.write_text(page(), encoding="utf-8")
