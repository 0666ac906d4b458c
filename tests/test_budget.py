"""Rooms keep within the budgets of tests/budget.yaml; `pytest -s tests/test_budget.py` prints each beside its goal."""

from __future__ import annotations

import ast
import runpy
from collections import Counter
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "endopilot"
ROOM_MAY_EXCEED = 1.1
"""A room may hold a tenth more than its budget, the whole may not: what one room takes another gives."""


def found() -> tuple[Counter[str], Counter[str]]:
    """Return the lines of each room, and the figures of the whole."""
    counted = runpy.run_path(str(ROOT / "docs/figures/house.py"))["counted"]
    own = runpy.run_path(str(ROOT / "docs/words.py"))["own"]
    rooms, whole = Counter[str](), Counter[str]()
    for path in PACKAGE.rglob("*.py"):
        lines, code, docstrings = counted(path)
        rooms[path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else "top"] += lines
        tree = ast.parse(path.read_text(encoding="utf-8"))
        at_top = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
        whole += Counter(
            {
                "lines": lines,
                "lines of code": code,
                "lines of docstrings": docstrings,
                "numbers in the open": sum(each not in (0, 1, 2) for each in numbers(tree)),
                "module-level numbers": sum(bool(numbers(value)) for value in at_top),
            }
        )
    tests = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")]
    whole["lines of the tests"] = sum(len(text.splitlines()) for text in tests)
    pages = [page for page in (ROOT / "docs").rglob("*.md") if not {"generated", "_build"} & set(page.parts)]
    for page in pages:
        words = 0 if "commands" in (page.stem, page.parent.name) else len(own(page.read_text(encoding="utf-8")).split())
        whole["words of the docs"] += words
        whole["words of the concepts"] += words if page.parent.name == "concepts" else 0
    return rooms, whole


def numbers(tree: ast.AST) -> list[float]:
    """Return the literal numbers of some code."""
    literals = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return [value for value in literals if isinstance(value, int | float) and not isinstance(value, bool)]


@pytest.mark.skipif(not PACKAGE.exists(), reason="no source of the package is here")
def test_every_room_is_within_its_budget() -> None:
    budget = yaml.safe_load((ROOT / "tests/budget.yaml").read_text(encoding="utf-8"))
    rooms, whole = found()
    over = []
    for kind, sizes, may_exceed in (("lines", rooms, ROOM_MAY_EXCEED), ("whole", whole, 1.0)):
        assert budget[kind].keys() == sizes.keys()
        print(f"\n{'lines of' if kind == 'lines' else 'whole':22} {'now':>7} {'budget':>7} {'goal':>7}")
        for name, size in sizes.most_common():
            now, goal = budget[kind][name]
            print(f"{name:22} {size:7} {now:7} {goal:7}")
            over += [f"{name}: {size}, budget {now}"] if size > may_exceed * now else []
    assert over == []
