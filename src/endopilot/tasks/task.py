"""The tasks of the ladder, from fixed files, in fixed synthetic patients or in anatomies of one's own; and the one that
environments start with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from endopilot.anatomy.catheter_axis import with_world_zero
from endopilot.anatomy.io import read_anatomy
from endopilot.atlas.atlas import VESSELS, AtlasConfig, make_patient
from endopilot.devices.catheter import list_catheters, read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.device_files import list_wires
from endopilot.errors import InputError
from endopilot.settings import (
    CountOrZero,
    Finite,
    NonNegative,
    Positive,
    Seconds,
    Seed,
    Share,
    Text,
    Within,
    read_settings,
    settings,
)
from endopilot.simulation.config import SimulatorConfig
from endopilot.tasks.navigation import Arrives, Navigation, Target
from endopilot.tasks.targets import find_target
from endopilot.types import Anatomy, VesselTree

CORE = SimulatorConfig(element_mm=1.25, time_step_s=1 / 14, sample_tolerance_mm=1e-4)
"""Settings of the rod core on the ladder and in the environments: longer elements, two time steps a control period,
and forces that are exact to a micronewton; docs/concepts/environments.md states the accuracy that they keep."""
DRAWN = 1 << 62
"""Seeds of test patients, which are drawn when asked, begin here: no task that lies in a file has such a seed."""
ShippedVersion = Literal[1, 2, "coaxial"]
LadderVersion = ShippedVersion | str
NEWEST: LadderVersion = 2
"""The ladder's versions: 1 in textbook patients of the atlas, 2 in patients that resemble real ones, coaxial for four
tasks of wire and catheter in patients of the latter kind; or a folder of tasks of one's own, a YAML file each."""


@settings
class Patients:
    """Patients of an atlas.

    Attributes:
        seed: of the atlas.
        numbers: of the patients in it.
    """

    seed: Seed
    numbers: Annotated[tuple[CountOrZero, ...], Field(min_length=1)]


@settings
class Task:
    """One task of the ladder.

    Attributes:
        name: short name.
        level: place on the ladder, 1 to 12, or 13 to 16 of those with a catheter; in a folder of one's own, 1 to 16.
        title: what is to be done, in a few words.
        vessel: kind of vessel tree of the atlas; none where the task has `anatomies`.
        device: shipped device, or in a folder of one's own also a device's file, seen from the task's.
        tip_bend_deg: angle to which its tip is shaped for this task, degrees.
        tip_bend_mm: length from the tip over which it is bent, mm.
        section: section that the target lies in; none where the task has `targets_mm`.
        depth_mm: distance of the target from the section's begin, along the centerline, mm; its middle if not given.
        start_inserted_length_mm: inserted length at the start, mm.
        seconds: time limit, s.
        force_limit_n: largest force of the wall on one node that is safe, N.
        stenosis_share: share of the atlas' patients that have a stenosis; 0 if not given.
        chosen_for: what makes the patients of the atlas eligible; the first eligible ones are taken.
        ladder: the patients that the ladder is scored on, which are for validation.
        training: patients of the atlas to learn on, none of them of `ladder`, if there are any.
        version: of the ladder that the task belongs to; it says which population the patients come from.
        catheter: catheter around the wire, if any, named as the device.
        arrives: whose tip is to go to the target, "wire" or "catheter"; the wire's if not given.
        start_catheter_mm: inserted length of the catheter at the start, mm; 0 if not given.
        anatomies: folders of anatomies that are the patients of `ladder`, one for each of its numbers, seen from the
            task's file. The numbers and the seed then draw the first rotations alone.
        targets_mm: a point for each of them, LPS mm, nearest to which the target lies on the centerline.
        near_mm: a straight distance from the target, mm, within which another rule counts it as reached; scored beside
            the ladder's own, and a navigation ends where both hold.
    """

    name: str
    level: Annotated[int, Within(1, 16)]
    title: str
    vessel: str | None = None
    device: str
    tip_bend_deg: Annotated[float, Within(0, 180)]
    tip_bend_mm: Positive
    section: str | None = None
    depth_mm: Positive | None = None
    start_inserted_length_mm: NonNegative
    seconds: Seconds
    force_limit_n: Positive
    stenosis_share: Share | None = None
    chosen_for: str | None = None
    ladder: Patients
    training: Patients | None = None
    version: ShippedVersion | None = None
    catheter: str | None = None
    arrives: Arrives | None = None
    start_catheter_mm: NonNegative | None = None
    anatomies: tuple[Text, ...] | None = None
    targets_mm: tuple[tuple[Finite, Finite, Finite], ...] | None = None
    near_mm: Positive | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Task:
        known = {"vessel": VESSELS, "device": list_wires(), "catheter": (*list_catheters(), None)}
        for name, choices in known.items() if self.anatomies is None else ():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: {getattr(self, name)!r}; choose from {', '.join(filter(None, choices))}")
        count = len(self.ladder.numbers)
        for name in ("anatomies", "targets_mm"):
            given = getattr(self, name)
            if given is not None and len(given) != count:
                raise ValueError(f"{name}: {len(given)} values; give one for each of ladder.numbers, {count}")
        if self.targets_mm is not None and self.anatomies is None:
            raise ValueError("targets_mm: patients of an atlas have no points of their own; give anatomies too")
        learnt = self.training if self.anatomies is None else None
        of_both = set(learnt.numbers) & set(self.ladder.numbers) if learnt else set[int]()
        if of_both and learnt and learnt.seed == self.ladder.seed:
            raise ValueError(f"training: patient {min(of_both)} is of ladder too, which nobody trains on; leave it out")
        if (self.section is None) == (self.targets_mm is None):
            raise ValueError(f"section: {self.section!r}; give either the target's section or targets_mm")
        return self

    def patient(self, patients: Patients | None, place: int) -> Anatomy:
        """Return the anatomy of one of the task's patients, by its place in the list.

        φ counts from the world's axes in it, as it always did: recorded submissions stay what they are.
        """
        if patients is None:
            raise InputError(f"training: task {self.name} has no patients to learn on; add training to its file")
        if not 0 <= place < len(patients.numbers):
            raise InputError(f"patient: {place}; task {self.name} has patients 0 to {len(patients.numbers) - 1}")
        if self.anatomies is not None and patients is self.ladder:
            return read_anatomy(self.anatomies[place])
        return _patient(self.atlas(patients.seed), patients.numbers[place])

    def atlas(self, seed: int) -> AtlasConfig:
        """Return the atlas of a seed that the task's patients come from."""
        return AtlasConfig(
            vessel=self.vessel or "",
            seed=seed,
            stenosis_share=self.stenosis_share or 0.0,
            population="textbook" if self.version == 1 else "patients",
        )

    def ladder_navigation(self, place: int) -> Navigation:
        """Return the task in one of the patients that the ladder is scored on, with its own first rotation."""
        turn = np.random.default_rng([self.ladder.seed, self.ladder.numbers[place]]).uniform(0.0, 2 * np.pi)
        point = None if self.targets_mm is None else self.targets_mm[place]
        return self.navigation(self.patient(self.ladder, place), start_rotation_rad=turn, target_mm=point)

    def target(self, tree: VesselTree) -> Target:
        """Return the target in its section of a tree, or raise `InputError` where the tree has no such place."""
        return find_target(tree, self.section or "", depth_mm=self.depth_mm)

    def navigation(
        self, anatomy: Anatomy, *, start_rotation_rad: float = 0.0, target_mm: tuple[float, ...] | None = None
    ) -> Navigation:
        """Return what is to be done in one of the task's patients, or raise `InputError` where there is no such place.

        The target lies nearest to a point, LPS mm; the task's section and depth say where if none is given.
        """
        bend = {"tip_bend_rad": float(np.deg2rad(self.tip_bend_deg)), "tip_bend_length_mm": self.tip_bend_mm}
        target = self.target(anatomy.tree) if target_mm is None else find_target(anatomy.tree, target_mm)
        return Navigation(
            anatomy=anatomy,
            device=replace(read_wire(self.device), **bend),
            target=replace(target, near_mm=self.near_mm),
            start_inserted_length_mm=self.start_inserted_length_mm,
            start_rotation_rad=start_rotation_rad,
            seconds=self.seconds,
            force_limit_n=self.force_limit_n,
            catheters=(read_catheter(self.catheter),) if self.catheter else (),
            arrives=self.arrives or "wire",
            start_catheter_mm=self.start_catheter_mm or 0.0,
        )


@lru_cache(maxsize=8)  # each takes up to 0.12 GB, and up to 20 s to draw
def _patient(atlas: AtlasConfig, number: int) -> Anatomy:
    return with_world_zero(make_patient(atlas, number))


@cache
def list_tasks(version: LadderVersion = NEWEST) -> tuple[Task, ...]:
    """Return the tasks of a version of the ladder, the lowest first, or raise `InputError` where there are none."""
    shipped = get_args(ShippedVersion)
    folder = Path(__file__).parent / f"ladder_{version}" if version in shipped else Path(str(version))
    tasks = [_read_task(path) for path in folder.glob("*.yaml")]
    if not tasks:
        known = ", ".join(map(str, shipped))
        raise InputError(f"version: {version!r}; choose from {known}, or give a folder of tasks (*.yaml)")
    return tuple(sorted(tasks, key=lambda task: task.level))


def _read_task(path: Path) -> Task:
    """Return the task of a file, with the paths of its devices and anatomies."""
    task = read_settings(path, Task)
    if any(patients is not None and patients.seed >= DRAWN for patients in (task.ladder, task.training)):
        raise InputError(f"{path}: seed: from {DRAWN} on seeds are of test patients, drawn when asked; give a smaller")
    if task.anatomies is None:
        return task
    devices = {name: path.parent / (getattr(task, name) or "") for name in ("device", "catheter")}
    beside: dict[str, Any] = {name: str(file) for name, file in devices.items() if file.is_file()}
    return replace(task, **beside, anatomies=tuple(str(path.parent / folder) for folder in task.anatomies))


def find_task(name: str, *, version: LadderVersion = NEWEST) -> Task:
    """Return a task of a version of the ladder by its name, or raise `InputError` where there is none."""
    return _named(name, list_tasks(version))


def task_by_hand(name: str) -> Task:
    """Return a task of the newest version of the ladder or of wire and catheter, or raise `InputError`."""
    return _named(name, list_tasks(NEWEST) + list_tasks("coaxial"))


def _named(name: str, tasks: Sequence[Task]) -> Task:
    for task in tasks:
        if task.name == name:
            return task
    raise InputError(f"task: {name!r}; choose from {', '.join(task.name for task in tasks)}")


def training_navigations(name: str | None, first: int, count: int, version: LadderVersion) -> list[Navigation]:
    """Return a task of the ladder in `count` of its training patients, from number `first` on.

    Without a name, all tasks of the version, one after another. A task of one's own that has no such patients is
    returned in those that it is scored on. InputError where there is no such task, or it has fewer patients.
    """
    tasks = list_tasks(version) if name is None else (find_task(name, version=version),)
    return [
        task.navigation(task.patient(task.training, place)) if task.training else task.ladder_navigation(place)
        for task in tasks
        for place in range(first, first + count)
    ]


def in_catheter(navigations: Sequence[Navigation], name: str) -> list[Navigation]:
    """Return navigations of wires alone with a catheter, named or in a YAML file, around each, whose tip is to arrive;
    InputError where there is none, or a wire does not fit into it.
    """
    catheter = read_catheter(name)
    return [replace(navigation, catheters=(catheter,), arrives="catheter") for navigation in navigations]


@lru_cache(maxsize=1)
def reference_navigation() -> Navigation:
    """Return `endopilot/Navigate-v0`'s navigation: into the posterior descending artery of the reference anatomy."""
    anatomy = _patient(AtlasConfig(population="textbook"), 0)
    return Navigation(
        anatomy=anatomy,
        device=read_wire("workhorse-014"),
        target=find_target(anatomy.tree, "4", depth_mm=15.0),
        start_inserted_length_mm=5.0,
        seconds=60.0,
    )
