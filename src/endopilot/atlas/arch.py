"""Aortic arches with the supra-aortic arteries, entered from the descending aorta as a transfemoral device does.

Facts and their sources (all from CT of adults): height of the arch 49.3 and 40.1 mm, transverse width 83.6 and 73.3 mm,
length 146 and 123 mm (men, women; 344 patients, "The apex of the aortic arch backshifts with aging", 2017): half an
ellipse of that width and height has that length. Diameters of the aorta: Hager A et al., J Thorac Cardiovasc Surg
2002;123:1060-6. Diameters of the branches at their origins (12.5 ± 2.0, 8.3 ± 1.5, 10.4 ± 2.2 mm), gaps between them
(4.4 ± 2.5, 6.4 ± 4.0 mm) and the arch's angle to the sagittal plane (50 ± 14°): 217 patients, Yan Y et al., 2017.
Brachiocephalic trunk 38 ± 9.5 mm long (74 cadavers), and types I, II, III in 60.7, 34.3, 4.8 % of 288 patients (İnanç Y
et al., Neuropsychiatr Dis Treat 2018;14:29-35). The types follow from how far the trunk's origin lies below the top of
the arch, in diameters of the left common carotid: up to one, up to two, more. The left carotid leaves the
brachiocephalic trunk ("bovine arch") in 22 % (13 % common origin, 9 % higher: Layton KF et al., AJNR 2006;27:1541-2).
Carotids and subclavian arteries are cut off in the neck and the armpit.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.labels_tree import ARCH_SECTIONS
from endopilot.atlas import branching
from endopilot.atlas import curves as shape
from endopilot.atlas.population import Draw, Drawn, vessel_data
from endopilot.atlas.variation import bent, varied
from endopilot.lines import length_along

HEIGHT_MM, WIDTH_MM = {"man": 49.3, "woman": 40.1}, {"man": 83.6, "woman": 73.3}
TYPE_SHARES = {"I": 0.607, "II": 0.343, "III": 0.05}
BOVINE_SHARE = 0.22
AORTA_DIAMETER_MM = (24.3, 24.7, 26.1, 27.7, 29.4, 30.9, 29.8)
"""At the start of the descending aorta, isthmus, distal, proximal arch, before the trunk, ascending, root (Hager)."""
DIAMETER_MM = {
    "brachiocephalic trunk": (12.5, 1.95),
    "left common carotid": (8.28, 1.51),
    "left subclavian": (10.41, 2.2),
}
DIAMETER_MM_BEYOND = {"right common carotid": 7.0, "right subclavian": 9.0}  # a little less than the trunk's area
GAP_MM = {"left common carotid": (4.39, 2.49), "left subclavian": (6.43, 3.98)}
"""Between the wall of a branch and that of the one before it in the direction of flow, mm."""
TRUNK_MM = (38.2, 9.5)

_DESCENDING_MM, _ASCENDING_MM = 100.0, 35.0  # aorta before and behind the arch, from mid-chest and to the root


def make_arch(draw: Draw) -> Drawn:
    """Return one aortic arch and what was drawn for it; a stenosis lies in a carotid or the left subclavian artery."""
    sex = "man" if draw.generator.random() < 0.5 else "woman"
    kind = str(
        draw.generator.choice(list(TYPE_SHARES), p=np.array(list(TYPE_SHARES.values())) / sum(TYPE_SHARES.values()))
    )
    bovine = bool(draw.generator.random() < BOVINE_SHARE)
    return branching.until_it_fits("aortic arch", _draw, draw, sex, kind, bovine)


def _draw(draw: Draw, sex: str, kind: str, bovine: bool) -> Drawn:
    size = branching.truncated(draw, 1.0, 0.08, 0.8, 1.2)
    height, width = size * HEIGHT_MM[sex], size * WIDTH_MM[sex]
    wide = {
        name: branching.truncated(draw, mean, sd, mean - 2 * sd, mean + 2 * sd)
        for name, (mean, sd) in DIAMETER_MM.items()
    }
    points = _aorta(draw, height, width)
    low, high = {"I": (0.1, 1.0), "II": (1.0, 2.0), "III": (2.0, 2.9)}[kind]
    drop = wide["left common carotid"] * float(draw.generator.uniform(low, high))
    origins = _origins(draw, points, drop, wide, bovine)
    first, last = origins["left subclavian"], origins["brachiocephalic trunk"]
    along, place = length_along(points), np.arange(len(points))
    marks = along[[0, first - 60, first, (first + last) // 2, last, last + 60, -1]]
    radius = 0.5 * np.interp(along, marks, AORTA_DIAMETER_MM) * branching.uneven(draw, along)
    radius = radius * branching.truncated(draw, 1.0, 0.13, 0.7, 1.3)
    section = np.select([place <= first, place <= last], ARCH_SECTIONS[:2], default=ARCH_SECTIONS[2]).tolist()
    vessels = [branching.Vessel(bent(draw, points, radius), radius, section)]
    plans = varied(draw, _plans(draw, vessels[0], origins, wide, bovine))
    vessels = branching.with_side_branches(draw, vessels, plans)
    narrow = []
    if draw.generator.random() < draw.stenosis_share:
        where = str(draw.generator.choice(["left common carotid", "left subclavian", "right common carotid"]))
        index = [vessel.section[-1] for vessel in vessels].index(where)
        narrow, vessels = branching.narrowed(draw, vessels, index, (0.4, 0.8))
    drawn = {
        "arch_type": kind,
        "bovine": bovine,
        "sex": sex,
        "arch_height_mm": height,
        "arch_width_mm": width,
        "trunk_drop_mm": drop,
        "stenoses": narrow,
    }
    return branching.build_tree(vessels, ARCH_SECTIONS), drawn


def _aorta(draw: Draw, height_mm: float, width_mm: float) -> Float[np.ndarray, "n 3"]:
    turn = np.linspace(np.pi, 0.0, 24)
    across, up = 0.5 * width_mm * np.cos(turn), height_mm * np.sin(turn)
    down, root = np.linspace(-_DESCENDING_MM, -8.0, 12), np.linspace(-8.0, -_ASCENDING_MM, 5)
    across = np.concatenate([np.full(12, across[0]), across, np.full(5, across[-1])])
    up = np.concatenate([down, up, root])
    angle = np.deg2rad(branching.truncated(draw, 50.3, 13.8, 22.0, 78.0))
    forwards = np.array([-np.sin(angle), -np.cos(angle), 0.0])
    points = across[:, None] * forwards + up[:, None] * np.array([0.0, 0.0, 1.0])
    line = shape.curve_through(points)
    return branching.wiggled(draw, line, (1.5, 4.0), quiet_mm=30.0, wavelengths_mm=(60.0, 160.0))


def _origins(
    draw: Draw,
    points: Float[np.ndarray, "n 3"],
    drop_mm: float,
    wide: dict[str, float],
    bovine: bool,
) -> dict[str, int]:
    """Return the points of the aorta where branches leave: the brachiocephalic trunk `drop_mm` below the top of the
    arch, the others between there and the descending aorta."""
    top = int(points[:, 2].argmax())
    last = top + int(np.searchsorted(points[top, 2] - points[top:, 2], drop_mm))
    origins, before = {"brachiocephalic trunk": last}, "brachiocephalic trunk"
    for name, (mean, sd) in GAP_MM.items():
        if bovine and name == "left common carotid":
            continue
        gap = branching.truncated(draw, mean, sd, 0.5, mean + 2 * sd)
        away = gap + 0.5 * (wide[before] + wide[name])
        origins[name], before = origins[before] - round(away / shape.STEP_MM), name
    if points[origins["left subclavian"], 2] < 0.2 * points[top, 2]:
        raise branching.NoShape
    return origins


def _plans(
    draw: Draw,
    aorta: branching.Vessel,
    origins: dict[str, int],
    wide: dict[str, float],
    bovine: bool,
) -> list[branching.SidePlan]:
    tangents, data = shape.tangents(aorta.points), vessel_data("arch")

    def plan(name: str, diameter: float, parent: int, origin: int, length: float, taper: float) -> branching.SidePlan:
        course = np.array(data["courses"][name][0][1])
        # Branches of the arch head upwards, however the aorta runs under them.
        up = np.rad2deg(np.arccos(tangents[origin] @ course / np.linalg.norm(course))) if parent == 0 else 30.0
        angle = float(np.clip(up, 30.0, 130.0))
        return branching.SidePlan(
            section=name,
            parent=parent,
            origin=origin,
            length_mm=length,
            diameter_mm=diameter,
            courses=data["courses"][name],
            taper=taper,
            angle_deg=(angle - 8.0, angle + 8.0),
        )

    trunk = "brachiocephalic trunk"
    length = branching.truncated(draw, *TRUNK_MM, 24.0, 58.0)
    wall = float(aorta.radius[origins[trunk]])
    plans = [plan(trunk, wide[trunk], 0, origins[trunk], wall + length, 0.1)]
    for name in ("left common carotid", "left subclavian", "right common carotid", "right subclavian"):
        diameter = wide.get(name, 0.0) or DIAMETER_MM_BEYOND[name] * wide[trunk] / DIAMETER_MM[trunk][0]
        parent, origin = (0, origins[name]) if name in origins else (1, -1)
        if name == "left common carotid" and bovine:
            parent, origin = 1, round((wall + float(draw.generator.uniform(3.0, 12.0))) / shape.STEP_MM)
        reach = data["length_mm"][name] + (wall if parent == 0 else 0.0)
        plans.append(plan(name, diameter, parent, origin, reach * float(draw.generator.uniform(0.9, 1.1)), 0.2))
    return plans
