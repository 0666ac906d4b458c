"""How a policy does where reality is not what it was told: `measure_mismatch`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from endopilot.control.navigate import ModelMismatch
from endopilot.errors import InputError
from endopilot.files import read_json, write_json, writing
from endopilot.ladder.ladder import LadderConfig, drive, identity, summary
from endopilot.runs import claim, make_missing
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import Task, find_task

ROBUSTNESS_FILE, PICTURE_FILE = "robustness.json", "robustness.png"
QUANTITIES = ("friction", "stiffness", "latency", "ostium")
"""What is off: friction coefficient, stiffness of the tip, the robot's latency, and the place of the ostium along the
catheter's axis, the last in units of the lumen's diameter there."""
CASES = ("as-told", *(f"{name}-{way}" for name in QUANTITIES for way in ("less", "more")), "all")
"""What is told is right; one quantity is off; all are, to sides that are drawn for each patient."""


def measure_mismatch(output: Path, config: LadderConfig, off: float) -> list[dict[str, Any]]:
    """Let a policy do tasks of the ladder while reality is off from what it was told, and score it in each case.

    Each navigation leaves one file, `output`/CASE/TASK/PATIENT.json; an interrupted run goes on with the others.

    Args:
        output: folder of the results; `robustness.json` and `robustness.png` in it show the scores.
        config: what climbs.
        off: share by which each of `QUANTITIES` is off, up and down.

    Returns:
        A row for each of `CASES`: `case`, and over all navigations what `endopilot.ladder.ladder.score` gives, with
        `exposures_per_minute`.

    Raises:
        InputError: `off` is no share, the folder belongs to another run, or a navigation cannot be begun.
    """
    if not 0 < off < 1:
        raise InputError(f"off: {off} is not in (0, 1); give e.g. 0.2")
    tasks = config.chosen
    claim(output, "endopilot ladder --off", **identity(config.policy), off=off)
    paths = {
        case: [output / case / task.name / f"{place:02d}.json" for task in tasks for place in range(config.patients)]
        for case in CASES
    }
    every = [path for of_case in paths.values() for path in of_case]
    make_missing(f"Robustness, {config.policy}", every, partial(_navigate, policy=config.policy, off=off))
    rows = [{"case": case} | _scores([read_json(path) for path in paths[case]]) for case in CASES]
    with writing(output / PICTURE_FILE) as partly:
        partly.write_bytes(_picture(rows, config.policy, off))
    content = {"policy": config.policy, "off": off, "tasks": [task.name for task in tasks]}
    write_json(output / ROBUSTNESS_FILE, content | {"patients": config.patients, "cases": rows})
    return rows


def truth_of(case: str, off: float, navigation: Navigation, task: Task, place: int) -> ModelMismatch:
    """Return how reality differs from what is told, in one case and one patient."""
    share: dict[str, float] = dict.fromkeys(QUANTITIES, 0.0)
    if case == "all":
        sides = np.random.default_rng([task.ladder.seed, task.ladder.numbers[place], 1]).choice([-1.0, 1.0], 4)
        share = dict(zip(QUANTITIES, (off * sides).tolist(), strict=True))
    elif case != "as-told":
        name, way = case.split("-")
        share[name] = off if way == "more" else -off
    return ModelMismatch(
        friction_factor=1 + share["friction"],
        stiffness_factor=1 + share["stiffness"],
        latency_factor=1 + share["latency"],
        ostium_mm=share["ostium"] * 2 * float(navigation.anatomy.tree.branches[0].centerline.radius[0]),
    )


def _navigate(path: Path, *, policy: str, off: float) -> None:
    case, task, place = path.parents[1].name, find_task(path.parent.name), int(path.stem)
    navigation = task.ladder_navigation(place)
    drive(path, task, place, navigation, policy, truth_of(case, off, navigation, task, place))


def _scores(results: list[dict[str, Any]]) -> dict[str, Any]:
    minutes = sum(result["seconds"] for result in results) / 60
    exposures = sum(result["exposures"] for result in results)
    return {"navigations": len(results)} | summary(results) | {"exposures_per_minute": round(exposures / minutes, 1)}


def _picture(rows: list[dict[str, Any]], policy: str, off: float) -> bytes:
    """Draw safe success and exposures of each case."""
    import matplotlib

    from endopilot.plotting import BLUE, ORANGE, STYLE, png

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        place, names = np.arange(len(rows))[::-1], [title_of(row["case"], off) for row in rows]
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
        figure.suptitle(f"{policy}: what it is told is off", fontsize=10)
        return png(figure)


def title_of(case: str, off: float) -> str:
    """Return a case in words."""
    if case in ("as-told", "all"):
        return {"as-told": "as told", "all": f"all, ±{100 * off:g} %"}[case]
    name, way = case.split("-")
    return f"{name} {'+' if way == 'more' else '−'}{100 * off:g} %"
