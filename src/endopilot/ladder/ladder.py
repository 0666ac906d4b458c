"""The ladder: twelve tasks, each in twenty patients, or tasks of one's own, that a policy climbs (`climb`)."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, model_validator

from endopilot.devices.robot import ASSUMED, read_robot
from endopilot.files import read_json, write_json
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.ladder.scores import score
from endopilot.ladder.submission import MOST_PATIENTS, SUBMISSION_FILE, write_submission
from endopilot.ladder.terms import Terms
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.runs import claim, make_missing
from endopilot.settings import Text, Within, settings
from endopilot.simulation.world import NOMINAL, read_world
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
