"""The ladder: twelve tasks, each in twenty patients, or tasks of one's own, that a policy climbs (`climb`), also where
reality differs from what it is given (`measure_mismatch`)."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, model_validator

from endopilot.devices.robot import ASSUMED, read_robot
from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.ladder.scores import score, score_navigations
from endopilot.ladder.submission import MOST_PATIENTS, SUBMISSION_FILE, write_submission
from endopilot.ladder.terms import Terms
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.runs import claim, make_missing
from endopilot.settings import Text, Within, settings
from endopilot.simulation.world import NOMINAL, QUANTITIES, World, differing, drawn_sides, read_world
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import NEWEST, LadderVersion, Task, find_task, list_tasks

SCORES_FILE = "ladder.json"


def _named(policy: Any) -> Any:
    """Return the MODULE:OBJECT of a FILE.py:OBJECT, whose folder is looked in from now on."""
    file, found, thing = policy.partition(".py:") if isinstance(policy, str) else ("", "", "")
    if not found:
        return policy
    sys.path.insert(0, str(Path(file).resolve().parent))
    return f"{Path(file).name}:{thing}"


@settings
class LadderConfig:
    """What climbs the ladder, and how much of it."""

    policy: Annotated[str, BeforeValidator(_named)] = "forward"
    """forward, spin, retract-rotate, cloned, agent, oracle, open-loop, with a catheter in-turn or catheter-alone,
    the name of a policy of an installed package, or MODULE:OBJECT or FILE.py:OBJECT of a policy of your own."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks; all if none is given."""
    patients: Annotated[int, Within(1, MOST_PATIENTS)] | None = None
    """Patients of each task, the first of its list; all if not given."""

    version: LadderVersion = NEWEST
    """Version of the ladder: 2 in patients that resemble real ones, 1 in the textbook patients of before, coaxial, four
    tasks of wire and catheter in patients as of version 2, or a folder of tasks of your own
    (docs/concepts/ladder.md)."""
    robot: str = ASSUMED
    """Name of the robot that drives (docs/concepts/robot.md), or a YAML file."""
    world: Text = NOMINAL
    """Name of the world that reality is (docs/concepts/worlds.md), or a YAML file. The policy does not know it."""
    drawn: Text | None = None
    """A word, such as the commit that brings a policy: patients that nobody has seen are drawn from the hash of word,
    policy and terms, and the policy runs in a process of its own that is handed observations alone."""
    thinking_s: Annotated[float, Within(0, 10)] = 0.0
    """Time that each decision is taken to take, s: what it decides is done so much later; 0.5 is real time for whoever
    decides within it."""

    @model_validator(mode="after")
    def _consistent(self) -> LadderConfig:
        POLICIES.check(self.policy)
        list_tasks(self.version)
        for name in self.tasks:
            find_task(name, version=self.version)
        most = max(len(task.ladder.numbers) for task in self.chosen)
        if self.patients is not None and self.patients > most:
            raise ValueError(f"patients: {self.patients}; the tasks have {most}")
        return self

    @property
    def chosen(self) -> list[Task]:
        """The tasks named, or all."""
        return [task for task in list_tasks(self.version) if not self.tasks or task.name in self.tasks]

    @property
    def patients_done(self) -> int:
        """Most patients that are done of a task."""
        return self.patients or max(len(task.ladder.numbers) for task in self.chosen)

    def paths(self, folder: Path) -> list[Path]:
        """Return the result files of the navigations in a folder, TASK/PLACE.json."""
        return [
            folder / task.name / f"{place:02d}.json"
            for task in self.chosen
            for place in range(len(task.ladder.numbers[: self.patients]))
        ]


def terms_of(config: LadderConfig) -> Terms:
    """Return on what terms a policy climbs, or raise `InputError` where there is no such robot or world."""
    robot, world = read_robot(config.robot), read_world(config.world)
    terms = Terms(config.version, robot, world, thinking_s=config.thinking_s)
    if config.drawn is None:
        return terms
    return terms.drawn(config.policy, POLICIES.origin(config.policy), config.drawn, config.patients_done)


def climb(*, output: str | Path, config: LadderConfig | None = None) -> list[dict[str, Any]]:
    """Let a policy do the tasks in their patients, and score it.

    Each navigation leaves one file, `output`/TASK/PATIENT.json; an interrupted run goes on with the others.
    `ladder.json` holds the scores, `submission.json` what others need to confirm them. The rows of
    `endopilot.ladder.scores.score` are returned. InputError where the folder belongs to another run, such as that of
    another policy, or a navigation cannot be begun.
    """
    config = config or LadderConfig()
    output = Path(output)
    make_policy(config.policy)
    terms = terms_of(config)
    claim(output, "endopilot ladder", **terms.identity(config.policy))
    paths = config.paths(output)
    make_missing(f"Ladder, {config.policy}", paths, partial(drive_one, policy=config.policy, terms=terms))
    tasks = config.chosen
    results = {task.name: [read_json(path) for path in paths if path.parent.name == task.name] for task in tasks}
    rows = score(tasks, results)
    content = {"policy": config.policy, "ladder": config.version, "robot": config.robot, "key": terms.key()}
    content |= {"world": {"name": config.world, **terms.world.differences()}, "patients": config.patients_done}
    content |= {"scores": rows}
    content |= {"request": terms.request} if terms.request else {}
    write_json(output / SCORES_FILE, content)
    write_submission(output / SUBMISSION_FILE, config.policy, terms, results, rows, drawn=config.drawn)
    return rows


def drive_one(path: Path, *, policy: str, terms: Terms) -> None:
    """Let a policy do the navigation of a result file, TASK/PLACE.json, and write the file."""
    task, place = terms.task(path.parent.name), int(path.stem)
    navigation = task.ladder_navigation(place)
    result = attempt(policy, navigation, seed=navigation_seed(task, place), terms=terms)
    write_json(path, {"task": task.name, **terms.about(), "patient": navigation.anatomy.name} | result)


MISMATCH_FILE = "mismatch.json"
CASES = ("matched", *(f"{name}-{side}" for name in QUANTITIES for side in ("less", "more")), "all")
"""No quantity differs; one does; all do, each to a side that is drawn for the patient."""


def measure_mismatch(output: Path, config: LadderConfig, share: float) -> list[dict[str, Any]]:
    """Let a policy do tasks of the ladder under model mismatch, and score it in each case.

    Each of `QUANTITIES` differs by `share`, up and down, between 0 and 1; files and errors are those of `climb`, one
    folder a case. A row for each of `CASES` is returned, and stands in `output`/mismatch.json: over all navigations
    what `score_navigations` gives.
    """
    if not 0 < share < 1:
        raise InputError(f"mismatch: {share} is not in (0, 1); give e.g. 0.2")
    if config.world != NOMINAL or config.drawn:
        raise InputError(f"world: {config.world}; mismatch makes worlds of its own and draws none: leave both out")
    make_policy(config.policy)
    tasks = config.chosen
    terms = terms_of(config)
    claim(output, "endopilot ladder --mismatch", **terms.identity(config.policy), mismatch=share)
    paths = {case: config.paths(output / case) for case in CASES}
    every = [path for of_case in paths.values() for path in of_case]
    navigate = partial(_drive_one, policy=config.policy, terms=terms, share=share)
    make_missing(f"Model mismatch, {config.policy}", every, navigate)
    rows = []
    for case, of_case in paths.items():
        results = [read_json(path) for path in of_case]
        rows.append({"case": case, "navigations": len(results)} | score_navigations(results))
    content = {"policy": config.policy, "ladder": config.version, "robot": config.robot, "mismatch": share}
    content |= {"tasks": [task.name for task in tasks], "patients": config.patients_done, "cases": rows}
    write_json(output / MISMATCH_FILE, content)
    return rows


def world_of(case: str, share: float, navigation: Navigation, task: Task, place: int) -> World:
    """Return what reality is in one case and one patient."""
    change = {}
    if case == "all":
        change = drawn_sides(share, np.random.default_rng([task.ladder.seed, task.ladder.numbers[place], 1]))
    elif case != "matched":
        name, side = case.split("-")
        change = {name: share if side == "more" else -share}
    return differing(change, navigation.anatomy, World())


def _drive_one(path: Path, *, policy: str, terms: Terms, share: float) -> None:
    task, place = terms.task(path.parent.name), int(path.stem)
    world = world_of(path.parents[1].name, share, task.ladder_navigation(place), task, place)
    drive_one(path, policy=policy, terms=replace(terms, world=world))
