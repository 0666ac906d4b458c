"""The lines that docs/concepts/troubleshooting.md quotes are lines of the source."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import endopilot

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/concepts/troubleshooting.md"


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
    rows = [line.split(" | ")[0] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    quoted = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
    for text in quoted:
        missing += [f"{part!r} of {text!r}" for part in re.split(r"\s*…\s*", text) if part not in source]
    assert len(quoted) > 30 and not missing
