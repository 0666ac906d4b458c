"""Drive the agent into the distal thirds of coronary arteries: `python -m benchmarks coronary-navigation`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from endopilot.anatomy.io import read_anatomy
from endopilot.control.difficulty import Shape, expected
from endopilot.control.navigate import NavigateConfig, navigate
from endopilot.devices.stack import Stack
from endopilot.tasks.route import Route
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


def navigate_coronaries(
    patients: tuple[Path, ...],
    /,
    *,
    policy: str = "agent",
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    config: NavigateConfig = NavigateConfig(world="drawn"),
) -> None:
    """Drive a policy into the distal thirds of coronary arteries; print each navigation, and the share that was safe.

    The targets lie at 5/6 of the anterior descending, the circumflex and the right coronary artery. Beside exposures
    and seconds stand the intervals of 80 % that `endopilot difficulty` tells before.

    Args:
        patients: folders that `endopilot anatomy` or `endopilot atlas` made.
        policy: what decides.
        device: name of the wire.
        catheter: names of the catheters around it, from the inside out.
        config: limits, X-ray, and how reality differs from what the policy is given.
    """
    safe, within = [], []
    print("| patient | artery | safe | reached | peak force, N | exposures | seconds | processor, s | outcome |")
    print("|---" * 9 + "|")
    for folder in patients:
        anatomy = read_anatomy(folder)
        for artery, place in targets(anatomy):
            began = time.process_time()
            stack = Stack.of(device, *catheter)
            record = navigate(anatomy, place, policy=policy, device=stack, config=config).record
            spent = time.process_time() - began
            safe.append(record.success and record.safe)
            told = expected(Shape.of(Route.to(anatomy, anatomy.target(place))))
            cells = []
            for name in ("exposures", "seconds"):
                value, low, high = getattr(record, name), told[f"{name}_from"], told[f"{name}_to"]
                within.append(round(low) <= value <= round(high))
                cells.append(f"{value:g} ({low:.0f} to {high:.0f})")
            print(
                f"| {folder.name} | {artery} | {safe[-1]} | {record.success} | {record.peak_force_n:.3f} | "
                f"{' | '.join(cells)} | {spent:.0f} | "
                f"{record.reason}{': ' * bool(record.gives_up)}{record.gives_up} |",
                flush=True,
            )
    print(f"\n{sum(safe)} of {len(safe)} safe ({100 * np.mean(safe):.0f} %)")
    print(f"{sum(within)} of {len(within)} exposures and seconds lie in their intervals of 80 %")
