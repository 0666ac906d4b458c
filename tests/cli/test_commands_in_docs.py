"""What the docs say of commands, shipped things and messages is so."""

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
from endopilot.files import read_json

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


PACKAGE = Path(endopilot.__file__).parent
PAGE = (ROOT / "docs/concepts/shipped.md").read_text(encoding="utf-8")


def test_every_file_of_data_has_a_card() -> None:
    files = [
        path for kind in ("*.json", "*.safetensors", "*.npz", "*.yaml", "*/vendor/*") for path in PACKAGE.rglob(kind)
    ]
    assert len(files) > 60
    for path in files:
        named = [path.relative_to(PACKAGE), *path.relative_to(PACKAGE).parents][:-1]
        assert any(f"`{name}`" in PAGE for name in named), path


def test_calibrations_are_of_as_many_patients_as_the_page_says() -> None:
    for path in PACKAGE.rglob("xray.json"):
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{path.relative_to(PACKAGE)}`"))
        calibration = read_json(path)
        assert f"| {calibration['anatomies']}, {calibration['intervals']} |" in row


TROUBLESHOOTING = ROOT / "docs/concepts/troubleshooting.md"


def texts() -> str:
    """Return all texts of the source, one a line, with `…` for what is put into them."""
    found = []
    for path in sorted(Path(endopilot.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_lines_that_are_quoted_exist() -> None:
    source, missing = texts(), []
    rows = [
        line.split(" | ")[0]
        for line in TROUBLESHOOTING.read_text(encoding="utf-8").splitlines()
        if line.startswith("| ")
    ]
    quoted = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
    for text in quoted:
        missing += [f"{part!r} of {text!r}" for part in re.split(r"\s*…\s*", text) if part not in source]
    assert len(quoted) > 20 and not missing
