"""A picture of a plan: the route, the tip's path, desired and predicted tip, safety ratio, force and controls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from endopilot.belief.bands import AdviserConfig
from endopilot.control.plan_config import Plan
from endopilot.control.plan_xray import PlannedXray
from endopilot.files import writing
from endopilot.plotting import CATHETER_COLORS
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

_CONTROL_COLORS = (("tab:blue", "tab:orange"), (CATHETER_COLORS[0], "tab:red"))
"""Colours of translation and rotation of the wire and of a catheter."""


def draw_plan(plan: Plan, path: Path, xray: PlannedXray | None = None) -> None:
    """Write a PNG of a plan, with the X-ray that it will need if that is known."""
    figure = plt.figure(figsize=(13, 8), facecolor="white", layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=(1.0, 1.25))
    title = f"{plan.navigation.anatomy.name}, {plan.navigation.stack.name}: {plan.config.method}"
    wire, *around = np.moveaxis(plan.trajectory.tip_position[0], 1, 0)
    draw_route(figure.add_subplot(grid[:, 0]), plan.navigation, wire, title, around)
    time_s, limit_n = DECISION_PERIOD_S * np.arange(1, len(plan.control) + 1), plan.navigation.force_limit_n
    panels = [figure.add_subplot(grid[row, 1]) for row in range(4)]
    _draw_tip(plan, time_s, panels[0])
    for axes, values, limit, color, label in (
        (panels[1], plan.ratio, AdviserConfig().wall_ratio, "tab:purple", "safety ratio\nγ/(r − r_w)"),
        (panels[2], plan.force, limit_n, "tab:red", "wall force, N"),
    ):
        axes.plot(time_s, values, color=color)
        axes.axhline(limit, color="0.4", linestyle="--", linewidth=1)
        axes.set(ylabel=label, ylim=(0, 1.1 * max(limit, float(values.max()))))
    for k, colors in enumerate(_CONTROL_COLORS[: plan.control.shape[1]]):
        for axis, unit in enumerate(("translation, mm/s", "rotation, rad/s")):
            style = {"color": colors[axis], "linestyle": ("-", "--")[k], "linewidth": 1.5 - 0.5 * k}
            label = ("", "catheter's ")[k] + unit
            panels[3].stairs(plan.control[:, k, axis], np.append(0.0, time_s), baseline=None, label=label, **style)
    panels[3].set(ylabel="control", xlabel="time, s")
    legend_above(panels[3])
    if xray is not None:
        middle, half = plan.predicted[:, 0], xray.half_width[:, 0]
        panels[0].fill_between(time_s, middle - half, middle + half, color="tab:orange", alpha=0.25, linewidth=0)
        panels[0].plot([], [], color="black", linestyle=":", linewidth=1, label="X-ray")
    for panel in panels:
        for moment in () if xray is None else time_s[xray.exposure]:
            panel.axvline(moment, color="black", linestyle=":", linewidth=1)
        panel.set_xlim(0.0, time_s[-1])
        panel.tick_params(labelbottom=panel is panels[3])
    legend_above(panels[0])
    with writing(Path(path)) as partial:
        figure.savefig(partial, dpi=90)
    plt.close(figure)


def draw_route(
    axes: Axes,
    navigation: Navigation,
    position: Float[np.ndarray, "n 3"],
    title: str,
    catheters: Sequence[Float[np.ndarray, "n 3"]] = (),
) -> None:
    """Draw the tree from the front with the route, the target and the paths of the tips, the wire's first, LPS mm."""
    tree, route = navigation.anatomy.tree, Route.to(navigation.anatomy, navigation.target)
    for branch in tree.branches:
        x, _, z = branch.centerline.points.T
        axes.plot(x, z, color="0.75", linewidth=1.5)
    ahead = route.line.abscissa <= navigation.target.abscissa
    x, _, z = route.line.points[ahead].T
    axes.plot(x, z, color="tab:green", linewidth=5, alpha=0.4, label="route")
    names = (f"tip of {catheter.name}" for catheter in navigation.catheters)
    paths = [("wire's tip" if catheters else "tip", "tab:blue", position)]
    paths += zip(names, CATHETER_COLORS, catheters, strict=False)
    for label, color, path in paths:
        axes.plot(path[:, 0], path[:, 2], ".-", color=color, linewidth=0.8, markersize=3, label=label)
    goal = navigation.target.position(navigation.anatomy)
    axes.plot(goal[0], goal[2], "*", color="tab:red", markersize=14, label="target")
    axes.set_aspect("equal")
    axes.set_xlabel("x (to the patient's left), mm")
    axes.set_ylabel("z (to the head), mm")
    axes.set_title(title)
    axes.legend(loc="best", fontsize=9)


def _draw_tip(plan: Plan, time_s: np.ndarray, axes: Axes) -> None:
    tip = plan.tip[:, 0]
    route = Route.to(plan.navigation.anatomy, plan.navigation.target)
    off_route = route.off_route(tip) > 0
    if "desired" in plan.trajectory.columns:
        axes.plot(time_s, plan.trajectory.columns["desired"][0, :, 0], color="tab:green", label="desired")
    axes.plot(time_s, plan.predicted[:, 0], color="tab:orange", linestyle="--", label="predicted by the model")
    axes.plot(time_s, tip.abscissa, color="tab:blue", linewidth=1, label="in the rod core")
    for k, color in enumerate(CATHETER_COLORS[: plan.control.shape[1] - 1], start=1):
        axes.plot(time_s, plan.tip.abscissa[:, k], color=color, linewidth=1, label="the catheter's")
    if off_route.any():
        axes.plot(time_s[off_route], tip.abscissa[off_route], "x", color="tab:red", label="in a wrong branch")
    for junction in route.junctions:
        axes.axhline(float(junction), color="0.8", linewidth=0.8, zorder=0)
    axes.set_ylabel("Δtip, mm")


def legend_above(axes: Axes) -> None:
    """Put the legend in a row above a panel, where it covers no curve."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=7, fontsize=8, frameon=False, borderaxespad=0.1)
