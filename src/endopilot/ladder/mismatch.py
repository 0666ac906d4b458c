"""Scores of a policy under model mismatch: reality differs from the navigation that it is given; `measure_mismatch`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.ladder.ladder import LadderConfig, drive_one, terms_of
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.terms import Terms
from endopilot.navigation.policies import make_policy
from endopilot.runs import claim, make_missing
from endopilot.simulation.world import NOMINAL, QUANTITIES, World, drawn_sides, world_by
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import Task

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
    return world_by(change, navigation.anatomy)


def _drive_one(path: Path, *, policy: str, terms: Terms, share: float) -> None:
    task, place = terms.task(path.parent.name), int(path.stem)
    world = world_of(path.parents[1].name, share, task.ladder_navigation(place), task, place)
    drive_one(path, policy=policy, terms=replace(terms, world=world))
