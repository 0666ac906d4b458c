"""Commands that README, docs and Makefile show: each option of theirs is one that the command knows."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from endopilot.cli import main

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", "Makefile", "src/endopilot/models/pretrained/MODEL_CARD.md"]
PAGES += [f"docs/{page.name}" for page in sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"endopilot ((?:bench )?[a-z][a-z-]*)((?: [^\n`|&;]*)?)")
OPTION = re.compile(r"(?<=\s)(--[a-z][a-z0-9-]*|-[a-z](?=\s))")


@cache
def help_of(command: str) -> str:
    from contextlib import redirect_stdout
    from io import StringIO

    out = StringIO()
    with redirect_stdout(out), pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    return out.getvalue()


@pytest.mark.parametrize("page", PAGES)
def test_options_exist(page: str) -> None:
    text = re.sub(r"\\\n\s*", " ", (ROOT / page).read_text(encoding="utf-8"))
    wrong = [
        f"endopilot {command} {option}"
        for command, rest in COMMAND.findall(text)
        for option in OPTION.findall(rest)
        if not re.search(re.escape(option) + r"\b", help_of(command))
    ]
    assert not wrong


def test_some_are_found() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert sum(bool(OPTION.findall(rest)) for _, rest in COMMAND.findall(text)) > 3
