"""Makes the navigations from which `endopilot difficulty` tells what a patient will take.

`python docs/figures/difficulty.py RUN`: RUN is a folder of `endopilot ladder --policy agent`, version 2.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import astuple, fields
from pathlib import Path

import endopilot.control.difficulty as module
from endopilot.files import read_json
from endopilot.tasks.route import Route
from endopilot.tasks.task import find_task

COLUMNS = ("task", "place", *(field.name for field in fields(module.Shape)), "exposures", "seconds")


def main(run: str) -> None:
    """Write the file beside the module that reads it."""
    with Path(module.__file__).with_name(module.NAVIGATIONS_FILE).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for path in sorted(Path(run).glob("*/[0-9][0-9].json")):
            result, name, place = read_json(path), path.parent.name, int(path.stem)
            navigation = find_task(name, version=2).ladder_navigation(place)
            length_mm, turning_deg, forks = astuple(module.Shape.of(Route.to(navigation.anatomy, navigation.target)))
            shape = (f"{length_mm:.2f}", f"{turning_deg:.1f}", forks)
            table.writerow((name, place, *shape, result["exposures"], result["seconds"]))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
