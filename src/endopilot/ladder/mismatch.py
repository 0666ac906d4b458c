"""Scores of a policy under model mismatch: reality differs from the navigation that it is given; `measure_mismatch`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from endopilot.errors import InputError
from endopilot.files import read_json, write_json, writing
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.ladder.ladder import LadderConfig, terms_of
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.terms import Terms
from endopilot.navigation.policies import make_policy
from endopilot.runs import claim, make_missing
from endopilot.simulation.world import NOMINAL, QUANTITIES, World, drawn_sides, world_by
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import Task

MISMATCH_FILE, PICTURE_FILE = "mismatch.json", "mismatch.png"
CASES = ("matched", *(f"{name}-{side}" for name in QUANTITIES for side in ("less", "more")), "all")
"""No quantity differs; one does; all do, each to a side that is drawn for the patient."""


def measure_mismatch(output: Path, config: LadderConfig, share: float) -> list[dict[str, Any]]:
    """Let a policy do tasks of the ladder under model mismatch, and score it in each case.

    Each navigation leaves one file, `output`/CASE/TASK/PATIENT.json; an interrupted run goes on with the others.

    Args:
        output: folder of the results; `mismatch.json` and `mismatch.png` in it show the scores.
        share: by which each of `QUANTITIES` differs, up and down, between 0 and 1.

    Returns:
        A row for each of `CASES`: `case`, and over all navigations what `endopilot.ladder.scores.score` gives, with
        `exposures_per_minute`.

    Raises:
        InputError: `share` is out of its range, the folder belongs to another run, or a navigation cannot be begun.
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
    navigate = partial(_navigate, policy=config.policy, terms=terms, share=share)
    make_missing(f"Model mismatch, {config.policy}", every, navigate)
    rows = []
    for case, of_case in paths.items():
        results = [read_json(path) for path in of_case]
        exposures, seconds = (sum(result[name] for result in results) for name in ("exposures", "seconds"))
        row = {"case": case, "navigations": len(results)} | score_navigations(results)
        rows.append(row | {"exposures_per_minute": round(exposures / (seconds / 60), 1)})
    with writing(output / PICTURE_FILE) as partly:
        partly.write_bytes(_picture(rows, config.policy, share))
    content = {
        "policy": config.policy,
        "ladder": config.version,
        "robot": config.robot,
        "mismatch": share,
        "tasks": [task.name for task in tasks],
    }
    most = max(len(task.ladder.numbers[: config.patients]) for task in tasks)
    write_json(output / MISMATCH_FILE, content | {"patients": most, "cases": rows})
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


def _navigate(path: Path, *, policy: str, terms: Terms, share: float) -> None:
    case, task, place = path.parents[1].name, terms.task(path.parent.name), int(path.stem)
    navigation = task.ladder_navigation(place)
    world = world_of(case, share, navigation, task, place)
    result = attempt(policy, navigation, seed=navigation_seed(task, place), terms=replace(terms, world=world))
    write_json(path, {"task": task.name, "patient": navigation.anatomy.name} | result)


def _picture(rows: list[dict[str, Any]], policy: str, share: float) -> bytes:
    import matplotlib

    from endopilot.plotting import BLUE, ORANGE, STYLE, png

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        place, names = np.arange(len(rows))[::-1], [title_of(row["case"], share) for row in rows]
        for axes, values, color, label in (
            (left, [100 * row["safe_success"] for row in rows], BLUE, "Safe success, %"),
            (right, [row["exposures"] for row in rows], ORANGE, "Exposures, mean"),
        ):
            axes.barh(place, values, color=color, height=0.65)
            for at, value in zip(place, values, strict=True):
                axes.text(value, at, f" {value:.3g}", va="center", fontsize=8)
            axes.axvline(values[0], color="black", lw=0.8, ls=(0, (4, 3)))
            axes.set(xlabel=label, xlim=(0, 1.18 * max(*values, 0.01)))
        left.set_yticks(place, names)
        figure.suptitle(f"{policy} under model mismatch", fontsize=10)
        return png(figure)


def title_of(case: str, share: float) -> str:
    """Return a case in words."""
    name, _, side = case.partition("-")
    sign = {"more": " +", "less": " −"}.get(side, ", ±")
    return case if case == "matched" else f"{name}{sign}{100 * share:g} %"
