"""Runs every case of the verification, draws the picture of docs/evidence/verification.md and writes its table."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill
from benchmarks.verification.plots import file_name
from benchmarks.verification.verification import bench_verification

SHOWN = (
    "elastica α=10 w/L",
    "Greenhill twist buckling M",
    "Michell ring Tw",
    "rod in a horizontal tube, helical F",
    "torque whip, snap length, mm",
    "MuJoCo, rod pushed into a bend, push, N",
)
COLUMNS = 3


def main() -> None:
    """Write docs/images/verification.png and the table between its markers in docs/evidence/verification.md."""
    with tempfile.TemporaryDirectory() as folder:
        rows = bench_verification(plots=Path(folder))
        pictures = [np.asarray(Image.open(Path(folder) / f"{file_name(name)}.png").convert("RGB")) for name in SHOWN]
    lines = [np.hstack(pictures[start : start + COLUMNS]) for start in range(0, len(pictures), COLUMNS)]
    whole = Image.fromarray(np.vstack(lines)).quantize(64)
    whole.save(DOCS / "images" / "verification.png", optimize=True)
    head = ["| case | reference | value | error | bar | passed |", "|---|---|---|---|---|---|"]
    fill("evidence/verification.md", "table", [*head, *map(_line, rows)])


def _line(row: dict[str, Any]) -> str:
    if row["passed"] is None:
        return f"| {row['case']} | | | | {row['bar']:g} | skipped |"
    figures = f"{row['reference']:.6g} | {row['value']:.6g} | {row['error']:.2g} | {row['bar']:g}"
    return f"| {row['case']} | {figures} | {'yes' if row['passed'] else '**no**'} |"


if __name__ == "__main__":
    main()
