"""The page of a navigation in a patient: what came of it, its replay in space, its course in time
(`navigation_figure`), how to repeat it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import AdviserConfig
from endopilot.control.navigate import PatientNavigation, SetUp
from endopilot.control.outcome import name_target, slipped_s, tell_outcome, worst_ratio
from endopilot.control.plan_picture import draw_route, legend_above
from endopilot.files import json_text
from endopilot.plotting import BLACK, BLUE, CATHETER_COLORS, GREY, ORANGE, PURPLE, STYLE, VERMILLION
from endopilot.report.report import image, write_page
from endopilot.report.scene import mark_target, navigation_scene, scene_html
from endopilot.simulation.world import read_world
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.tasks.route import Route
from endopilot.tasks.targets import section_at


def write_navigation_page(
    path: Path, found: PatientNavigation, *, picture: bytes, commands: Mapping[str, str], manifest: Mapping[str, Any]
) -> None:
    """Write the page as one HTML file that needs nothing beside it; InputError if it cannot be written."""
    name = found.set_up.navigation.anatomy.name
    outcome = tell_outcome(found)
    write_page(
        path,
        "navigation.html.j2",
        title=f"{name}: to {name_target(found.set_up)}",
        outcome=outcome[0].upper() + outcome[1:] + ".",
        tiles=_tiles(found),
        facts=_facts(found),
        plotly=Markup(get_plotlyjs()),
        scene=_scene(found),
        believes=found.wires is not None,
        catheters=len(found.set_up.navigation.catheters),
        devices="Wire, catheter" if found.set_up.navigation.catheters else "Wire",
        picture=image(picture, f"Course of the navigation in {name}"),
        exposures=_exposures(found),
        commands=commands,
        manifest=json_text(manifest),
    )


def _tiles(found: PatientNavigation) -> list[tuple[str, str, str]]:
    record, navigation = found.record, found.set_up.navigation
    minutes, whose = max(record.seconds, 0.5) / 60, "wire's " if navigation.catheters else ""
    tiles = [
        (f"{record.seconds:g} s", "until the target" if record.success else "until it ended",
         f"of {navigation.seconds:g} s given"),
        (str(record.exposures), "X-ray exposures", f"{record.exposures / minutes:.1f} a minute"),
        (f"{record.peak_force_n:.3f} N", "largest force on the wall", f"limit {navigation.force_limit_n:g} N"),
        (f"{worst_ratio(found):.2f}", f"largest safety ratio of the {whose}tip", "1 is the wall"),
    ]  # fmt: skip
    if record.believed is not None:
        errors = np.abs(record.believed[:-1, 0] - record.tip.abscissa[:-1, 0])
        tiles.append(
            (f"{np.median(errors):.2f} mm", "median error of the believed Δtip", f"at most {errors.max():.2f} mm")
        )
    return tiles


def _facts(found: PatientNavigation) -> list[tuple[str, str]]:
    set_up, navigation = found.set_up, found.set_up.navigation
    world, device = set_up.world, navigation.device
    facts = [
        ("Policy", set_up.policy_name),
        ("Wire", f"{device.name}, {device.diameter_mm:g} mm"),
        *(("Catheter", f"{each.name}, {each.diameter_mm:g} mm") for each in navigation.catheters),
        *((("Arrives", "the catheter's tip"),) if navigation.arriving else ()),
        ("Tip", set_up.choice.why),
        ("World", ": ".join(filter(None, (set_up.config.world, world.about)))),
        ("Friction in reality", f"{device.friction * world.friction_factor:.3g}, given {device.friction:g}"),
        ("Tip stiffness in reality", f"{world.tip_stiffness_factor:g} of the given one"),
        ("Ostium in reality", f"{world.ostium_mm:+.2f} mm along the catheter"),
        ("Robot", _robot(set_up)),
        ("A drive slipped for" if navigation.catheters else "Drive slipped for", f"{slipped_s(found):.2f} s"),
    ]
    if leans_deg := read_world(set_up.config.world).axis_deg:
        unseen = "" if world.axis_deg == leans_deg else f"; X-ray shows it to {world.axis_deg:.1f}°"
        facts.append(("Guiding catheter in reality", f"{leans_deg:g}° off its given axis{unseen}"))
    if found.plans is not None:
        facts.append(("Courses searched", str(found.plans)))
    if found.record.found:
        facts.append(("Model mismatch: the policy found", found.record.found))
    return [*facts, ("Seed", str(set_up.config.seed))]


def _robot(set_up: SetUp) -> str:
    robot = set_up.world.real_robot(set_up.robot)
    wire = robot.wire
    where = "motors" if robot.encoders_at == "motor" else "devices"
    play = f"play {wire.play_mm:g} mm and {np.rad2deg(wire.play_rad):.0f}°"
    return f"{set_up.config.robot}: {play}, latency {1e3 * robot.latency_s:.3g} ms, encoders on the {where}"


def _scene(found: PatientNavigation) -> Markup:
    record, navigation = found.record, found.set_up.navigation
    figure = navigation_scene(
        navigation.anatomy, found.record.trajectory, devices=navigation.devices, believed=found.wires
    )
    exposed = record.exposed
    place = navigation.target.position(navigation.anatomy)
    mark_target(figure, place, record.tip_position[exposed, 0], record.time_s[exposed])
    return scene_html(figure)


def _exposures(found: PatientNavigation) -> list[dict[str, str]]:
    """Return a row for each exposure: when, why, what it showed and what had been believed before."""
    record, rows = found.record, []
    for sample in np.flatnonzero(record.exposed).tolist():
        tip = record.measured[sample]
        why = "the start" if sample == 0 else record.asks[sample - 1] or "the policy asked"
        rows.append(
            {
                "time": f"{record.time_s[sample]:g}",
                "why": why[0].upper() + why[1:],
                "measured": "no wire found" if tip is None else f"{tip.abscissa:.1f}",
                "true": f"{record.tip.abscissa[sample, 0]:.1f}",
            }
        )
    return rows


_DEVICE_COLORS = (BLUE, *CATHETER_COLORS)
_LABEL_SHARE = 0.06  # labels of forks are this share of the axis apart, at least


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
    mark_exposures(axes, found.record.tip_position[found.record.exposed, 0])
    axes.legend(loc="best", fontsize=9)


def mark_exposures(axes: Axes, tips: Float[np.ndarray, "n 3"]) -> None:
    """Mark where the tip was when X-ray was on, LPS mm, in a picture of the route from the front."""
    axes.plot(tips[:, 0], tips[:, 2], "o", mfc="none", color=BLACK, markersize=6, label="tip under X-ray")


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


def _draw_under(axes: Axes, limit: float, highest: float, text: str, label: str, **line: Any) -> None:
    """Draw a level of a figure over time, named at its right, and the axis from 0 to over all."""
    axes.axhline(limit, color=GREY, linewidth=1, **line)
    axes.annotate(text, (1.0, limit), xycoords=("axes fraction", "data"), fontsize=7.5, ha="right", va="bottom")
    axes.set_ylim(0, 1.2 * max(limit, highest))
    axes.set_ylabel(label)


def _draw_safety(axes: Axes, found: PatientNavigation) -> None:
    tip, radius = found.record.tip[:, 0], found.set_up.navigation.device.tip_radius_mm
    ratio = safety_ratio(tip.offset, tip.radius, radius)
    axes.plot(found.record.time_s, ratio, color=PURPLE)
    axes.axhline(AdviserConfig().wall_ratio, color=GREY, linestyle="--", linewidth=1)
    _draw_under(axes, 1.0, float(ratio.max()), "wall", "safety ratio\nγ/(r − r_w)")


def _draw_force(axes: Axes, found: PatientNavigation) -> None:
    record, limit = found.record, found.set_up.navigation.force_limit_n
    axes.step(record.time_s, record.contact_force_max, where="pre", color=VERMILLION)
    _draw_under(axes, limit, record.peak_force_n, f"limit {limit:g} N", "largest wall\nforce, N", linestyle="--")


def _draw_pushes(axes: Axes, found: PatientNavigation) -> None:
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
