"""Commands that README, docs and Makefile show: they are understood, and each option is one that the command knows."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import endopilot
from endopilot.cli import command_of, main
from endopilot.errors import InputError

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", "Makefile"]
PAGES += [
    str(page.relative_to(ROOT))
    for shelf in ("", "concepts", "evidence")
    for page in sorted((ROOT / "docs" / shelf).glob("*.md"))
]
GUIDE = [str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs/guide").glob("*.md"))]
"""Pages whose commands `tests/e2e/test_guide.py` runs."""
COMMAND = re.compile(r"endopilot ((?:bench )?[a-z][a-z-]*)((?: [^\n`|&;]*)?)")
OPTION = re.compile(r"(?<=\s)(--[a-z][a-z0-9-]*|-[a-z](?=\s))")


@cache
def help_of(command: str) -> str:
    from contextlib import redirect_stdout
    from io import StringIO

    out = StringIO()
    with redirect_stdout(out), pytest.raises(SystemExit):
        main([*command.split(), "--help-all"])
    return out.getvalue()


@pytest.mark.parametrize("page", PAGES + GUIDE)
def test_options_exist(page: str) -> None:
    text = re.sub(r"\\\n\s*", " ", (ROOT / page).read_text(encoding="utf-8"))
    wrong = [
        f"endopilot {command} {option}"
        for command, rest in COMMAND.findall(text)
        for option in OPTION.findall(rest)
        if not re.search(re.escape(option) + r"\b", help_of(command))
    ]
    assert not wrong


def whole_commands(page: str) -> Iterator[list[str]]:
    """Yield the arguments of the commands that stand in blocks of code, line by line, whole."""
    text = re.sub(r"\\\n\s*", " ", (ROOT / page).read_text(encoding="utf-8"))
    fenced = re.findall(r"^```(?:bash|console)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^    endopilot .*$", text, re.MULTILINE) if page == "README.md" else []
    for line in "\n".join([*fenced, *indented]).splitlines():
        for command in re.split(r"&&|;|\|| & ", line.removeprefix("$ ")):
            words = shlex.split(command, comments=True)
            if words[:1] == ["endopilot"]:
                yield [word.rstrip("&") for word in words[1:]]


def understood(arguments: list[str]) -> None:
    """Have a command's arguments parsed, and do nothing with them."""
    name, *rest = arguments
    if {"-h", "--help", "--help-all"}.isdisjoint(rest) and not name.startswith("-"):
        command_of(name).read(rest)


@pytest.mark.parametrize("page", [page for page in PAGES if page.endswith(".md")])
def test_whole_commands_are_understood(page: str, capsys, monkeypatch) -> None:
    monkeypatch.chdir(ROOT / "examples")  # where policies and methods of one's own lie that the pages name
    wrong = []
    for arguments in whole_commands(page):
        try:
            understood(arguments)
        except InputError as error:
            wrong.append(f"endopilot {shlex.join(arguments)}: {error}")
    assert not wrong


@pytest.mark.parametrize("page", [page for page in PAGES + GUIDE if page.endswith(".md")])
def test_python_imports_what_is_there(page: str) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    for node in ast.walk(ast.Module([line for block in blocks for line in ast.parse(block).body], [])):
        if isinstance(node, ast.Import | ast.ImportFrom):
            exec(ast.unparse(node), {})
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "endopilot":
            assert hasattr(endopilot, node.attr), f"{page}: endopilot.{node.attr}"


def test_some_are_found() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert sum(bool(OPTION.findall(rest)) for _, rest in COMMAND.findall(text)) > 3
    assert len(list(whole_commands("README.md"))) > 10
