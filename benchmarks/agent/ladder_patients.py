"""Choose the patients of the ladder's tasks: `python -m benchmarks ladder-patients [TASK ...]`.

The ladder gets the first twenty patients of a task's atlas that are eligible by the task's `chosen_for`. In version 2,
and from level 5 on in version 1, a search must also reach the target with a wall force below the task's limit. The
search knows the full state of the wire. It stops before each fork and tries twelve directions of the tip; a policy has
neither advantage. The training patients are the first twenty eligible ones of another atlas, without the search.

Of the coaxial tasks' atlases the first twenty eligible patients are taken in which the wire alone, pushed straight on,
arrives from at most two of eight rotations. A straight catheter goes where its wire goes: there the search must reach
the target with the wire alone. A catheter with a shape may enter what its wire does not; there nothing is searched.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import endopilot.tasks
from endopilot.atlas.atlas import make_patient_tree
from endopilot.errors import InputError
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.targets import find_target, turn_rad
from endopilot.tasks.task import (
    CORE,
    NEWEST,
    LadderVersion,
    Task,
    list_tasks,
)
from endopilot.types import TipProjection, VesselTree

TASKS = Path(endopilot.tasks.__path__[0])
WANTED = 20
MOST_EXAMINED = 800
TRIES = 12
"""Directions of the tip that the search tries at a fork."""
PUSH_MM_S, PERIOD_S = 4.0, 0.5


def _always(tree: VesselTree, truth: dict[str, Any], target: Target) -> bool:
    return True


def _turns(section: str, degrees: float) -> Callable[[VesselTree, dict[str, Any], Target], bool]:
    def eligible(tree: VesselTree, truth: dict[str, Any], target: Target) -> bool:
        first = find_target(tree, section, depth_mm=0.5).branch
        return first > 0 and np.rad2deg(turn_rad(tree, first)) >= degrees

    return eligible


def _stenosed(tree: VesselTree, truth: dict[str, Any], target: Target) -> bool:
    place = max(truth["stenoses"], key=lambda stenosis: stenosis["diameter_reduction"])
    return place["diameter_reduction"] >= 0.4 and place["abscissa_mm"] < target.abscissa - 15


ELIGIBLE: dict[str, Callable[[VesselTree, dict[str, Any], Target], bool]] = {
    "stenosis": _stenosed,
    "tortuous": lambda tree, truth, target: truth["tortuosity"] >= 2.2,
    "portal": _turns("RPPV", 45.0),
    "crux": _turns("4", 35.0),
    "diagonal": _turns("10", 40.0),
    "circumflex": _turns("11", 60.0),
    "circumflex in version 2": _turns("11", 50.0),
    "portal in version 2": _turns("RPPV", 65.0),
    "middle-cerebral in version 2": _turns("M2 superior", 50.0),
    "crux in version 2": _turns("4", 50.0),
    "diagonal in version 2": _turns("10", 50.0),
    "marginal": _turns("12", 40.0),
    "anterior-cerebral": _turns("A1", 70.0),
    "carotid": _turns("left common carotid", 90.0),
    "follow": _turns("4", 40.0),
    "steep-carotid": _turns("left common carotid", 90.0),
    "side-branch": _turns("RV", 90.0),
}


@dataclass
class _Search:
    """Worlds that try the directions of the tip at one fork after another."""

    navigation: Navigation

    def __post_init__(self) -> None:
        navigation = self.navigation
        self.simulator = Simulator(navigation.anatomy, navigation.device, worlds=TRIES, config=CORE)
        self.simulator.reset(
            inserted_length=np.full(TRIES, navigation.start_inserted_length_mm), rotation=np.zeros(TRIES)
        )
        self.deepest = float(navigation.anatomy.tree.longest_path().abscissa[-1]) + 19.0
        self.peak, self.seconds = np.zeros(TRIES), np.zeros(TRIES)

    def reachable(self) -> bool:
        """Return whether the search reached the target below the force limit and in time."""
        navigation, tree = self.navigation, self.navigation.anatomy.tree
        route = tree.route(navigation.target.branch)
        for place, branch in enumerate(route[:-1]):
            line = tree.branches[branch].centerline
            fork, radius = float(line.abscissa[-1]), float(line.radius[-1])
            before, beyond = fork - max(5.0, 1.4 * radius), fork + max(7.0, 1.6 * radius)
            self.drive(PUSH_MM_S, 0.0, 60.0, lambda tip, before=before: tip.abscissa[:, 0] >= before)
            self.drive(-PUSH_MM_S, 0.0, 5.0, lambda tip, before=before: tip.abscissa[:, 0] <= before)
            if not self.enter(route[place + 1 :], fork + 3.0, beyond):
                return False
            if self.done().any():
                return True
        self.drive(PUSH_MM_S, 0.0, 30.0, lambda tip: tip.abscissa[:, 0] > navigation.target.abscissa + 3.0)
        return bool(self.done().any())

    def enter(self, wanted: tuple[int, ...], inside: float, beyond: float) -> bool:
        """Try the directions, and copy the world that entered with the smallest force to all others, if one entered."""
        kept, peak, seconds = self.simulator.state, self.peak.copy(), self.seconds.copy()
        for attempt in range(3):
            self.simulator.set_state(kept)
            self.peak, self.seconds = peak.copy(), seconds.copy()
            if attempt == 1:
                self.drive(-PUSH_MM_S, 0.0, 1.5, _never)
            turn = ((np.arange(TRIES) + attempt / 3) / TRIES - 0.5) * 2 * np.pi
            self.drive(0.0, turn / 2.5, 2.5, _never)
            spin = np.linspace(-1.5, 1.5, TRIES) if attempt == 2 else 0.0
            self.drive(PUSH_MM_S, spin, 4.0 + (beyond - inside) / 2, lambda tip: tip.abscissa[:, 0] > beyond)
            tip = self.simulator.project()[:, 0]
            entered = (np.isin(tip.branch, wanted) & (tip.abscissa > inside)) | self.done()
            entered &= self.peak <= self.navigation.force_limit_n
            if entered.any():
                best = int(np.argmin(np.where(entered, self.peak, np.inf)))
                self.simulator.copy_worlds(np.full(TRIES, best))
                self.peak[:], self.seconds[:] = self.peak[best], self.seconds[best]
                return True
        return False

    def done(self) -> np.ndarray:
        """Return which worlds are at the target, below the force limit and in time."""
        navigation = self.navigation
        in_time = self.seconds <= navigation.seconds
        return navigation.reached(self.simulator.project()) & (self.peak <= navigation.force_limit_n) & in_time

    def drive(
        self, translation: float, rotation: float | np.ndarray, most_s: float, enough: Callable[[TipProjection], Any]
    ) -> None:
        """Drive every world until `enough` holds for it, it is at the target, or `most_s` seconds are over."""
        tip = self.simulator.project()
        still = enough(tip) | self.navigation.reached(tip)
        for _ in range(round(most_s / PERIOD_S)):
            if still.all():
                return
            inserted = self.simulator.inserted_length[:, 0]
            room = np.array([-inserted, self.deepest - inserted]) / PERIOD_S
            control = np.column_stack([np.clip(np.full(TRIES, translation), *room), np.full(TRIES, rotation)])
            step = self.simulator.step(np.where(still[:, None], 0.0, control), PERIOD_S)
            self.peak = np.where(still, self.peak, np.maximum(self.peak, step.contact_force_max))
            self.seconds += PERIOD_S * ~still
            tip = self.simulator.project()
            still |= enough(tip) | self.navigation.reached(tip)


def _never(tip: TipProjection) -> np.ndarray:
    return np.zeros(len(tip.abscissa), dtype=bool)


def wire_alone_fails(navigation: Navigation) -> bool:
    """Return whether the wire, pushed straight on, arrives from at most two of eight rotations."""
    count = 8
    simulator = Simulator(navigation.anatomy, navigation.device, worlds=count, config=CORE)
    turn = 2 * np.pi * np.arange(count) / count
    simulator.reset(inserted_length=np.full(count, navigation.start_inserted_length_mm), rotation=turn)
    longest = float(navigation.anatomy.tree.longest_path().abscissa[-1]) + 19.0
    deepest, arrived = min(navigation.target.abscissa + 20.0, longest), np.zeros(count, dtype=bool)
    for _ in range(round(deepest / (PUSH_MM_S * PERIOD_S))):
        speed = np.clip((deepest - simulator.inserted_length[:, 0]) / PERIOD_S, 0.0, PUSH_MM_S)
        simulator.step(np.column_stack([speed, np.zeros(count)]), PERIOD_S)
        arrived |= navigation.reached(simulator.project())
    return int(arrived.sum()) <= 2


def suits(navigation: Navigation) -> bool:
    """Return whether the target can be reached, and with a catheter is not by pushing its wire alone."""
    alone = replace(navigation, catheters=(), arrives="wire", start_catheter_mm=0.0)
    if navigation.catheters and not wire_alone_fails(alone):
        return False
    shaped = any(catheter.shape for catheter in navigation.catheters)
    return shaped or _Search(alone).reachable()


def choose(task: Task, seed: int, *, search: bool) -> tuple[list[int], int, int]:
    """Return the numbers of the patients wanted, how many were eligible and how many were examined."""
    atlas = task.atlas(seed)
    eligible = ELIGIBLE.get(f"{task.name} in version {task.version}", ELIGIBLE.get(task.name, _always))
    chosen: list[int] = []
    count = 0
    for number in range(MOST_EXAMINED):
        tree, truth = make_patient_tree(atlas, number)
        try:
            target = task.target(tree)
        except InputError:
            continue
        if not eligible(tree, truth, target):
            continue
        count += 1
        patients = replace(task.ladder, seed=seed, numbers=(number,))
        navigation = task.navigation(task.patient(patients, 0)) if search else None
        if navigation is None or suits(navigation):
            chosen.append(number)
            if len(chosen) == WANTED:
                return chosen, count, number + 1
    raise InputError(f"{task.name}: only {len(chosen)} of {MOST_EXAMINED} patients qualify; choose another seed")


def choose_patients(tasks: tuple[str, ...] = (), /, *, version: LadderVersion = NEWEST, write: bool = False) -> None:
    """Choose the patients of the ladder's tasks, and print their numbers.

    Args:
        tasks: names of tasks; all if none is given.
        version: of the ladder: 1, 2 or coaxial.
        write: write the numbers into the tasks' files.
    """
    for task in list_tasks(version):
        if tasks and task.name not in tasks:
            continue
        path = TASKS / f"ladder_{task.version}" / f"{task.name}.yaml"
        text = path.read_text(encoding="utf-8")
        assert task.training is not None  # as every shipped task has
        search = task.version != 1 or task.level >= 5
        for role, patients, searched in (("ladder", task.ladder, search), ("training", task.training, False)):
            chosen, eligible, examined = choose(task, patients.seed, search=searched)
            print(f"{task.name}, {role}: {WANTED} of {eligible} eligible patients, of {examined}: {chosen}", flush=True)
            pattern = rf"({role}:\n  seed: \d+\n  numbers: )\[[^\]]*\]"
            text = re.sub(pattern, lambda found, chosen=chosen: found[1] + str(chosen), text)
        if write:
            path.write_text(text, encoding="utf-8")
