"""Right coronary arteries: a C around the right atrioventricular groove, drawn from published statistics.

Facts and their sources: the course, see `heart_reference`; lumen diameters by dominance, Dodge JT et al., "Lumen
diameter of normal human coronary arteries", Circulation 1992;86:232-46; length, tortuosity, curvature, diameter along
the artery and the origins of branches, measured on sixteen manually segmented right coronary arteries
(docs/evidence/atlas.md).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from endopilot.anatomy.labels_tree import RCA_SECTIONS
from endopilot.atlas import branching
from endopilot.atlas import curves as shape
from endopilot.atlas.heart_reference import BEYOND_CRUX, TO_CRUX, fit_heart
from endopilot.atlas.population import Draw, Drawn, side_kinds, vessel_data
from endopilot.atlas.variation import bent, ectasia, factor, forks_of, varied
from endopilot.lines import length_along

LENGTH_MM, LENGTH_SD_MM, LENGTH_RANGE_MM = 164.0, 30.0, (112.0, 223.0)
TORTUOSITY, TORTUOSITY_SD = 2.07, 0.23
CURVATURE, CURVATURE_SD = 0.061, 0.017
DIAMETER_MM = {0.1: 4.0, 0.2: 3.8, 0.5: 3.5, 0.7: 2.7, 0.9: 2.3}  # at fractions of the path to the farthest tip, mm
_CALIBRE = {"right": 1.025, "balanced": 0.9, "left": 0.74}  # against all patients' (Dodge 1992: 0.78, 0.70 of right)


@dataclass(frozen=True, kw_only=True)
class _Targets:
    """What a patient's main vessel must have: length in mm, mean curvature in 1/mm, the section its tip lies in."""

    dominance: str
    length_mm: float
    tortuosity: float
    curvature_per_mm: float
    ends_in: str


def make_rca(draw: Draw) -> Drawn:
    """Return one right coronary tree and its draws; targets stay when a shape fails, for failures would bias them."""
    for _ in range(10):
        targets = _targets(draw)
        with suppress(branching.NoShape):
            return branching.until_it_fits("right coronary artery", _draw, draw, targets)
    raise RuntimeError("no right coronary artery found in 600 draws")


def _targets(draw: Draw) -> _Targets:
    dominance = branching.coronary_dominance(draw.generator.random())
    if dominance == "left":
        # A small right coronary ends before the crux.
        length, ends_in = 112.0 + abs(float(draw.generator.normal(0, 10))), "3"
    else:
        # The mean makes up for the shorter left-dominant arteries.
        length = branching.truncated(draw, LENGTH_MM + 2.4, LENGTH_SD_MM, *LENGTH_RANGE_MM)
        ends_in = "4" if dominance == "balanced" or draw.generator.random() < 0.6 else "16"
    return _Targets(
        dominance=dominance,
        length_mm=length,
        tortuosity=branching.truncated(draw, TORTUOSITY, TORTUOSITY_SD, TORTUOSITY - 0.45, TORTUOSITY + 0.45),
        curvature_per_mm=branching.truncated(draw, CURVATURE, CURVATURE_SD, CURVATURE - 0.025, CURVATURE + 0.025),
        ends_in=ends_in,
    )


def _draw(draw: Draw, targets: _Targets) -> Drawn:
    main, crux = _main_vessel(draw, targets)
    healthy, calibre = _main_radius(draw, targets.dominance, main)
    radius, narrow = healthy, []
    if draw.generator.random() < draw.stenosis_share:
        narrow, narrowing = branching.stenoses(draw, length_along(main), (0.12, 0.75))
        radius = healthy * narrowing
    wide, widening = ectasia(draw, length_along(main))
    radius = radius * widening
    plans = varied(draw, _plan_branches(draw, healthy, crux, targets, calibre))
    main = bent(draw, main, radius, forks=forks_of(plans, 0))
    heart = fit_heart(main, 0.5 * crux, targets.ends_in)
    plans = [replace(plan, depth=heart.solid_depth) for plan in plans]
    vessels = [branching.Vessel(main, radius, _main_sections(main, crux, targets.ends_in))]
    tree = branching.build_tree(branching.with_side_branches(draw, vessels, plans), RCA_SECTIONS)
    bends = shape.curvature(main)
    drawn = {
        "dominance": targets.dominance,
        "length_mm": float(length_along(main)[-1]),
        "tortuosity": shape.tortuosity(main),
        "curvature_mean_per_mm": float(bends.mean()),
        "curvature_p90_per_mm": float(np.quantile(bends, 0.9)),
        "stenoses": narrow,
        "ectasias": wide,
    }
    return tree, drawn


def _main_vessel(draw: Draw, targets: _Targets) -> tuple[Float[np.ndarray, "n 3"], int]:
    """Return the path from the ostium to the farthest tip, and the index of the crux on it. Size, closure of the C and
    amplitude of the wiggles are solved for so that length, tortuosity and mean curvature take the drawn values."""
    length, ends_in = targets.length_mm, targets.ends_in
    waypoints = TO_CRUX if ends_in == "3" else np.concatenate([TO_CRUX, BEYOND_CRUX[ends_in]])
    template = shape.curve_through(waypoints, 1.0)
    template_crux = float(length_along(shape.curve_through(TO_CRUX))[-1])
    along = length_along(template)
    if ends_in == "3":
        keep = 0.97 * along[-1]
    else:
        # Long arteries reach farther beyond the crux rather than belong to huge hearts.
        crux_mm = 106.0 * (length / LENGTH_MM) ** 0.65 * (1 + 0.03 * draw.generator.normal())
        keep = min(template_crux * length / crux_mm, along[-1])
    template = template[along <= keep]
    wiggle = shape.Wiggle.draw(draw.generator, 13.0, 70.0)
    turn = Rotation.from_rotvec(np.deg2rad(draw.generator.normal(0, 7, 3)))
    centred = TO_CRUX - TO_CRUX.mean(axis=0)
    axis = np.linalg.svd(centred)[2][2]
    axis = axis * np.sign(axis @ np.cross(TO_CRUX[4] - TO_CRUX[0], TO_CRUX[-1] - TO_CRUX[4]))

    normals = shape.parallel_normals(shape.tangents(template))
    wanted = (length, targets.tortuosity, targets.curvature_per_mm)

    def curve(knobs: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
        bent = shape.bend(template, axis, float(knobs[1])) * np.exp(knobs[0])
        across = Rotation.from_rotvec(np.linspace(0, knobs[1], len(normals))[:, None] * axis).apply(normals)
        return turn.apply(shape.curve_through(wiggle.apply(bent, across, float(np.exp(knobs[2])), 8.0)))

    def misfit(knobs: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        points = curve(np.clip(knobs, (-1, -2, -4), (1, 2, 3)))
        found = (length_along(points)[-1], shape.tortuosity(points), shape.curvature(points).mean())
        return np.log(np.array(found) / wanted)

    solve = cast("Callable[..., Any]", root)  # what it returns without stubs takes type checkers half a minute to infer
    solution = solve(misfit, np.array([np.log(length / keep) - 0.05, 0.0, 0.5]), tol=1e-3, options={"maxfev": 60})
    points = curve(np.clip(solution.x, (-1, -2, -4), (1, 2, 3)))
    if np.abs(misfit(solution.x)).max() > 0.01 or shape.curvature(points).max() > 0.28:
        raise branching.NoShape
    crux = len(points) - 1 if ends_in == "3" else round(len(points) * template_crux / keep)
    return points, crux


def _main_radius(draw: Draw, dominance: str, main: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], float]:
    calibre = branching.coronary_calibre(draw, _CALIBRE[dominance], 0.55, 1.4)
    share = np.linspace(0.0, 1.0, len(main))
    diameter = PchipInterpolator([0.0, *DIAMETER_MM, 1.0], [4.1, *DIAMETER_MM.values(), 2.15])(share)
    if dominance == "left":
        diameter = diameter * (1 - 0.2 * share)
    return 0.5 * diameter * calibre * branching.uneven(draw, length_along(main)), calibre


def _main_sections(main: Float[np.ndarray, "n 3"], crux: int, ends_in: str) -> list[str]:
    """Label the main vessel: the acute margin lies 64 % of the path to the crux (Dodge 1988, R2 distal)."""
    margin = round(0.64 * crux)
    place = np.arange(len(main))
    names = np.select([place <= margin // 2, place <= margin, place <= crux], ["1", "2", "3"], default=ends_in)
    return [str(name) for name in names]


def _plan_branches(
    draw: Draw,
    radius: Float[np.ndarray, "n"],
    crux: int,
    targets: _Targets,
    calibre: float,
) -> list[branching.SidePlan]:
    plans: list[branching.SidePlan] = []
    end_mm = (len(radius) - 1) * shape.STEP_MM
    presence = factor(draw, draw.population.side_share)
    for section, kind in side_kinds("rca", "sides").items():
        if draw.generator.random() > kind.share * presence:
            continue
        origin = branching.free_origin(draw, *kind.origin_mm, [plan.origin for plan in plans])
        length = branching.truncated(draw, *kind.length_mm, 0.5 * kind.length_mm[0], 1.5 * kind.length_mm[0])
        # The main vessel's tip stays the farthest.
        length = min(length, 0.95 * end_mm - origin * shape.STEP_MM)
        diameter = kind.diameter_mm * (0.6 + 0.4 * calibre) * (1 + 0.1 * float(draw.generator.normal()))
        plans.append(branching.SidePlan(section, origin, length, diameter, kind.courses))
    if targets.dominance == "right" and (presence >= 1 or draw.generator.random() < 0.3 + presence):
        other = "16" if targets.ends_in == "4" else "4"
        length = max((end_mm - crux * shape.STEP_MM) * float(draw.generator.uniform(0.6, 0.92)), 12.0)
        diameter = 2 * float(radius[crux]) * float(draw.generator.uniform(0.68, 0.8))
        plans.append(branching.SidePlan(other, crux, length, diameter, vessel_data("rca")["distal"][other]))
    return plans
