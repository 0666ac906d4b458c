"""Measures X-ray advice, calibrated with one simulation and tested with another, for docs/evidence/advice.md.

`python docs/figures/xray_otherwise.py FOLDER`: FOLDER gets patients, datasets, a twin and its advice; what is there is
kept.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.belief.advise import FIGURES_FILE
from endopilot.cli import main as endopilot
from endopilot.dataset.loader import read_dataset
from endopilot.files import read_json

MADE: dict[str, tuple[str, list[str]]] = {
    "wall": ("a compliant wall, 0.01 N/mm²", ["--compliant-wall-n-mm2", "0.01"]),
    "fast": (
        'the rod core\'s settings "fast"',
        ["--element-mm", "1.25", "--time-step-s", "0.025", "--largest-jump", "1.0"],
    ),
    "friction": ("friction of 0.2 to 0.3", ["--friction", "0.2", "0.3"]),
}
"""What is made otherwise, in words and as options of `endopilot dataset`."""


def run(*arguments: object) -> None:
    """Run a command of endopilot."""
    try:
        endopilot([str(argument) for argument in arguments])
    except SystemExit as left:
        if left.code:
            raise


def make(folder: Path) -> dict[str, Any]:
    """Make patients, datasets, the twin and its advice; return what the advice says."""
    if not (folder / "patients").exists():
        run("atlas", "-o", folder / "patients", "--count", 24, "--seed", 850)
    patients = sorted((folder / "patients").glob("rca-*"))
    shared = ["--sequences", 3, "--seed", 5, "--tip-stiffness-factor", 0.8, 1.2]
    usual = ["--friction", 0.08, 0.12]
    run("dataset", *patients, "-o", folder / "data", *shared, "--anatomy-shares", 0.2, 0.5, 0.3, *usual)
    tested = [
        folder / "patients" / name for name in sorted(set(read_dataset(folder / "data").of_split("test").anatomy))
    ]
    for name, (_, options) in MADE.items():
        friction = [] if "--friction" in options else usual
        run("dataset", *tested, "-o", folder / name, *shared, "--anatomy-shares", 0, 0, 1, *friction, *options)
    twin = ["--model", "twin", "--members", 8, "--abscissa-sd-mm", 0.2, "--offset-sd-mm", 0.15]
    run("train", folder / "data", "-o", folder / "twin", *twin)
    others = [folder / name for name in MADE]
    run("advise", folder / "twin", folder / "data", "-o", folder / "advice", "--also-test", *others)
    return read_json(folder / "advice" / FIGURES_FILE)


def _row(made: str, found: dict[str, Any]) -> str:
    cover, at = found["coverage"], found["adviser"]
    return (
        f"| {made} | {100 * cover['simultaneous']:.0f} % of {cover['intervals']} | {100 * cover['samplewise']:.1f} % "
        f"| {cover['error_mae_mm'][0]:.2f}, {cover['error_mae_mm'][1]:.3f} | {at['events_per_minute']:.1f} "
        f"| {100 * at['missed_share']:.1f} % | {at['exposures_per_minute']:.1f} |"
    )


def main() -> None:
    """Write the table in place of the one that is there."""
    found = make(Path(sys.argv[1]))
    rows = [
        "| simulated with | bands hold throughout | at samples | error of Δtip, γtip, mm | events a minute | missed "
        "| exposures a minute |",
        "|---|---|---|---|---|---|---|",
        _row("the settings of the calibration", found),
        *(_row(words, other) for (words, _), other in zip(MADE.values(), found["made_otherwise"], strict=True)),
    ]
    fill("evidence/advice.md", "otherwise", rows)


if __name__ == "__main__":
    main()
