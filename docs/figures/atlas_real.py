"""Write docs/evidence/atlas.md's table of real patients beside the atlas: `python docs/figures/atlas_real.py FOLDER`.

The folder holds the anatomies that `endopilot anatomy` made of the seven real patients' masks (`../shared/data`).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.anatomy.compare import KINDS, Values, anatomy_folders, scaled_distance, together
from benchmarks.anatomy.vessel_shape import vessel_shape
from benchmarks.figures import fill
from endopilot.anatomy.io import read_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_atlas

ATLAS = {
    "patients": AtlasConfig(count=30),
    "textbook": AtlasConfig(count=30, population="textbook"),
}
NINETEEN = {
    "rca": ("0.17 [0.10–0.25]", "0.9 [0–4.3]", "0.52 [0.31–1.00]", "0.138", "739 [373–1050]", "1.30 [1.14–1.54]",
            "52 [22–97]", "19 [5–53]", "0.71", "0.042", "34 [11–71]", "4 [1–5]"),
    "lca": ("0.12 [0.09–0.28]", "0 [0–4.2]", "0.39 [0.29–0.62]", "0.164", "414", "1.10 [1.05–1.36]", "44 [20–84]",
            "23 [7–48]", "0.78", "0.038", "28 [13–53]", "5 [3–8]", "48 [31–65]", "26 [9–62]", "76 [51–98]",
            "4.9 [1–15]", "2.6"),
}  # fmt: skip
"""What another program measured on 14 right and 16 left coronary arteries of 19 patients, in the table's order."""


def spread(values: list[float]) -> str:
    """Return median and 5th to 95th percentile."""
    if not values:
        return "–"
    low, middle, high = (f"{value:.3g}" for value in np.quantile(values, (0.05, 0.5, 0.95)))
    return f"{middle} [{low}–{high}]"


def rows(kind: str, given: Values) -> list[str]:
    """Return the table's rows of one kind of tree."""
    drawn = {
        name: together(vessel_shape(anatomy) for anatomy in make_atlas(config=replace(config, vessel=kind)))
        for name, config in ATLAS.items()
    }
    lines = []
    for quantity, nineteen in zip(given, NINETEEN[kind], strict=True):
        cells = [kind, quantity, nineteen, spread(given[quantity])]
        for values in drawn.values():
            away = scaled_distance(given[quantity], values[quantity])
            cells.append(f"{spread(values[quantity])}; {'–' if away is None else f'{away:.2f}'}")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Write the table."""
    anatomies = [read_anatomy(folder) for folder in anatomy_folders([Path(sys.argv[1])])]
    titles = ["vessel", "quantity", "19 patients", "7 patients", *(f"{name}; distance to the 7" for name in ATLAS)]
    lines = ["| " + " | ".join(titles) + " |", "|" + " --- |" * len(titles)]
    for kind in NINETEEN:
        given = together(vessel_shape(one) for one in anatomies if one.tree.section_names == KINDS[kind])
        lines += rows(kind, given)
    fill("evidence/atlas.md", "real", lines)


if __name__ == "__main__":
    main()
