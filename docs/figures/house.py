"""Write lines and test times of each room into docs/evidence/house.md: `python docs/figures/house.py [TESTS.xml]`.

TESTS.xml is what `PYTEST_ADDOPTS=--junitxml=build/tests.xml make test` leaves; without it the times stay as they are.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill

ROOT = Path(__file__).parents[2]
PACKAGE, CORE, TESTS = ROOT / "src" / "endopilot", ROOT / "src" / "core", ROOT / "tests"
PAGE = "evidence/house.md"
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def counted(path: Path) -> tuple[int, int, int]:
    """Return how many lines a Python file has, how many hold code, and how many docstrings."""
    text = path.read_text(encoding="utf-8")
    documented = set[int]()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            documented |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    code = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(text.splitlines()), len(code - documented), len(documented)


def lines() -> list[str]:
    """Return the table of lines, the largest room first."""
    rooms: dict[str, list[tuple[int, int, int]]] = {}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts
        rooms.setdefault(f"`{room[0]}`" if len(room) > 1 else "at the top", []).append(counted(path))
    rooms = dict(sorted(rooms.items(), key=lambda each: -sum(count for count, _, _ in each[1])))
    rooms["package"] = [count for room in rooms.values() for count in room]
    rooms["`tests`"] = [counted(path) for path in TESTS.rglob("*.py")]
    rows = [
        f"| {room} | {' | '.join(str(sum(each)) for each in zip(*all_of, strict=True))} |"
        for room, all_of in rooms.items()
    ]
    core = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in CORE.iterdir())
    return ["| room | lines | of code | of docstrings |", "|---|---|---|---|", *rows, f"| the core, C++ | {core} | | |"]


def times(results: Path) -> list[str]:
    """Return the table of the tests' times, s of one process, the longest first."""
    tests, seconds = Counter[str](), Counter[str]()
    for case in ElementTree.parse(results).iter("testcase"):
        _, dot, rest = case.get("classname", "").partition(".")
        if not dot:  # a module that was skipped whole
            continue
        room = rest.partition(".")[0]
        room = "at the top" if room.startswith("test_") else f"`{room}`"
        tests[room] += 1
        seconds[room] += float(case.get("time", 0))
    rows = [f"| {room} | {tests[room]} | {spent:.0f} |" for room, spent in seconds.most_common()]
    total = f"| all | {sum(tests.values())} | {sum(seconds.values()):.0f} |"
    return ["| tests of | tests | seconds |", "|---|---|---|", *rows, total]


def main() -> None:
    """Fill the page."""
    fill(PAGE, "lines", lines())
    if len(sys.argv) > 1:
        fill(PAGE, "times", times(Path(sys.argv[1])))


if __name__ == "__main__":
    main()
