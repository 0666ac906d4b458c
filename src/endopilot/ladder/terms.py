"""What the navigations of a submission have in common: `Terms`, whose `key` says what they may be compared with."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from endopilot.atlas.atlas import make_patient_tree
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.files import input_hash, json_text
from endopilot.navigation.loop import LoopConfig
from endopilot.navigation.policies import POLICIES
from endopilot.settings import from_record
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.tasks.task import CORE, DRAWN, NEWEST, LadderVersion, Patients, Task, find_task, list_tasks


@dataclass(frozen=True)
class Terms:
    """On what terms a policy climbs; nothing else than these, the policy and the kernel of linear algebra counts.

    `request` is the SHA-256 that so many `patients` of each task are drawn from; empty where the tasks' own are done.
    A decision is commanded `thinking_s` after what it was made from was observed; policies are told.
    """

    version: LadderVersion = NEWEST
    robot: RobotConfig = field(default_factory=RobotConfig)
    world: World = field(default_factory=World)
    request: str = ""
    patients: int = 0
    thinking_s: float = 0.0

    def task(self, name: str) -> Task:
        """Return a task by its name with the patients that are done, or raise `InputError` where there is none."""
        task = find_task(name, version=self.version)
        return _drawn(task, self.request, self.patients) if self.request else task

    @property
    def loop(self) -> LoopConfig:
        """Robot, C-arm and rod core of every navigation."""
        return LoopConfig(robot=self._late(self.robot), simulator=replace(CORE, threads=1))

    @property
    def reality(self) -> World:
        """World of every navigation."""
        own = self.world.robot
        return self.world if own is None else replace(self.world, robot=self._late(own))

    def _late(self, robot: RobotConfig) -> RobotConfig:
        return replace(robot, latency_s=robot.latency_s + self.thinking_s)

    def drawn(self, policy: str, origin: str, word: str, patients: int) -> Terms:
        """Return the terms with patients that are drawn from the hash of a request to run a policy of some origin.

        `word` is that of whoever runs it, so that nobody tries policies until the patients are easy.
        """
        asked = {"policy": policy, "origin": origin, "key": self.key(), "word": word, "patients": patients}
        return replace(self, request=_digest(asked), patients=patients)

    def about(self) -> dict[str, Any]:
        """Return what `of` makes the terms of again."""
        drawn = {"request": self.request, "drawn": self.patients} if self.request else {}
        drawn |= {"thinking_s": self.thinking_s}
        return {"ladder": self.version, "robot": self.robot, "world": self.world} | drawn

    @staticmethod
    def of(content: Mapping[str, Any]) -> Terms:
        """Return the terms that the content of a file names; what it leaves out is as it was in older files."""
        robot = from_record(RobotConfig, content["robot"]) if "robot" in content else RobotConfig()
        world = from_record(World, content["world"]) if "world" in content else World()
        drawn = content.get("request", ""), content.get("drawn", 0), content.get("thinking_s", 0.0)
        return Terms(content.get("ladder") or 1, robot, world, *drawn)

    def key(self) -> dict[str, Any]:
        """Return what must be equal for two scores to be compared, and what differs from the ladder's own terms."""
        usual, robot = asdict(RobotConfig()), asdict(self.robot)
        return {
            "ladder": self.version,
            "tasks": _digest(self._tasks),
            "split": "test" if self.request else "validation",
            "robot": {name: value for name, value in robot.items() if value != usual[name]},
            "world": self.world.differences(),
            "settings": _digest(_given(asdict(self.loop))),
            "decision_period_s": DECISION_PERIOD_S,
            "thinking_s": self.thinking_s,
        }

    def identity(self, policy: str) -> dict[str, Any]:
        """Return what a policy's results follow from: its source, tasks, their devices, robot and world."""
        found = {"policy": policy, "origin": POLICIES.origin(policy), "tasks": self._tasks, "robot": self.robot}
        found |= {"request": self.request} if self.request else {}
        found |= {"thinking_s": self.thinking_s} if self.thinking_s else {}
        return found | {"world": self.world.differences()}

    @property
    def _tasks(self) -> dict[str, str]:
        return {task.name: task_digest(task) for task in list_tasks(self.version)}


def task_digest(task: Task) -> str:
    """Return the SHA-256 of what a task's navigations follow from: its definition and its devices."""
    # Older tasks had no such fields, or named them otherwise: their hashes stay.
    older = {"vessel": "anatomy", "start_inserted_length_mm": "start_inserted_mm"}
    definition = {
        older.get(name, name): value
        for name, value in asdict(task).items()
        if (name, value) != ("version", 1) and value is not None
    }
    if task.anatomies is not None:
        hashes = [next(iter(input_hash(Path(folder)).values())) for folder in task.anatomies]
        definition |= {"anatomies": hashes, "device": None}  # what they hold, wherever they lie
        definition |= {"catheter": None} if task.catheter else {}
    content = json_text(definition) + json_text(read_wire(task.device))
    content += json_text(read_catheter(task.catheter)) if task.catheter else ""
    return hashlib.sha256(content.encode()).hexdigest()


@cache
def _drawn(task: Task, wanted: str, patients: int) -> Task:
    """Return a task in the first patients of an atlas of their own in which the target exists."""
    if task.anatomies is not None:
        raise InputError(f"drawn: task {task.name} has anatomies of its own; leave it out, or leave drawn out")
    seed = DRAWN + (int(_digest({"request": wanted, "task": task.name}), 16) % DRAWN)
    atlas, numbers = task.atlas(seed), list[int]()
    for number in itertools.count():
        with suppress(InputError):  # a tree without that section, or with too short a one
            task.target(make_patient_tree(atlas, number)[0])
            numbers.append(number)
        if len(numbers) == patients:
            break
    return replace(task, ladder=Patients(seed=seed, numbers=tuple(numbers)))


def _given(settings: Any) -> Any:
    """Return settings less what is empty: one that comes later then changes no older key."""
    if isinstance(settings, Mapping):
        return {name: _given(value) for name, value in settings.items() if value not in (None, (), {})}
    return [_given(value) for value in settings] if isinstance(settings, (list, tuple)) else settings


def _digest(content: Any) -> str:
    return hashlib.sha256(json_text(content).encode()).hexdigest()
