"""Runs `endopilot bench imaging` and writes what it measured into docs/imaging.md; give the number of cases, or 50."""

from __future__ import annotations

import sys
from pathlib import Path

from endopilot.benchmarks.imaging import BARS, ImagingBenchConfig, bench_imaging

PAGE = Path(__file__).parents[1] / "imaging.md"
BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"
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
    """Measure, and replace the table between the page's marks."""
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else ImagingBenchConfig.cases
    found = bench_imaging(ImagingBenchConfig(cases=cases))
    lines = [
        f"`endopilot bench imaging --cases {cases} --seed 0`:",
        "",
        "| figure | mean ± SD | worst | worst with a result | bar | met |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, bar in BARS.items():
        row = found[name]
        limit = f"{row['counts']} {'≥' if bar.at_least else '≤'} {bar.limit:g}"
        lines.append(
            f"| {TITLES[name]} | {row['mean']:.3f} ± {row['sd']:.3f} | {_number(row['worst'])} | "
            f"{_number(row['worst_found'])} | {limit} | "
            f"{'yes' if row['met'] else '**no**'} |"
        )
    reasons = "; ".join(f"case {case}: {why}" for case, why in found["failed"].items()) or "none"
    lines += ["", f"Cases without a result: {reasons}."]
    head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    page = "\n".join([f"{head}{BEGIN}", *lines, END]) + rest.split(END)[1]
    PAGE.write_text(page, encoding="utf-8")
    print("\n".join(lines))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
