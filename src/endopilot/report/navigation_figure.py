"""A picture of a navigation: paths of the tips, Δtip with what was believed, safety ratio, forces, controls, X-ray."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.adviser import AdviserConfig
from endopilot.control.navigate import PatientNavigation
from endopilot.control.plan_picture import draw_route, legend_above
from endopilot.plotting import BLACK, BLUE, CATHETER_COLORS, GREY, ORANGE, PURPLE, STYLE, VERMILLION
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.tasks.route import Route
from endopilot.tasks.targets import section_at

_DEVICE_COLORS = (BLUE, *CATHETER_COLORS)
_LABEL_SHARE = 0.06
"""Labels of forks are this share of the axis apart, at least."""


def navigation_figure(found: PatientNavigation) -> Figure:
    """Draw a navigation."""
    with mpl.rc_context(STYLE):
        navigation, record = found.set_up.navigation, found.record
        heights = (2.0, 1.0, 1.0, *((1.0,) if navigation.catheters else ()), 0.8, 0.8)
        figure = Figure(figsize=(13, 1.875 * sum(heights)), layout="constrained", facecolor="white")
        grid = figure.add_gridspec(len(heights), 2, width_ratios=(1.0, 1.35), height_ratios=heights)
        title = f"{navigation.anatomy.name}, seen from the front"
        left = figure.add_subplot(grid[:, 0])
        wire, *around = np.moveaxis(record.tip_position, 1, 0)
        draw_route(left, navigation, wire, title, around)
        _mark_sections(left, found)
        panels = [figure.add_subplot(grid[row, 1]) for row in range(len(heights))]
        _draw_tip(panels[0], found)
        _draw_safety(panels[1], found)
        _draw_force(panels[2], found)
        if navigation.catheters:
            _draw_pushes(panels[3], found)
        _draw_controls(panels[-2:], found)
        _finish(panels, found)
        return figure


def _mark_sections(axes: Axes, found: PatientNavigation) -> None:
    """Write each section's name once, at the middle of its longest piece."""
    tree = found.set_up.navigation.anatomy.tree
    longest: dict[str, np.ndarray] = {}
    for branch in tree.branches:
        for section in np.unique(branch.section):
            piece = branch.centerline.points[branch.section == section]
            name = tree.section_names[int(section)]
            if len(piece) > len(longest.get(name, ())):
                longest[name] = piece
    for name, piece in longest.items():
        x, _, z = piece[len(piece) // 2]
        axes.annotate(name, (x, z), textcoords="offset points", xytext=(5, 4), fontsize=9, color="0.35")
    shown = found.record.tip_position[found.record.exposed, 0]
    axes.plot(shown[:, 0], shown[:, 2], "o", mfc="none", color=BLACK, markersize=6, label="tip under X-ray")
    axes.legend(loc="best", fontsize=9)


def _draw_tip(axes: Axes, found: PatientNavigation) -> None:
    record, navigation = found.record, found.set_up.navigation
    time_s, wire_tip = record.time_s, record.tip[:, 0]
    if record.believed is not None and record.half_width is not None:
        middle, half = record.believed[:, 0], record.half_width[:, 0]
        axes.plot(time_s, middle, color=ORANGE, linestyle="--", label="believed")
        axes.fill_between(time_s, middle - half, middle + half, color=ORANGE, alpha=0.25, linewidth=0, label="band")
    around = found.set_up.navigation.catheters
    axes.plot(time_s, wire_tip.abscissa, color=BLUE, label="wire's tip" if around else "true")
    names = ("catheter's tip", "outer catheter's tip")
    for name, color, abscissa in zip(names, CATHETER_COLORS, record.tip.abscissa[:, 1:].T, strict=False):
        axes.plot(time_s, abscissa, color=color, label=name)
    off = Route.to(navigation.anatomy, navigation.target).off_route(wire_tip) > 0
    if off.any():
        axes.plot(time_s[off], wire_tip.abscissa[off], "x", color=VERMILLION, label="in a wrong branch")
    seen = [(t, tip.abscissa) for t, tip in zip(time_s, record.measured, strict=True) if tip is not None]
    axes.plot(*np.array(seen).reshape(-1, 2).T, "o", mfc="none", color=BLACK, markersize=5, label="measured by X-ray")
    route, tree = Route.to(navigation.anatomy, navigation.target), navigation.anatomy.tree
    span, last = float(np.ptp(np.append(wire_tip.abscissa, navigation.target.abscissa))), -np.inf
    for junction in route.junctions:
        axes.axhline(float(junction), color="0.75", linewidth=0.8, zorder=0)
        section = section_at(tree, int(route.branch(np.array([junction + 1e-3]))[0]), float(junction) + 1.0)
        if junction - last < _LABEL_SHARE * span:
            continue  # its label would cover the one below
        last = junction
        axes.annotate(f"fork into {section}", (1.0, junction), xycoords=("axes fraction", "data"), fontsize=7.5,
                      ha="right", va="bottom", color="0.45")  # fmt: skip
    axes.axhline(navigation.target.abscissa, color=VERMILLION, linestyle=":", linewidth=1.2, label="target")
    axes.set_ylabel("tip along the\nvessel Δtip, mm")
    legend_above(axes)


def _draw_safety(axes: Axes, found: PatientNavigation) -> None:
    record = found.record
    tip, radius = record.tip[:, 0], found.set_up.navigation.device.tip_radius_mm
    ratio = safety_ratio(tip.offset, tip.radius, radius)
    axes.plot(record.time_s, ratio, color=PURPLE)
    axes.axhline(1.0, color=GREY, linewidth=1)
    axes.annotate("wall", (1.0, 1.0), xycoords=("axes fraction", "data"), fontsize=7.5, ha="right", va="bottom")
    axes.axhline(AdviserConfig().wall_ratio, color=GREY, linestyle="--", linewidth=1)
    axes.set_ylim(0, 1.15 * max(1.0, float(ratio.max())))
    axes.set_ylabel("safety ratio\nγ/(r − r_w)")


def _draw_force(axes: Axes, found: PatientNavigation) -> None:
    record, limit = found.record, found.set_up.navigation.force_limit_n
    axes.step(record.time_s, record.contact_force_max, where="pre", color=VERMILLION)
    axes.axhline(limit, color=GREY, linestyle="--", linewidth=1)
    axes.annotate(f"limit {limit:g} N", (1.0, limit), xycoords=("axes fraction", "data"), fontsize=7.5, ha="right",
                  va="bottom")  # fmt: skip
    axes.set_ylim(0, 1.25 * max(limit, record.peak_force_n))
    axes.set_ylabel("largest wall\nforce, N")


def _draw_pushes(axes: Axes, found: PatientNavigation) -> None:
    """Draw how hard each drive pushes, or pulls below zero."""
    rollout = found.record.trajectory
    time_s = DECISION_PERIOD_S * np.arange(1, rollout.drive_force.shape[1] + 1)
    pushes = rollout.drive_force[0].T
    for device, color, push in zip(found.set_up.navigation.devices, _DEVICE_COLORS, pushes, strict=False):
        axes.plot(time_s, push, color=color, label=device.name)
    axes.axhline(0.0, color="0.75", linewidth=0.8, zorder=0)
    axes.set_ylabel("push of\nthe drive, N")
    legend_above(axes)


def _draw_controls(panels: list[Axes], found: PatientNavigation) -> None:
    control, time_s = found.record.control, found.record.time_s
    for axes, axis, color, label in (
        (panels[0], 0, BLUE, "translation,\nmm/s"),
        (panels[1], 1, ORANGE, "rotation,\nrad/s"),
    ):
        axes.step(time_s, control[:, 0, axis], where="post", color=color)
        for catheter_color, speed in zip(CATHETER_COLORS, control[:, 1:, axis].T, strict=False):
            axes.step(time_s, speed, where="post", color=catheter_color, linewidth=1.4)
        axes.axhline(0.0, color="0.75", linewidth=0.8, zorder=0)
        axes.set_ylabel(label)


def _finish(panels: list[Axes], found: PatientNavigation) -> None:
    """Draw when X-ray was on, and one axis of time under all panels."""
    record = found.record
    for panel in panels:
        for moment in record.time_s[record.exposed]:
            panel.axvline(moment, color=BLACK, linestyle=":", linewidth=1)
        panel.set_xlim(0.0, max(float(record.time_s[-1]), 0.5))
        panel.grid(visible=False)
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    panels[0].plot([], [], color=BLACK, linestyle=":", linewidth=1, label="X-ray on")
    legend_above(panels[0])
    panels[-1].set_xlabel("time, s")
