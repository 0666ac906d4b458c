"""Portal veins of the liver: the main portal vein, its right and left branch, sections and segments.

This is the tree that a device explores once it stands in the portal vein, through a transjugular intrahepatic
portosystemic shunt (TIPS), the spleen or the liver: it enters at the confluence of the splenic and the superior
mesenteric vein and runs with the blood. The access, vena cava, hepatic vein and the tract through the liver, is left
out: it is no vessel before it is made.

Facts and their sources: the portal vein is about 80 mm long and up to 13 mm wide (Gray's Anatomy); it bifurcates in
75.5 %, trifurcates in 11.1 %, and gives the right posterior branch first in 9.7 % (1384 patients, Koc Z et al., Diagn
Interv Radiol 2007;13:212-6; the rest is left out here). Sections and segments after Couinaud: right anterior (5, 8) and
posterior (6, 7), left (2, 3, 4). Widths beyond follow Murray's law, d³ = Σ dᵢ³ (Murray CD, PNAS 1926;12:207-14);
lengths of the right (about 20 mm) and of the left branch's transverse part (about 35 mm) are assumptions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from endopilot.anatomy.labels_tree import PORTAL_SECTIONS
from endopilot.atlas import branching
from endopilot.atlas import curves as shape
from endopilot.atlas.population import Draw, Drawn, vessel_data
from endopilot.atlas.variation import Fork, bent, varied
from endopilot.lines import length_along

MAIN_MM, MAIN_SD_MM = 78.0, 9.0
MAIN_DIAMETER_MM, MAIN_DIAMETER_SD_MM = 12.0, 1.3
VARIANT_SHARES = {"bifurcation": 75.5, "trifurcation": 11.1, "right posterior first": 9.7}
RIGHT_MM, RIGHT_SD_MM = 20.0, 5.0
LEFT_MM, LEFT_SD_MM = 35.0, 6.0  # right branch, and transverse part of the left one, mm

_COURSE = np.array([[0, 0, 0], [-18, 4, 13], [-36, 9, 29], [-52, 12, 45], [-64, 13, 56.0]])
"""The main portal vein from the confluence to the porta hepatis, mm."""
_RIGHT = np.array([[-10, -1, 3], [-19, -5, 6], [-27, -12, 13], [-33, -17, 25], [-37, -19, 40], [-41, -18, 54.0]])
"""Onwards along the right branch, its anterior one and the vein of segment 8, mm from the porta hepatis."""
_SEGMENT_DIAMETER_MM = 5.0
_SHARPEST_PER_MM = 0.15  # greatest curvature of the widest line, 1/mm: its wall must not fold


def make_portal(draw: Draw) -> Drawn:
    """Return one portal vein and what was drawn for it; a stenosis lies in the main, right or left portal vein."""
    shares = np.array(list(VARIANT_SHARES.values()))
    variant = str(draw.generator.choice(list(VARIANT_SHARES), p=shares / shares.sum()))
    length = branching.truncated(draw, MAIN_MM, MAIN_SD_MM, 60.0, 96.0)
    return branching.until_it_fits("portal vein", _draw, draw, variant, length)


def _draw(draw: Draw, variant: str, main_mm: float) -> Drawn:
    size = branching.truncated(draw, 1.0, 0.1, 0.8, 1.2)
    points, hilum = _main(draw, main_mm, size)
    right_mm = size * branching.truncated(draw, RIGHT_MM, RIGHT_SD_MM, 12.0, 30.0)
    left, posterior = hilum, hilum
    if variant == "bifurcation":
        posterior = hilum + round(right_mm / shape.STEP_MM)
    elif variant == "right posterior first":
        left = hilum + round(0.7 * right_mm / shape.STEP_MM)
    anterior = max(left, posterior) + round(size * float(draw.generator.uniform(12.0, 18.0)) / shape.STEP_MM)
    diameter = branching.truncated(draw, MAIN_DIAMETER_MM, MAIN_DIAMETER_SD_MM, 9.0, 15.0)
    calibre = diameter / MAIN_DIAMETER_MM
    radius = 0.5 * calibre * _profile(len(points), left, posterior, anterior)
    radius = radius * branching.uneven(draw, length_along(points))
    origins = {"LPV": left, "RPPV": posterior, "S5": anterior}
    forks = [Fork(origin, vessel_data("portal")["courses"][name][0][1]) for name, origin in origins.items()]
    points = bent(draw, points, radius, forks=forks)
    place = np.arange(len(points))
    ends = [place <= left, place <= posterior, place <= anterior]
    vessels = [branching.Vessel(points, radius, np.select(ends, ["MPV", "RPV", "RAPV"], default="S8").tolist())]
    vessels = _grown(draw, vessels, origins, size, calibre)
    narrow = []
    if draw.generator.random() < draw.stenosis_share:
        share = hilum / len(points)
        which, shares = (0, (0.3 * share, 0.8 * share)) if draw.generator.random() < 0.6 else (1, (0.3, 0.5))
        narrow, vessels = branching.narrowed(draw, vessels, which, shares)
    drawn = {
        "variant": variant,
        "main_length_mm": float(length_along(points)[min(left, posterior)]),
        "main_diameter_mm": diameter,
        "stenoses": narrow,
    }
    return branching.build_tree(vessels, PORTAL_SECTIONS), drawn


def _main(draw: Draw, main_mm: float, size: float) -> tuple[Float[np.ndarray, "n 3"], int]:
    turn = Rotation.from_rotvec(np.deg2rad(draw.generator.normal(0, 8, 3)))
    main = _COURSE * main_mm / length_along(shape.curve_through(_COURSE))[-1]
    right = main[-1] + size * turn.apply(_RIGHT)
    points = shape.curve_through(np.concatenate([main, right]))
    points = branching.wiggled(draw, points, (0.8, 2.2), quiet_mm=25.0, wavelengths_mm=(25.0, 80.0))
    if shape.curvature(points).max() > _SHARPEST_PER_MM:
        raise branching.NoShape
    return points, round(main_mm / shape.STEP_MM)


def _profile(count: int, left: int, posterior: int, anterior: int) -> Float[np.ndarray, "n"]:
    """Return the diameter along that line, mm: it falls at every division over 4 mm, by Murray's law."""
    diameter = np.full(count, MAIN_DIAMETER_MM)
    for place, factor in ((left, 0.84), (posterior, 0.8), (anterior, 0.8)):
        share = np.clip((np.arange(count) - place) / 8.0, 0.0, 1.0)
        diameter = diameter * (1 - (1 - factor) * share)
    beyond = np.clip((np.arange(count) - anterior) / max(count - anterior, 1), 0.0, 1.0)
    return diameter * (1 - 0.3 * beyond)


def _grown(
    draw: Draw,
    vessels: list[branching.Vessel],
    origins: dict[str, int],
    size: float,
    calibre: float,
) -> list[branching.Vessel]:
    """Return the vessels with left and right posterior branch, then their segments' veins, then those of segment 5."""

    def plan(
        name: str, parent: int, origin: int, length_mm: float, diameter_mm: float, taper: float
    ) -> branching.SidePlan:
        return branching.SidePlan(
            section=name,
            parent=parent,
            origin=origin,
            length_mm=size * length_mm * float(draw.generator.uniform(0.9, 1.1)),
            diameter_mm=calibre * diameter_mm * branching.truncated(draw, 1.0, 0.08, 0.8, 1.2),
            courses=vessel_data("portal")["courses"][name],
            taper=taper,
            angle_deg=(55.0, 80.0) if name == "LPV" else (40.0, 65.0),
        )

    length_mm = vessel_data("portal")["length_mm"]
    transverse = branching.truncated(draw, LEFT_MM, LEFT_SD_MM, 24.0, 46.0)
    large = [
        plan("LPV", 0, origins["LPV"], transverse + 18.0, 8.5, 0.35),
        plan("RPPV", 0, origins["RPPV"], 62.0, 7.5, 0.5),
        plan("S5", 0, origins["S5"], length_mm["S5"], _SEGMENT_DIAMETER_MM, 0.4),
    ]
    vessels = branching.with_side_branches(draw, vessels, varied(draw, large))
    turn = round(size * transverse / shape.STEP_MM)
    low = round(size * float(draw.generator.uniform(22.0, 28.0)) / shape.STEP_MM)
    places = {"S2": (1, min(turn, len(vessels[1].points) - 20)), "S4": (1, -1), "S3": (1, -1), "S6": (2, low)}
    plans = [
        plan(name, parent, place, length_mm[name], _SEGMENT_DIAMETER_MM, 0.4)
        for name, (parent, place) in places.items()
    ]
    vessels = branching.with_side_branches(draw, vessels, varied(draw, plans))
    posterior = vessels[2]
    names = np.where(np.arange(len(posterior.points)) <= low, "RPPV", "S7").tolist()
    vessels[2] = replace(posterior, section=names)
    return vessels
