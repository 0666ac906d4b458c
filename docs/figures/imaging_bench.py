"""Runs `python -m benchmarks imaging` and writes what it measured into docs/evidence/imaging.md.

Give the number of clean cases, or 50, and that of each difficulty, or 10.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from benchmarks.imaging.cases import DIFFICULTIES
from benchmarks.imaging.segmentation import BARS, ImagingBenchConfig, bench_imaging

TITLES = {
    "dice": "Dice",
    "cldice": "clDice",
    "overlap": "centerline overlap OV",
    "inside_accuracy_mm": "inside accuracy AI, mm",
    "radius_mae_mm": "radius, mean absolute error, mm",
    "ostium_error_mm": "ostium error, mm",
    "false_length_mm": "longest false tree, mm",
}


def main() -> None:
    """Measure, and replace the tables between the page's marks."""
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else ImagingBenchConfig.cases
    found = bench_imaging(ImagingBenchConfig(cases=cases))
    lines = [
        f"`python -m benchmarks imaging --cases {cases} --seed 0`:",
        "",
        "| figure | mean ± SD | worst | worst with a result | bar | met |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, bar in BARS.items():
        row = found[name]
        limit = f"{row['counts']} {bar}"
        lines.append(
            f"| {TITLES[name]} | {row['mean']:.3f} ± {row['sd']:.3f} | {_number(row['worst'])} | "
            f"{_number(row['worst_found'])} | {limit} | "
            f"{'yes' if row['passed'] else '**no**'} |"
        )
    reasons = "; ".join(f"case {case}: {why}" for case, why in found["failed"].items()) or "none"
    lines += ["", f"Cases without a result: {reasons}."]
    _replace("bench", lines)
    _replace("difficulties", _difficulties(int(sys.argv[2]) if len(sys.argv) > 2 else 10))


def _difficulties(cases: int) -> list[str]:
    """Measure the same patients with each difficulty, and return the table."""
    lines = [
        f"`python -m benchmarks imaging --cases {cases} --seed 0 --difficulty NAME`, means of the cases with a result:",
        "",
        "| difficulty | Dice | clDice | overlap OV | ostium error, mm "
        "| wrong or none | reported | silent | false alarms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in DIFFICULTIES:
        found: dict[str, Any] = bench_imaging(ImagingBenchConfig(cases=cases, difficulty=name))
        means = [_number(found[figure]["mean_found"]) for figure in ("dice", "cldice", "overlap", "ostium_error_mm")]
        counts = [str(found[count]) for count in ("wrong", "reported", "silent", "false_alarms")]
        lines.append(f"| {' | '.join([name, *means, *counts])} |")
    return lines


def _replace(mark: str, lines: list[str]) -> None:
    """Put the lines between the page's marks of that name, and print them."""
    fill("evidence/imaging.md", mark, lines)
    print("\n".join(lines))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
