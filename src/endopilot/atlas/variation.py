"""What patients show beyond the textbook's courses: bends, giving way at forks, lumens that are not round, catheters.

Vessels are bent by turning their steps, so that lengths, and with them every index of a point, stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from endopilot.atlas import curves as shape
from endopilot.atlas.branching import NoShape, SidePlan, truncated
from endopilot.atlas.population import Draw, Spread
from endopilot.types import Centerline, VesselTree

TIGHTEST = 0.97  # greatest curvature times radius of a main vessel: at 1 the lumen's inner wall shrinks to a point

_TRIES = 12
_MOST_BENDS = 2.5  # no patient's mean number of sharp bends is more than this many times that of all
_QUIET_MM = 4.0  # over this length behind a vessel's start its waves fade in, mm
_STRAIGHT_MM = 12.0  # no sharp bend lies nearer than this to the ostium, mm: the catheter's tip lies there
_STEEPEST_DEG = 75.0  # greatest angle of catheter and vessel: beyond, the wire meets the wall head-on
_GIVES_WAY_MM = 10.0  # over this length behind a fork the deflection dies out by a factor e, mm
_SCATTER_DEG = 30.0  # a parent gives way to the side opposite to the branch, within this SD


@dataclass(frozen=True)
class Fork:
    """A place at which a main vessel gives way, by an angle (drawn if none), to a branch in an LPS direction."""

    index: int
    side: tuple[float, float, float]
    deflection_deg: float | None = None


def drawn_from(draw: Draw, spread: Spread) -> float:
    """Draw from a truncated log-normal distribution."""
    median, sd, low, high = spread
    return float(np.exp(truncated(draw, np.log(median), sd, np.log(low), np.log(high))))


def factor(draw: Draw, bounds: tuple[float, float]) -> float:
    """Draw a factor between two bounds; 1 without a draw where both are 1."""
    return 1.0 if bounds == (1.0, 1.0) else float(draw.generator.uniform(*bounds))


def varied(draw: Draw, plans: Sequence[SidePlan]) -> list[SidePlan]:
    """Return the plans with a patient's angles and calibres."""
    changed = []
    for plan in plans:
        angle = plan.angle_deg
        if draw.population.side_angle_deg is not None:
            middle = drawn_from(draw, draw.population.side_angle_deg)
            angle = (middle - 3.0, middle + 3.0)
        calibre = factor(draw, draw.population.side_calibre)
        changed.append(replace(plan, angle_deg=angle, diameter_mm=plan.diameter_mm * calibre))
    return changed


def forks_of(plans: Sequence[SidePlan], parent: int) -> list[Fork]:
    """Return the places at which a vessel gives way to its planned branches."""
    return [Fork(plan.origin, plan.courses[0][1]) for plan in plans if plan.parent == parent and plan.origin >= 0]


def bent(
    draw: Draw,
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    *,
    forks: Sequence[Fork] = (),
    first: int = 0,
) -> Float[np.ndarray, "n 3"]:
    """Return a vessel with waves, sharp bends and deflections behind its point `first`, of the same length; the
    textbook's population draws none. Raises NoShape where no draw kept the lumen's wall from folding."""
    if not draw.population.bends_vessels:
        return points
    mean = draw.population.bends_per_100_mm
    rate = min(float(draw.generator.exponential(mean)), _MOST_BENDS * mean) if mean else 0.0
    for _ in range(_TRIES):
        moved = shape.turned(points, _turns(draw, points, radius, forks, first, rate))
        if (shape.curvature(moved) * radius)[1:-1].max() < TIGHTEST:
            return moved
    raise NoShape


def _turns(
    draw: Draw,
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    forks: Sequence[Fork],
    first: int,
    rate: float,
) -> Float[np.ndarray, "m 3"]:
    """Return by what rotation vector each step of a vessel turns, rad."""
    steps = np.diff(points, axis=0)
    ahead = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    one = shape.parallel_normals(ahead)
    two = np.cross(ahead, one)
    along = shape.STEP_MM * (np.arange(len(steps)) + 0.5 - first)
    angles = _waves(draw, along)
    count = int(draw.generator.poisson(rate * max(along[-1], 0.0) / 100.0))
    for _ in range(count):
        begin = max(_QUIET_MM, _STRAIGHT_MM - shape.STEP_MM * first)
        where = float(draw.generator.uniform(begin, max(along[-1] - 6.0, begin + 1.0)))
        wide = float(np.interp(where, along, radius[1:]))
        angle = np.deg2rad(float(draw.generator.uniform(*draw.population.bend_deg)))
        tightness = float(np.exp(draw.generator.uniform(*np.log(draw.population.bend_tightness))))
        # The angle runs as a·u·exp((1 − u²)/2): its slope, the curvature, is a·√e/w at the middle.
        width = np.sqrt(np.e) * angle * wide / tightness
        u = (along - where) / width
        profile = angle * u * np.exp(0.5 * (1 - u**2))
        azimuth = float(draw.generator.uniform(0, 2 * np.pi))
        angles += profile[:, None] * np.array([np.cos(azimuth), np.sin(azimuth)])
    for fork in forks:
        angle = fork.deflection_deg
        if angle is None:
            if draw.population.deflection_deg is None:
                continue
            angle = drawn_from(draw, draw.population.deflection_deg)
        at = min(fork.index, len(steps) - 1)
        side = np.array([one[at] @ fork.side, two[at] @ fork.side])
        azimuth = np.arctan2(-side[1], -side[0]) + np.deg2rad(_SCATTER_DEG * float(draw.generator.normal()))
        profile = np.deg2rad(angle) * _step_and_decay(along - shape.STEP_MM * (fork.index - first), radius[at])
        angles += profile[:, None] * np.array([np.cos(azimuth), np.sin(azimuth)])
    angles[along < 0] = 0.0
    return angles[:, :1] * two - angles[:, 1:] * one


def _waves(draw: Draw, along: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    low, high = draw.population.waves_deg
    amplitude = np.deg2rad(np.exp(draw.generator.uniform(np.log(low), np.log(high))))
    shortest, longest = draw.population.waves_mm
    wavelength = np.exp(draw.generator.uniform(np.log(shortest), np.log(longest), 8))
    phase = draw.generator.uniform(0, 2 * np.pi, (8, 2))
    weight = draw.generator.normal(size=(8, 2)) * np.sqrt(wavelength / wavelength.max())[:, None]
    weight = weight / np.sqrt((weight**2).sum(axis=0) / 2)
    waves = np.sum(weight * np.sin(2 * np.pi * along[:, None, None] / wavelength[:, None] + phase), axis=1)
    return amplitude * waves * np.clip(along / _QUIET_MM, 0.0, 1.0)[:, None]


def _step_and_decay(along: Float[np.ndarray, "n"], wide: float) -> Float[np.ndarray, "n"]:
    """Return a smooth step over the lumen's width at 0 that dies out behind it."""
    return 0.5 * (1 + np.tanh(along / (0.8 * wide))) * np.exp(-np.maximum(along, 0.0) / _GIVES_WAY_MM)


def opened_fork(
    draw: Draw,
    trunk: Float[np.ndarray, "n 3"],
    other: Float[np.ndarray, "m 3"],
    fork: int,
    wide: float,
    turns_deg: tuple[Spread, Spread],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """Return a vessel that goes on behind a fork, and the one that leaves there, turned by `turns_deg` to opposite
    sides of what arrives. Directions are chords over two lumen radii (`wide`)."""
    reach = max(round(2 * wide / shape.STEP_MM), 2)
    arriving = _unit(trunk[fork] - trunk[max(fork - reach, 0)])
    across = _unit(trunk[fork + reach] - trunk[fork]) - _unit(other[reach] - other[0])
    across = _unit(across - (across @ arriving) * arriving)
    wanted = []
    for spread, sign in zip(turns_deg, (1.0, -1.0), strict=True):
        angle = np.deg2rad(drawn_from(draw, spread))
        tilt = Rotation.from_rotvec(np.deg2rad(12.0 * float(draw.generator.normal())) * arriving)
        wanted.append(np.cos(angle) * arriving + sign * np.sin(angle) * tilt.apply(across))
    behind = shape.STEP_MM * (np.arange(len(trunk) - 1) + 0.5 - fork)
    beside = shape.STEP_MM * (np.arange(len(other) - 1) + 0.5)
    own = _turned_to(trunk, fork, reach, wanted[0], _step_and_decay(behind - 0.4 * wide, 0.6 * wide))
    out = _turned_to(other, 0, reach, wanted[1], np.exp(-np.maximum(beside - 2 * wide, 0.0) / _GIVES_WAY_MM))
    return own, out + (own[fork] - out[0])


def _turned_to(
    points: Float[np.ndarray, "n 3"],
    at: int,
    reach: int,
    wanted: Float[np.ndarray, "3"],
    profile: Float[np.ndarray, "m"],
) -> Float[np.ndarray, "n 3"]:
    vector, moved = np.zeros(3), points
    for _ in range(4):
        now = _unit(moved[at + reach] - moved[at])
        axis = np.cross(now, wanted)
        size = float(np.linalg.norm(axis))
        if size > 1e-9:
            vector = vector + axis / size * np.arctan2(size, now @ wanted)
        moved = shape.turned(points, profile[:, None] * vector)
    return moved


def ectasia(draw: Draw, along: Float[np.ndarray, "n"]) -> tuple[list[dict[str, float]], Float[np.ndarray, "n"]]:
    """Return a widening by 40 to 100 % of the diameter over 10 to 30 mm where the patient has one, and its factor."""
    if draw.population.ectasia_share == 0 or draw.generator.random() > draw.population.ectasia_share:
        return [], np.ones(len(along))
    place = along[0] + draw.generator.uniform(0.15, 0.7) * (along[-1] - along[0])
    extent, degree = draw.generator.uniform(10.0, 30.0), draw.generator.uniform(0.4, 1.0)
    drawn = {"abscissa_mm": float(place), "length_mm": float(extent), "diameter_increase": float(degree)}
    return [drawn], 1 + degree * np.exp(-0.5 * ((along - place) / (extent / 4)) ** 2)


def flattened(draw: Draw, tree: VesselTree) -> list[tuple[Centerline, Centerline]]:
    """Return two lines of spheres beside each branch, which make its section longer than wide; none for round ones.
    They lie δ to either side, with radius √(r² + δ²): the own spheres stay inscribed. The direction turns along the
    vessel."""
    if draw.population.flattening[1] == 0:
        return []
    mean = float(draw.generator.uniform(*draw.population.flattening))
    longest = max(float(branch.centerline.abscissa[-1]) for branch in tree.branches)
    wavelength, phase = draw.generator.uniform(20.0, 70.0, 3), draw.generator.uniform(0, 2 * np.pi, 3)
    start, turns = float(draw.generator.uniform(0, np.pi)), float(draw.generator.normal(0.0, 1.5))
    beside = []
    for line in (branch.centerline for branch in tree.branches):
        waves = np.sin(2 * np.pi * line.abscissa[:, None] / wavelength + phase).sum(axis=1)
        share = mean * np.clip(1 + 0.35 * waves, 0.0, 2.0)
        # At forks the section belongs to both branches: it is left round.
        own = line.abscissa - line.abscissa[0]
        share = share * np.clip(own / 3.0, 0.0, 1.0) * np.clip((own[-1] - own) / 2.0, 0.0, 1.0)
        # A section r wide and r(1 + f) long: √(r² + δ²) + δ = r(1 + f) gives δ = r·f(2 + f)/2(1 + f).
        shift = line.radius * share * (2 + share) / (2 * (1 + share))
        angle = start + 2 * np.pi * turns * line.abscissa / longest + 0.5 * waves
        across = np.cross(shape.tangents(line.points), line.normals)
        direction = np.cos(angle)[:, None] * line.normals + np.sin(angle)[:, None] * across
        wide = np.sqrt(line.radius**2 + shift**2)
        one, two = (
            Centerline(line.points + sign * shift[:, None] * direction, wide, line.abscissa, line.normals)
            for sign in (1.0, -1.0)
        )
        beside.append((one, two))
    return beside


def catheter_direction(
    draw: Draw, tree: VesselTree, radius_mm: float, length_mm: float
) -> tuple[Float[np.ndarray, "3"], dict[str, Any]]:
    """Return the axis of a guiding catheter at the ostium, and its draws: at the drawn angle with the vessel 10 mm on,
    little turned away from its first direction, and clear of other lumens; else along the first direction."""
    first = shape.tangents(tree.branches[0].centerline.points)[0]
    if draw.population.catheter_deg is None:
        return first, {}
    path = tree.longest_path()
    at = min(int(np.searchsorted(path.abscissa, 10.0)), len(path.points) - 2)
    there = _unit(path.points[at + 1] - path.points[at - 1])
    across = first - (first @ there) * there
    across = _unit(across if np.linalg.norm(across) > 0.05 else path.normals[at])
    whole = tree.line
    beyond = whole.abscissa > 10.0 + 2.0 * float(path.radius[0])
    tube = np.linspace(2.0, length_mm, 60)
    angle = 0.0
    for attempt in range(5 * _TRIES):
        # An angle is given up only after a round of tries: else flat ones would be kept more often than steep ones.
        if attempt % _TRIES == 0:
            angle = np.deg2rad(drawn_from(draw, draw.population.catheter_deg))
        scatter = np.deg2rad((25.0 + 3.0 * attempt) * float(draw.generator.normal()))
        tilted = Rotation.from_rotvec(scatter * there).apply(across)
        direction = np.cos(angle) * there + np.sin(angle) * tilted
        line = path.points[0] - tube[:, None] * direction
        gap = np.linalg.norm(whole.points[beyond, None] - line, axis=2) - whole.radius[beyond, None] - radius_mm
        clear = gap.size == 0 or gap.min() > 0.0
        if clear and direction @ first > np.cos(np.deg2rad(_STEEPEST_DEG)):
            return direction, {"catheter_angle_deg": float(np.rad2deg(angle)), "catheter_redrawn": attempt}
    angle = np.arccos(np.clip(first @ there, -1.0, 1.0))
    return first, {"catheter_angle_deg": float(np.rad2deg(angle)), "catheter_redrawn": 5 * _TRIES}


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)
