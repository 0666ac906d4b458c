"""Measure the policies on side branches of patients of the atlas, and write the table into docs/evidence/planning.md.

`python docs/figures/planning.py` takes some minutes on one core.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.control.agent import AgentPolicy, OraclePolicy
from endopilot.devices.device import Wire, read_wire
from endopilot.navigation.loop import NavigationLoop
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import Policy
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.types import Anatomy

SEED, PATIENTS, DEEP_MM, SECONDS, FORCE_N = 900, (("rca", 0), ("lca", 0)), 15.0, 60.0, 0.3
TIPS = ((90.0, 8.0), (45.0, 3.0))
POLICIES = ("forward", "spin", "oracle", "agent")


def side_branches(anatomy: Anatomy) -> Iterator[Target]:
    """Yield a target in every branch that leaves a wider one and is long enough."""
    tree = anatomy.tree
    for index, branch in enumerate(tree.branches):
        line, others = branch.centerline, [c for c in tree.children(branch.parent) if c != index]
        middle = np.median(line.radius)
        if branch.parent < 0 or line.abscissa[-1] - line.abscissa[0] < DEEP_MM + 3:
            continue
        if any(np.median(tree.branches[other].centerline.radius) > middle for other in others):
            yield Target(branch=index, abscissa=float(line.abscissa[0]) + DEEP_MM)


def shaped(angle_deg: float, length_mm: float) -> Wire:
    """Return the workhorse with its tip shaped."""
    wire = read_wire("workhorse-014").with_tip(bend_rad=float(np.deg2rad(angle_deg)), stiffness_factor=1.0)
    return replace(wire, tip_bend_length_mm=length_mm)


def drive(name: str, navigation: Navigation, world: World) -> tuple[bool, int, float]:
    """Return safe success, exposures and processor seconds of one navigation."""
    kinds: dict[str, Policy] = {"oracle": OraclePolicy(world), "agent": AgentPolicy()}
    policy, began = kinds.get(name) or make_policy(name), time.process_time()
    record = NavigationLoop(navigation, policy, seed=1, world=world).run()
    return record.success and record.safe, record.exposures, time.process_time() - began


def measure() -> list[str]:
    """Return the rows of the table."""
    patients = [make_patient(AtlasConfig(vessel=kind, seed=SEED), number) for kind, number in PATIENTS]
    rows = ["| tip | policy | safe success | exposures | processor, s |", "|---|---|---|---|---|"]
    for angle_deg, length_mm in TIPS:
        for name in POLICIES:
            off, runs = np.random.default_rng(SEED), []
            for anatomy in patients:
                for target in side_branches(anatomy):
                    friction, stiffness, side = off.choice([-1.0, 1.0], 3)
                    world = World(
                        friction_factor=1 + 0.2 * friction,
                        tip_stiffness_factor=1 + 0.2 * stiffness,
                        ostium_mm=0.3 * side,
                    )
                    navigation = Navigation(
                        anatomy=anatomy, device=shaped(angle_deg, length_mm), target=target, seconds=SECONDS,
                        force_limit_n=FORCE_N,
                    )  # fmt: skip
                    runs.append(drive(name, navigation, world))
            good, exposures, seconds = np.array(runs, dtype=float).T
            rows.append(
                f"| {angle_deg:g}° over {length_mm:g} mm | `{name}` | {int(good.sum())} of {len(good)} | "
                f"{exposures.mean():.1f} | {seconds.mean():.1f} |"
            )
            print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    fill("evidence/planning.md", "planning", measure())
