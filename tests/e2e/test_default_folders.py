"""Commands that keep results keep them apart: each default folder belongs to one command."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
LADDER = {"runs/ladder", "runs/ladder-mismatch"}
"""Where `endopilot ladder` keeps its results, and where with a model mismatch."""


def test_no_two_commands_keep_their_results_in_one_folder():
    sources = [path for folder in ("src/endopilot", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    found: dict[str, list[str]] = {}
    for path in sources:
        for name in re.findall(r'(?:Path|OutputFolder) = Path\("(runs/[\w-]+)"\)', path.read_text(encoding="utf-8")):
            found.setdefault(name, []).append(str(path))
    assert len(found) > 8 and not LADDER & found.keys()
    for name, paths in found.items():  # or in files that are named as the folder is, as the cockpit's are
        assert len(paths) == 1 or all(name.partition("/")[2] in path for path in paths), name
