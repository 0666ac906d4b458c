"""The page of a navigation in a patient: what came of it, its replay in space, its course in time, how to repeat it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from endopilot.control.navigate import PatientNavigation, SetUp
from endopilot.control.outcome import name_target, slipped_s, tell_outcome, worst_ratio
from endopilot.files import json_text, writing
from endopilot.report.report import image, render
from endopilot.report.scene import mark_target, navigation_scene, scene_html
from endopilot.simulation.world import read_world


def write_navigation_page(
    path: Path, found: PatientNavigation, *, picture: bytes, commands: Mapping[str, str], manifest: Mapping[str, Any]
) -> None:
    """Write the page as one HTML file that needs nothing beside it.

    Raises:
        InputError: the page cannot be written.
    """
    name = found.set_up.navigation.anatomy.name
    outcome = tell_outcome(found)
    page = render(
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
    with writing(path) as partial:
        partial.write_text(page, encoding="utf-8")


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
