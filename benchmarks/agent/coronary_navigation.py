"""Drive the agent into the distal thirds of coronary arteries: `python benchmarks/coronary_navigation.py PATIENT...`.

PATIENT is a folder that `endopilot anatomy` or `endopilot atlas` made. The targets lie at 5/6 of the anterior
descending, the circumflex and the right coronary artery. `--mismatch`, `--true-axis-deg`, `--seed`, `--policy`,
`--catheter`, `--arrives` and `--seconds` are those of `endopilot navigate`. Prints a row as each navigation ends, and
the share that was safe.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np

from endopilot.anatomy.io import read_anatomy
from endopilot.control.navigate_patient import NavigatePatientConfig, navigate_patient, set_up_navigation
from endopilot.tasks.navigation import Arrives
from endopilot.types import Anatomy

ARTERIES = {"LAD": ("6", "7", "8"), "LCx": ("11", "13"), "RCA": ("1", "2", "3")}
"""Sections of each artery, from its begin to its end."""
PLACE = 5 / 6


def targets(anatomy: Anatomy) -> Iterator[tuple[str, str]]:
    """Yield the name and the place of each artery's target, as `navigate` takes it."""
    tree = anatomy.tree
    for artery, names in ARTERIES.items():
        labels = [tree.section_names.index(name) for name in names if name in tree.section_names]
        ends = [
            (float(branch.centerline.abscissa[of].min()), float(branch.centerline.abscissa[of].max()), index)
            for index, branch in enumerate(tree.branches)
            if (of := np.isin(branch.section, labels)).any()
        ]
        if not ends:
            continue
        _, last, branch = max(ends, key=lambda end: end[1])
        at = min(first for first, _, _ in ends) * (1 - PLACE) + last * PLACE
        line = next(
            tree.branches[index].centerline
            for index in tree.route(branch)
            if tree.branches[index].centerline.abscissa[-1] >= at
        )
        place = [np.interp(at, line.abscissa, line.points[:, axis]) for axis in range(3)]
        yield artery, ",".join(f"{value:.3f}" for value in place)


def main() -> None:
    """Drive and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("patients", nargs="+", type=Path)
    parser.add_argument("--policy", default="agent")
    parser.add_argument("--mismatch", type=float, default=0.2)
    parser.add_argument("--true-axis-deg", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--catheter", nargs="+", default=())
    parser.add_argument("--arrives", choices=get_args(Arrives), default="wire")
    parser.add_argument("--seconds", type=float, default=60.0)
    options = vars(parser.parse_args())
    options["catheter"] = tuple(options["catheter"])
    patients, safe = options.pop("patients"), []
    print("| patient | artery | safe | reached | peak force, N | exposures | seconds | processor, s | outcome |")
    print("|---" * 9 + "|")
    for folder in patients:
        anatomy = read_anatomy(folder)
        for artery, place in targets(anatomy):
            began = time.process_time()
            done = navigate_patient(set_up_navigation(anatomy, place, NavigatePatientConfig(**options)))
            record = done.record
            safe.append(record.success and record.safe)
            print(
                f"| {folder.name} | {artery} | {safe[-1]} | {record.success} | {record.peak_force_n:.3f} | "
                f"{record.exposures} | {record.seconds:g} | {time.process_time() - began:.0f} | "
                f"{record.reason}{': ' * bool(record.gives_up)}{record.gives_up} |",
                flush=True,
            )
    print(f"\n{sum(safe)} of {len(safe)} safe ({100 * np.mean(safe):.0f} %)")


if __name__ == "__main__":
    main()
