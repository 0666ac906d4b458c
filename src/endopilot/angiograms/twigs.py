"""Side branches that a CT does not show, and the ends of those that it shows: `grow`.

Where a vessel tapers, blood leaves it. By Murray's law (PNAS 12, 1926) the cubes of radii add up at a fork; so the cube
that a vessel loses along itself is that of side branches. These run over the heart, or dive into its muscle (septal
branches), taper as a main artery does and branch by the same law, until they are too thin to be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from endopilot.angiograms.flow import Flow
from endopilot.types import Anatomy
from endopilot.xray.absorbers import across

_STEP_MM = 0.4
_THINNEST_MM = 0.2
"""Radius at which a branch ends, mm: what is thinner hardly rises above the noise of a frame."""
_LENGTH = 75.0
"""Length of a vessel over its radius: an anterior descending artery's 1.85 mm taper over some 140 mm (Dodge 1992)."""
_APART_MM = 7.0
"""Mean distance of side branches along a vessel, mm: eight to ten septal branches along some 70 mm."""
_SHARES = (0.2, 0.5)
"""Range of a side branch's radius as a share of its parent's: an assumption."""
_ANGLE_RAD, _ANGLE_SD = 0.9, 0.3
"""Mean and standard deviation of the angle at which it leaves, rad: 52° [22–97] in fourteen real right arteries."""
_DIVES = 0.3
"""Share of the side branches that dive into the muscle: an assumption."""
_CURVATURE, _BENDS_MM = 0.08, 4.0
"""Curvature of what runs over the heart, standard deviation, 1/mm, and the length after which it is another: the
curvature's 95th percentile is 0.12–0.17 /mm in thirty real trees."""
_SPOKES = 6


@dataclass(frozen=True)
class _Bud:
    """Where a branch begins: place, heading, radius, transit time, velocity over radius, section, and if it dives."""

    place: Float[np.ndarray, "3"]
    heading: Float[np.ndarray, "3"]
    radius: float
    transit_s: float
    pace: float
    section: int
    dives: bool


def grow(
    anatomy: Anatomy, flow: Flow, random: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Append fine branches to the flow's lines, and return them as small volumes.

    Returns:
        Places, LPS mm, sizes, mm³, and transit times from the ostium, s.
    """
    tree = anatomy.tree
    centre, leaves, buds = tree.line.points.mean(axis=0), tree.leaves(), list[_Bud]()
    for index, branch in enumerate(tree.branches):
        own, line = flow.branch == index, branch.centerline
        pace = 1000 * flow.rate_ml_s[own] / (np.pi * line.radius**3)
        heading = np.gradient(line.points, axis=0)
        buds += _sides(line.points, heading, line.radius, flow.transit_s[own], pace, branch.section, centre, random)
        if index in leaves:
            last = flow.transit_s[own][-1], float(pace[-1]), int(branch.section[-1])
            buds.append(_Bud(line.points[-1], heading[-4:].mean(axis=0), float(line.radius[-1]), *last, False))
    places, sizes, times = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    while buds:
        bud = buds.pop()
        points, heading = _run(bud, centre, random)
        radius = np.linspace(bud.radius, _THINNEST_MM, len(points))
        pace, section = np.full(len(points), bud.pace), np.full(len(points), bud.section)
        transit = bud.transit_s + _STEP_MM * np.arange(1, len(points) + 1) / (bud.pace * bud.radius)
        flow.append(points, radius, transit, section)
        buds += _sides(points, heading, radius, transit, pace, section, centre, random)
        first, second = across(heading)
        turn = 2 * np.pi * np.arange(_SPOKES)[:, None, None] / _SPOKES
        ring = radius[:, None] / np.sqrt(2) * (np.cos(turn) * first + np.sin(turn) * second)
        places.append((points + ring).reshape(-1, 3))
        sizes.append(np.tile(np.pi * radius**2 * _STEP_MM / _SPOKES, _SPOKES))
        times.append(np.tile(transit, _SPOKES))
    return np.concatenate(places), np.concatenate(sizes), np.concatenate(times)


def _sides(
    points: Float[np.ndarray, "n 3"],
    heading: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    transit_s: Float[np.ndarray, "n"],
    pace: Float[np.ndarray, "n"],
    section: Int[np.ndarray, "n"],
    centre: Float[np.ndarray, "3"],
    random: np.random.Generator,
) -> list[_Bud]:
    """Return where side branches leave a line: each time that the line has lost the cube of one's radius."""
    found, whole, spent = list[_Bud](), float(radius[0]) ** 3, 0.0
    widest = np.maximum.accumulate(radius[::-1])[::-1]  # of what follows: a stenosis takes no blood away
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    share, apart = random.uniform(*_SHARES), random.exponential(_APART_MM)
    for place in range(1, len(points) - 1):
        spent += steps[place - 1]
        side = min(share * widest[place], max(whole - widest[place] ** 3, 0) ** (1 / 3))
        if side < 1.5 * _THINNEST_MM or spent < apart:
            continue
        whole, spent, apart = whole - side**3, 0.0, random.exponential(_APART_MM)
        share, dives = random.uniform(*_SHARES), random.random() < _DIVES
        along, outward = heading[place], points[place] - centre
        angle = random.choice((-1, 1)) * random.normal(_ANGLE_RAD, _ANGLE_SD)
        outward = outward / np.linalg.norm(outward)
        axis = np.cross(along, outward) if dives else outward
        turned = Rotation.from_rotvec((-abs(angle) if dives else angle) * axis / np.linalg.norm(axis)).apply(along)
        found.append(
            _Bud(points[place], turned, float(side), float(transit_s[place]), float(pace[place]), int(section[place]), dives)
        )
    return found


def _run(
    bud: _Bud, centre: Float[np.ndarray, "3"], random: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return a branch's places, at equal distances, and its headings."""
    count = max(int(_LENGTH * (bud.radius - _THINNEST_MM) / _STEP_MM), 2)
    kept = np.exp(-_STEP_MM / _BENDS_MM)
    shocks = random.normal(0, _CURVATURE * np.sqrt(1 - kept**2), count)
    place, heading, bend = bud.place, bud.heading / np.linalg.norm(bud.heading), random.normal(0, _CURVATURE)
    height = np.linalg.norm(place - centre)
    places, headings = np.empty((count, 3)), np.empty((count, 3))
    for step, shock in enumerate(shocks):
        place, bend = place + _STEP_MM * heading, kept * bend + shock
        outward = place - centre
        away = np.linalg.norm(outward)
        outward = outward / away
        if not bud.dives:  # the heart is round about the tree's middle, near enough over a branch's length
            heading = heading - 0.1 * (heading @ outward + (away - height) / _LENGTH * 10) * outward
        heading = heading + bend * _STEP_MM * np.cross(outward, heading)
        heading = heading / np.linalg.norm(heading)
        places[step], headings[step] = place, heading
    return places, headings
