"""Write what other programs make of the same input into docs/evidence/judges.md.

`python -m benchmarks judges --json > FILE; python docs/figures/judges.py FILE`; what FILE lacks stays.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill, markdown_table

if __name__ == "__main__":
    figures = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    figures.pop("skipped", None)
    for judge, rows in figures.items():
        fill("evidence/judges.md", judge, markdown_table(rows[0], [row.values() for row in rows]))
