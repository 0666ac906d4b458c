"""The ladder's page: scores, pictures of the tips' paths, and a replay of one navigation of each task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from endopilot.control.plan_picture import draw_route
from endopilot.files import read_json, write_whole, writing
from endopilot.ladder.attempt import begun, navigation_seed
from endopilot.ladder.ladder import SCORES_FILE
from endopilot.ladder.submission import recorded_navigation
from endopilot.ladder.terms import Terms
from endopilot.plotting import GREEN, ORANGE, STYLE, VERMILLION, png
from endopilot.report.navigation_page import mark_exposures
from endopilot.report.report import image, write_page
from endopilot.report.scene import mark_target, navigation_scene
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import Task, list_tasks

PAGE_FILE = "index.html"
SHOWN = 5  # patients of each task that the pictures show
OUTCOMES = {"safe success": GREEN, "success, but too large a force": ORANGE, "not reached": VERMILLION}


def write_ladder_page(output: Path) -> Path:
    """Write index.html and replays into a folder that `climb` has filled, and return its path; InputError without
    scores."""
    content = read_json(output / SCORES_FILE)
    terms = Terms(content["ladder"], request=content.get("request", ""), patients=content["patients"])
    tasks = [terms.task(row["task"]) for row in content["scores"] if row["level"] is not None]
    plotly = output / "plotly.min.js"
    if not plotly.exists():
        write_whole(plotly, get_plotlyjs())
    sections = [_section(output, task, content["patients"]) for task in tasks]
    write_page(
        output / PAGE_FILE,
        "ladder.html.j2",
        title=f"The ladder: {content['policy']}",
        of=len(list_tasks(content["ladder"])),
        policy=content["policy"],
        patients=content["patients"],
        scores=content["scores"],
        sections=sections,
    )
    return output / PAGE_FILE


def _section(output: Path, task: Task, patients: int) -> dict[str, Any]:
    results = [read_json(output / task.name / f"{place:02d}.json") for place in range(min(SHOWN, patients))]
    navigations = [task.ladder_navigation(place) for place in range(len(results))]
    shown = f"{len(results)} patient{'s' if len(results) > 1 else ''}"
    picture = image(png(_courses(navigations, results)), f"{task.title}: the tip's path in {shown}")
    replay = output / f"replay-{task.name}.html"
    if not replay.exists():
        figure = _replay_scene(task, navigations[0], results[0], output / task.name / "00.json")
        with writing(replay) as partial:
            figure.write_html(
                partial,
                include_plotlyjs="directory",
                auto_play=False,
                default_height="97vh",
                config={"displaylogo": False},
            )
    return {"task": task, "picture": picture, "replay": replay.name, "first": results[0]}


def _replay_scene(task: Task, navigation: Navigation, result: dict[str, Any], path: Path) -> go.Figure:
    course = result["course"]
    *_, recording = recorded_navigation(path, task.name, 0)
    record = begun(recording, navigation, seed=navigation_seed(task, 0)).run()
    figure = navigation_scene(navigation.anatomy, record.trajectory, devices=navigation.devices)
    exposed = np.array(course["exposed"])
    observed, seconds = np.array(course["tip_position"])[exposed], np.array(course["time_s"])[exposed]
    mark_target(figure, navigation.target.position(navigation.anatomy), observed, seconds)
    figures = f"{result['seconds']:g} s, {result['peak_force_n']:.2f} N, exposures: {result['exposures']}"
    title = f"{task.title}: {navigation.anatomy.name}<br><sup>{_outcome(result)}, {figures}</sup>"
    figure.update_layout(height=None, title={"text": title, "x": 0.02, "y": 0.96, "font": {"size": 18}})
    return figure


def _outcome(result: dict[str, Any]) -> str:
    if not result["success"]:
        return "not reached"
    return "safe success" if result["safe"] else "success, but too large a force"


def _courses(navigations: list[Navigation], results: list[dict[str, Any]]) -> Figure:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.4 * SHOWN, 3.2), layout="constrained")
        panels = figure.subplots(1, SHOWN, squeeze=False)[0]
        for ax, navigation, result in zip(panels, navigations, results, strict=False):
            path = np.array(result["course"]["tip_position"])
            reached = f"{_outcome(result)}\n{result['seconds']:g} s, {result['peak_force_n']:.2f} N"
            draw_route(ax, navigation, path, f"{navigation.anatomy.name}\n{reached}")
            mark_exposures(ax, path[np.array(result["course"]["exposed"])])
            ax.set_title(ax.get_title(), fontsize=8, color=OUTCOMES[_outcome(result)])
            ax.get_legend().remove()
        for ax in panels:
            ax.set_axis_off()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
