"""Figures of this checkout beside those of another one, measured in turns: `compare`.

A busy machine slows both alike, so their ratio says which is faster where neither figure by itself would.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from endopilot.errors import InputError
from endopilot.progress import progress

ROOT = Path(__file__).parents[1]


def compare(checkout: Path, name: str, options: Sequence[str], rounds: int) -> list[dict[str, Any]]:
    """Run a benchmark in another checkout and here, in turns.

    Args:
        checkout: folder of the other one, which has an environment `.venv` of its own.
        name: of the benchmark.
        options: of the benchmark.
        rounds: how many times each runs.

    Returns:
        A row for each number that both print: the medians of `theirs` and `ours`, and the median of the rounds' ratios,
        `ours_over_theirs`; None where theirs is 0.

    Raises:
        InputError: the other checkout has no environment, or the benchmark does not run in one of the two.
    """
    python = checkout.resolve() / ".venv" / "bin" / "python"
    if not python.exists():
        raise InputError(f"{checkout}: has no .venv/bin/python; `make test` makes it")
    there = ("benchmarks",) if (checkout / "benchmarks" / "__main__.py").exists() else ("endopilot.cli", "bench")
    found: dict[str, list[tuple[float, float]]] = {}
    with progress("Rounds", rounds) as advance:
        for _ in range(rounds):
            theirs = _figures([str(python), "-m", *there, name, *options], checkout)
            ours = _figures([sys.executable, "-m", "benchmarks", name, *options], ROOT)
            for figure in (figure for figure in ours if figure in theirs):
                found.setdefault(figure, []).append((theirs[figure], ours[figure]))
            advance()
    return [
        {
            "figure": figure,
            "theirs": median(one for one, _ in pairs),
            "ours": median(one for _, one in pairs),
            "ours_over_theirs": median(ours / theirs for theirs, ours in pairs) if all(t for t, _ in pairs) else None,
        }
        for figure, pairs in found.items()
    ]


def _figures(command: Sequence[str], folder: Path) -> dict[str, float]:
    """Return the numbers that a benchmark prints in a folder, each by its path in the JSON."""
    done = subprocess.run([*command, "--json"], cwd=folder, stdout=subprocess.PIPE, text=True)
    if done.returncode > 1:  # 1: a bar is not met
        raise InputError(f"{folder}: `{' '.join(command[1:])}` does not run there; its error stands above")
    return dict(_numbers(json.loads(done.stdout), ""))


def _numbers(figures: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(figures, bool):
        return
    if isinstance(figures, int | float):
        yield path, float(figures)
    parts = figures.items() if isinstance(figures, dict) else enumerate(figures) if isinstance(figures, list) else ()
    for name, part in parts:
        yield from _numbers(part, f"{path}.{name}" if path else str(name))
