"""The ladder: twelve tasks, each in twenty patients, that a policy climbs; its score is safe success."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot import __version__
from endopilot.anatomy.projection import safety_ratio
from endopilot.control.agent import AgentPolicy
from endopilot.control.navigate import ModelMismatch, NavigateConfig, NavigationRecord, navigate
from endopilot.control.policies import POLICIES, make_policy
from endopilot.control.policy import Decision, Observation
from endopilot.errors import InputError
from endopilot.files import json_text, read_json, write_json
from endopilot.runs import claim, make_missing
from endopilot.simulation.device import read_device
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import CORE, Task, find_task, ladder_tasks
from endopilot.types import TipProjection
from endopilot.xray.adviser import AdviserConfig, count_events, near_exposures

SCORES_FILE = "ladder.json"
UPPER = range(5, 13)
"""Levels of the upper eight tasks, which pushing alone must not solve."""


@dataclass(frozen=True, kw_only=True)
class LadderConfig:
    """What climbs the ladder, and how much of it."""

    policy: str = "forward"
    """Name of the policy."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks; all if none is given."""
    patients: int = 20
    """Patients of each task, the first of its list."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: no such policy or task, or more patients than there are.
        """
        POLICIES.check(self.policy)
        for name in self.tasks:
            find_task(name)
        if not 1 <= self.patients <= 20:
            raise InputError(f"patients: {self.patients}; give 1 to 20")

    @property
    def chosen(self) -> list[Task]:
        """The tasks named, or all."""
        return [task for task in ladder_tasks() if not self.tasks or task.name in self.tasks]


def climb(output: Path, config: LadderConfig) -> list[dict[str, Any]]:
    """Let a policy do the tasks in their patients, and score it.

    Each navigation leaves one file, `output`/TASK/PATIENT.json; an interrupted run goes on with the others.

    Args:
        output: folder of the results; `ladder.json` in it holds the scores.
        config: what climbs.

    Returns:
        A row a task and then rows over several tasks, see `score`.

    Raises:
        InputError: the folder belongs to another run, such as that of another policy, or a navigation cannot be begun.
    """
    tasks = config.chosen
    claim(output, "endopilot ladder", **identity(config.policy))
    paths = [output / task.name / f"{place:02d}.json" for task in tasks for place in range(config.patients)]
    make_missing(f"Ladder, {config.policy}", paths, partial(_navigate, policy=config.policy))
    results = {task.name: [read_json(path) for path in paths if path.parent.name == task.name] for task in tasks}
    rows = score(tasks, results)
    write_json(output / SCORES_FILE, {"policy": config.policy, "patients": config.patients, "scores": rows})
    return rows


def score(tasks: Sequence[Task], results: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the scores of tasks, and over the lower four, the upper eight and all, where all of these were done.

    Each row has `level`; `task`; `safe_success`, the share of navigations that reached the target with a wall force
    that never exceeded the task's limit; `success`, the share that reached it; of those that did, the medians of
    `seconds` and `path_ratio` (length of the tip's path over that of the centerline); and of all the median of
    `peak_force_n` (N) and the mean of `exposures`. Rows of `agent` have `missed_events`, the share of the events of all
    their navigations that X-ray did not show (docs/xray.md).
    """
    rows = [{"level": task.level, "task": task.name} | summary(results[task.name]) for task in tasks]
    levels = {task.level: task.name for task in tasks}
    for title, wanted in (("lower four", range(1, 5)), ("upper eight", UPPER), ("all twelve", range(1, 13))):
        if all(level in levels for level in wanted):
            together = [result for level in wanted for result in results[levels[level]]]
            rows.append({"level": None, "task": title} | summary(together))
    return rows


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the scores of some navigations together, see `score`."""
    reached = [result for result in results if result["success"]]

    def median(name: str, of: list[dict[str, Any]], digits: int) -> float | None:
        return round(float(np.median([result[name] for result in of])), digits) if of else None

    events = [result["events"] for result in results if "events" in result]
    missed = round(sum(unseen for _, unseen in events) / max(sum(count for count, _ in events), 1), 4)
    return {
        "safe_success": round(float(np.mean([result["success"] and result["safe"] for result in results])), 4),
        "success": round(len(reached) / len(results), 4),
        "seconds": median("seconds", reached, 1),
        "path_ratio": median("path_ratio", reached, 3),
        "peak_force_n": median("peak_force_n", results, 4),
        "exposures": round(float(np.mean([result["exposures"] for result in results])), 1),
        **({"missed_events": missed} if len(events) == len(results) else {}),
    }


def identity(policy: str) -> dict[str, Any]:
    """Return what a policy's results follow from: its source, every task with its device, and the package's version."""
    tasks = {task.name: _digest(task) for task in ladder_tasks()}
    return {"policy": policy, "origin": POLICIES.origin(policy), "tasks": tasks, "version": __version__}


def _digest(task: Task) -> str:
    content = task.model_dump_json() + json_text(read_device(task.device))
    return hashlib.sha256(content.encode()).hexdigest()


def _navigate(path: Path, *, policy: str) -> None:
    """Do one navigation and write what came of it."""
    task, place = find_task(path.parent.name), int(path.stem)
    drive(path, task, place, task.ladder_navigation(place), policy, ModelMismatch())


def drive(path: Path, task: Task, place: int, navigation: Navigation, policy: str, truth: ModelMismatch) -> None:
    """Let a policy do a task in the patient at some place of its list, and write what came of it to a file."""
    config = NavigateConfig(simulator=replace(CORE, threads=1))
    climber = make_policy(policy)
    watched = _Watched(climber) if isinstance(climber, AgentPolicy) else None
    record = navigate(navigation, watched or climber, config=config, seed=100 * task.level + place, truth=truth)
    result = _result(navigation, record)
    if watched is not None:
        foretold, radius = np.array(watched.abscissa), navigation.device.tip_radius_mm
        result["events"] = _events(record.tip, record.exposed, foretold, radius)
    write_json(path, {"task": task.name, "patient": navigation.anatomy.name} | result)


class _Watched:
    """The agent, and where it held the tip to be (Δtip, mm) at each decision."""

    def __init__(self, agent: AgentPolicy) -> None:
        self._agent = agent

    def start(self, navigation: Navigation, seed: int) -> None:
        self._agent.start(navigation, seed)
        self.abscissa: list[float] = []

    def decide(self, observation: Observation) -> Decision:
        decision = self._agent.decide(observation)
        self.abscissa.append(float(self._agent.belief.likeliest_tip().abscissa[0]))
        return decision


def _events(
    tip: TipProjection,
    exposed: Bool[np.ndarray, "samples"],
    foretold_mm: Float[np.ndarray, "decisions"],
    wire_radius_mm: float,
) -> tuple[int, int]:
    """Return how many events a navigation had, as `AdviserConfig` defines them, and how many were missed."""
    count, advice = len(foretold_mm), AdviserConfig()
    wall = safety_ratio(tip.offset, tip.radius, wire_radius_mm)[:count] >= advice.wall_ratio
    off = np.abs(foretold_mm - tip.abscissa[:count]) >= advice.abscissa_mm
    found = np.array([count_events(state, near_exposures(exposed[:count])) for state in (wall, off)])
    return int(found[:, 0].sum()), int(found[:, 1].sum())


def _result(navigation: Navigation, record: NavigationRecord) -> dict[str, Any]:
    """Return the figures of a navigation, and its course."""
    way = navigation.target.abscissa - float(record.tip.abscissa[0])
    return {
        "success": record.success,
        "safe": record.safe,
        "reason": record.reason,
        "seconds": record.seconds,
        "path_ratio": record.path_mm / way,
        "peak_force_n": record.peak_force_n,
        "exposures": record.exposures,
        "course": {
            "time_s": record.time_s.tolist(),
            "inserted_length": record.inserted_length.round(4).tolist(),
            "rotation": record.rotation.round(4).tolist(),
            "tip_position": record.tip_position.round(3).tolist(),
            "contact_force_max": record.contact_force_max.round(5).tolist(),
            "exposed": record.exposed.tolist(),
        },
    }
