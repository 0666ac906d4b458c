"""Writes what advice misses and costs with images and motion into docs/evidence/advice.md.

`python docs/figures/advice_conditions.py FOLDER`: FOLDER/advice holds what the commands beside the table make, one
folder for each model and condition, such as `twin-both-images`; a row is written for each that is there.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.belief.advise import FIGURES_FILE
from endopilot.files import read_json

MODELS = {"pretrained": "`pretrained`", "twin": "twin of 8 wires"}
CONDITIONS = {
    "still-assumed": "assumed errors, patients at rest",
    "still-images": "images and registration",
    "both-assumed": "heart and breath",
    "both-images": "all together",
}
"""By motion and `--xray`, in words."""


def row(model: str, condition: str, found: dict[str, Any]) -> str:
    """Return the row of one `advice.json`."""
    cover, at = found["coverage"], found["adviser"]
    return (
        f"| {model} | {condition} | {100 * cover['simultaneous']:.0f} % of {cover['intervals']} "
        f"| {cover['error_mae_mm'][0]:.2f}, {cover['error_mae_mm'][1]:.3f} "
        f"| {cover['median_half_width_mm'][0]:.2f}, {cover['median_half_width_mm'][1]:.2f} "
        f"| {at['events_per_minute']:.1f} | {100 * at['missed_share']:.1f} % | {at['exposures_per_minute']:.1f} "
        f"| {found['share_of_the_exposures_of_periodic_imaging']:.2f} |"
    )


def main() -> None:
    """Write the table in place of the one that is there."""
    folder = Path(sys.argv[1]) / "advice"
    lines = [
        "| model | exposures and patients | bands hold throughout | error of Δtip, γtip, mm | median half-widths, mm "
        "| events a minute | missed | exposures a minute | of periodic imaging's |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, model in MODELS.items():
        for condition, words in CONDITIONS.items():
            path = folder / f"{name}-{condition}" / FIGURES_FILE
            if path.exists():
                lines.append(row(model, words, read_json(path)))
    lines.append("| bar | | 87 to 93 % | | | | ≤ 5 % | | ≤ 0.33 |")
    fill("evidence/advice.md", "advice-conditions", lines)


if __name__ == "__main__":
    main()
