"""Side branches that a CT does not show, and the ends of those that it shows: `grow`.

Where a vessel tapers, blood leaves it. By Murray's law the cubes of radii add up at a fork; so the cube that a vessel
loses along itself is that of side branches. These run over the heart, or dive into its muscle (septal branches), taper
as a main artery does, and branch by the same law until they are too thin to be seen.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from endopilot.angiograms.flow import Flow
from endopilot.types import Anatomy
from endopilot.xray.absorbers import across

_STEP_MM, _SPOKES = 0.4, 6
_THINNEST_MM, _FADES = 0.35, 20
"""Radius at which a branch ends, mm: what is thinner hardly rises above the noise. It fades in the last steps."""
_LENGTH = 75.0
"""Length of a vessel over its radius: an anterior descending artery's 1.85 mm taper over some 140 mm (Dodge 1992)."""
_APART_MM, _SHARES, _DIVES = 7.0, (0.2, 0.5), 0.3
"""Mean distance of side branches, mm: eight to ten septal branches along some 70 mm. Range of their radius as a share
of the vessel's, and share of those that dive: assumptions."""
_ANGLE_RAD, _ANGLE_SD = 0.9, 0.3
"""Mean and standard deviation of the angle at which they leave, rad: 52° [22–97] in fourteen real right arteries."""
_CURVATURE, _BENDS_MM = 0.08, 4.0
"""Curvature of what runs over the heart, standard deviation, 1/mm, and the length after which it is another: the
curvature's 95th percentile is 0.12–0.17 /mm in thirty real trees."""


def grow(
    anatomy: Anatomy, flow: Flow, random: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Append fine branches to the flow's lines, and return them as small volumes.

    Returns:
        Places, LPS mm, and sizes, mm³: six for each point that was appended.
    """
    tree = anatomy.tree
    centre, places, sizes = tree.line.points.mean(axis=0), [np.zeros((0, 3))], [np.zeros(0)]
    leaves, lines = tree.leaves(), [np.flatnonzero(flow.branch == k) for k in range(len(tree.branches))]
    for number, line in enumerate(lines):  # those that grow are appended, and grow too
        points, radius = flow.points[line], flow.radius[line]
        buds = _sides(points, radius, centre, random)
        if number in leaves:
            buds.append((len(line) - 1, points[-1] - points[-3], float(radius[-1]), False))
        for place, heading, wide, dives in buds:
            heading = heading / np.linalg.norm(heading)
            run = _run(
                points[place] + radius[place] * heading, heading, wide, dives, centre, random
            )  # from the wall on
            thin = np.linspace(wide, min(wide, _THINNEST_MM), len(run))
            lines.append(len(flow.points) + np.arange(len(run)))
            flow.append(run, thin, int(line[place]))
            first, second = across(np.gradient(run, axis=0))
            turn = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
            ring = np.cos(turn)[:, None] * first[:, None] + np.sin(turn)[:, None] * second[:, None]
            places.append((run[:, None] + thin[:, None, None] / np.sqrt(2) * ring).reshape(-1, 3))
            fading = np.minimum(np.arange(len(run), 0, -1) / _FADES, 1)
            sizes.append(np.repeat(fading * np.pi * thin**2 * _STEP_MM / _SPOKES, _SPOKES))
    return np.concatenate(places), np.concatenate(sizes)


def _sides(
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    centre: Float[np.ndarray, "3"],
    random: np.random.Generator,
) -> list[tuple[int, Float[np.ndarray, "3"], float, bool]]:
    """Return the side branches of a line: where each leaves, its heading, its radius, mm, and if it dives."""
    found, whole, last = [], radius[0] ** 3, 0.0
    widest = np.maximum.accumulate(radius[::-1])[::-1]  # of what follows: a stenosis takes no blood away
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    share, apart = random.uniform(*_SHARES), random.exponential(_APART_MM)
    for place in range(1, len(points) - 1):
        side = float(min(share * widest[place], max(whole - widest[place] ** 3, 0.0) ** (1 / 3)))
        if side < _THINNEST_MM or along[place] - last < apart:
            continue
        whole, last = whole - side**3, along[place]
        share, apart, dives = random.uniform(*_SHARES), random.exponential(_APART_MM), random.random() < _DIVES
        heading, outward = points[place + 1] - points[place - 1], points[place] - centre
        angle = random.normal(_ANGLE_RAD, _ANGLE_SD)
        axis = np.cross(outward, heading) if dives else random.choice((-1, 1)) * outward
        turned = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).apply(heading)
        found.append((place, turned, side, bool(dives)))
    return found


def _run(
    place: Float[np.ndarray, "3"],
    heading: Float[np.ndarray, "3"],
    radius: float,
    dives: bool,
    centre: Float[np.ndarray, "3"],
    random: np.random.Generator,
) -> Float[np.ndarray, "n 3"]:
    """Return the places of a branch, at equal distances."""
    places, kept = [], np.exp(-_STEP_MM / _BENDS_MM)
    shocks = random.normal(
        0, _CURVATURE * np.sqrt(1 - kept**2), _FADES + int(_LENGTH * max(radius - _THINNEST_MM, 0) / _STEP_MM)
    )
    bend, height = 0.0, np.linalg.norm(place - centre)
    for shock in shocks:
        place, bend = place + _STEP_MM * heading, kept * bend + shock
        outward = place - centre
        away = np.sqrt(outward @ outward)
        outward = outward / away
        if not dives:  # the heart is round about the tree's middle, near enough over a branch's length
            heading = heading - 0.1 * (heading @ outward + 0.1 * (away - height)) * outward
        (a, b, c), (x, y, z) = outward.tolist(), heading.tolist()  # numpy's cross takes half of a cine's time
        heading = heading + bend * _STEP_MM * np.array([b * z - c * y, c * x - a * z, a * y - b * x])
        heading = heading / np.sqrt(heading @ heading)
        places.append(place)
    return np.array(places)
