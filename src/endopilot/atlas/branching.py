"""Trees of synthetic vessels: side branches that are drawn until they fit, and the cut into branches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from endopilot.atlas import curves as shape
from endopilot.atlas.population import Courses, Draw, Drawn
from endopilot.lines import length_along
from endopilot.types import Branch, Centerline, VesselTree

Depth = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]  # how deep points lie below the surface, mm
_CLEARANCE_MM = 0.6  # tissue between two lumens that do not belong together, mm: two walls
_BEND_MM = 4.0  # places of one vessel farther apart along it than this and twice their radii must not touch, mm


_RIGHT_SHARE, _BALANCED_SHARE = 0.88, 0.06  # shares of right and balanced dominance, within the literature's range
_FEMALE_CALIBRE = 0.91  # women's coronary lumens against men's (Dodge JT et al., Circulation 1992;86:232-46)


class NoShape(Exception):
    """The drawn shape is impossible, or lumens collide: draw again."""


@dataclass(frozen=True, eq=False)
class Vessel:
    """A vessel before it is cut at its branching points: evenly spaced points, LPS mm, with a section name each; the
    first is the point `origin` of the vessel `parent` (-1 for the first vessel)."""

    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    section: Sequence[str]
    parent: int = -1
    origin: int = 0


@dataclass(frozen=True)
class SidePlan:
    """A side branch to be drawn.

    Attributes:
        origin: index of the point of the vessel `parent` where it leaves; -1 for its end.
        courses: (abscissa from which it holds, mm; LPS direction), in order.
        taper: share of the diameter that is lost towards the end.
        angle_deg: range of the angle at which it leaves.
        depth: the surface that it follows; none for a branch that runs freely.
    """

    section: str
    origin: int
    length_mm: float
    diameter_mm: float
    courses: Courses
    parent: int = 0
    taper: float = 0.3
    angle_deg: tuple[float, float] = (40.0, 70.0)
    depth: Depth | None = field(default=None, compare=False)


def until_it_fits(what: str, draw: Callable[..., Drawn], *given: Any) -> Drawn:
    """Draw trees from what is given until one fits; its record states how many failed (`redrawn`), NoShape after 60."""
    for attempt in range(60):
        try:
            tree, drawn = draw(*given)
        except NoShape:
            continue
        return tree, drawn | {"redrawn": attempt}
    raise NoShape(f"no {what} found in 60 draws")


def truncated(draw: Draw, mean: float, sd: float, low: float, high: float) -> float:
    """Draw from a normal distribution cut off at both ends."""
    while True:
        value = draw.generator.normal(mean, sd)
        if low <= value <= high:
            return float(value)


def coronary_dominance(u: float) -> str:
    """Return right, balanced or left dominance for a number between 0 and 1."""
    return "right" if u < _RIGHT_SHARE else "balanced" if u < _RIGHT_SHARE + _BALANCED_SHARE else "left"


def coronary_calibre(draw: Draw, mean: float, low: float, high: float) -> float:
    """Draw a patient's coronary lumen against the average, by sex."""
    sex = _FEMALE_CALIBRE if draw.generator.random() < 0.5 else 1.0
    return float(np.clip(mean * sex / (0.5 + 0.5 * _FEMALE_CALIBRE) * (1 + 0.1 * draw.generator.normal()), low, high))


def free_origin(draw: Draw, mean_mm: float, sd_mm: float, taken: Sequence[int]) -> int:
    """Draw the index of a branch's origin, 3 mm or more from the vessel's start and from other origins."""
    while True:
        drawn = truncated(draw, mean_mm, sd_mm, max(mean_mm - 2 * sd_mm, 3.0), mean_mm + 2 * sd_mm)
        origin = round(drawn / shape.STEP_MM)
        if all(abs(origin - other) * shape.STEP_MM >= 3.0 for other in taken):
            return origin


def stenoses(
    draw: Draw, along: Float[np.ndarray, "n"], shares: tuple[float, float]
) -> tuple[list[dict[str, Any]], Float[np.ndarray, "n"]]:
    """Return a narrowing of 30 to 65 % of the diameter over 6 to 14 mm within `shares`, by `tandem_share` a second one
    12 to 40 mm from it where there is room, and the radius's factor."""
    found, share = list[tuple[dict[str, Any], np.ndarray]](), draw.population.tandem_share
    for attempt in range(11):
        place = along[0] + draw.generator.uniform(*shares) * (along[-1] - along[0])
        extent, degree = draw.generator.uniform(6.0, 14.0), draw.generator.uniform(0.3, 0.65)
        drawn = {"abscissa_mm": float(place), "length_mm": float(extent), "diameter_reduction": float(degree)}
        narrowing = 1 - degree * np.exp(-0.5 * ((along - place) / (extent / 4)) ** 2)
        if attempt == 0 or 12.0 < abs(drawn["abscissa_mm"] - found[0][0]["abscissa_mm"]) < 40.0:
            found.append((drawn, narrowing))
        if len(found) == 2 or (attempt == 0 and (share == 0 or draw.generator.random() > share)):
            break
    return [drawn for drawn, _ in found], np.prod([narrowing for _, narrowing in found], axis=0)


def narrowed(
    draw: Draw,
    vessels: Sequence[Vessel],
    index: int,
    shares: tuple[float, float],
) -> tuple[list[dict[str, Any]], list[Vessel]]:
    """Return the stenoses of one vessel (abscissa from the ostium, and section), and the vessels with them; the mouths
    of its branches, which lie in its lumen, narrow with it."""
    vessel = vessels[index]
    along, above = length_along(vessel.points), vessel
    while above.parent >= 0:
        parent = vessels[above.parent]
        along = along + length_along(parent.points)[above.origin]
        above = parent
    drawn, factor = stenoses(draw, along, shares)
    found = [one | {"section": vessel.section[int(np.searchsorted(along, one["abscissa_mm"]))]} for one in drawn]
    changed = []
    for i, other in enumerate(vessels):
        scale = factor if i == index else np.ones(len(other.radius))
        if other.parent == index:
            inside = np.exp(-((length_along(other.points) / vessel.radius[other.origin]) ** 2))
            scale = factor[other.origin] * inside + (1 - inside)
        changed.append(replace(other, radius=other.radius * scale))
    return found, changed


def wiggled(
    draw: Draw,
    points: Float[np.ndarray, "n 3"],
    amplitude_mm: tuple[float, float],
    *,
    quiet_mm: float,
    wavelengths_mm: tuple[float, float] = (13.0, 60.0),
) -> Float[np.ndarray, "m 3"]:
    """Return an evenly spaced curve with a smooth random displacement; its first `quiet_mm` fade in."""
    wiggle = shape.Wiggle.draw(draw.generator, *wavelengths_mm)
    normals = shape.parallel_normals(shape.tangents(points))
    moved = wiggle.apply(points, normals, draw.generator.uniform(*amplitude_mm), quiet_mm)
    return shape.curve_through(moved[::4])


def uneven(draw: Draw, along: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the factor on a lumen's radius by which real vessels vary along their length: waves of 2.5 %."""
    wavelength = draw.generator.uniform(15.0, 60.0, 4)
    waves = np.sin(2 * np.pi * along[:, None] / wavelength + draw.generator.uniform(0, 2 * np.pi, 4)).sum(axis=1)
    return 1 + 0.025 * waves


def with_side_branches(draw: Draw, vessels: Sequence[Vessel], plans: Sequence[SidePlan]) -> list[Vessel]:
    """Return the vessels with the planned branches, drawn up to twelve times until none cuts another lumen; over
    `carina_mm` behind a fork and twice their radii they may touch. Raises NoShape where a branch found no place."""
    grown, carina_mm = list(vessels), draw.population.carina_mm
    if not plans and lumens_collide(grown, carina_mm):
        raise NoShape
    for plan in plans:
        for _ in range(12):
            side = _side_branch(draw, grown[plan.parent], plan)
            if not lumens_collide([*grown, side], carina_mm):
                grown.append(side)
                break
        else:
            raise NoShape
    return grown


def _side_branch(draw: Draw, parent: Vessel, plan: SidePlan) -> Vessel:
    origin = plan.origin % len(parent.points)
    start, wide = parent.points[origin], float(parent.radius[origin])
    turn = Rotation.from_rotvec(np.deg2rad(draw.generator.normal(0, 12, 3)))
    headed = [(begin, turn.apply(np.array(course) / np.linalg.norm(course))) for begin, course in plan.courses]
    forward = shape.tangents(parent.points)[origin]
    across = headed[0][1] - (headed[0][1] @ forward) * forward
    angle = np.deg2rad(draw.generator.uniform(*plan.angle_deg))
    direction = np.cos(angle) * forward + np.sin(angle) * across / np.linalg.norm(across)
    points = shape.steer(start, direction, headed, plan.length_mm, draw.generator.uniform(6.0, 9.0), plan.depth)
    across = shape.parallel_normals(shape.tangents(points))
    points = shape.Wiggle.draw(draw.generator, 13.0, 45.0, 6).apply(
        points, across, draw.generator.uniform(0.3, 0.8), 10.0
    )
    points = shape.curve_through(points[:: max(len(points) // 24, 1)])
    points = np.concatenate([start[None], points[1:]])
    lumen = 0.5 * plan.diameter_mm * (1 - plan.taper * np.linspace(0.0, 1.0, len(points)))
    lumen = mouth(np.minimum(lumen, 0.9 * wide), points, forward, wide)
    return Vessel(points, lumen, [plan.section] * len(points), plan.parent, origin)


def mouth(
    radius: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "n 3"],
    parent_direction: Float[np.ndarray, "3"],
    parent_radius: float,
) -> Float[np.ndarray, "n"]:
    """Return a branch's radius with its mouth: inside the parent's lumen the inscribed sphere is the parent's, less the
    distance from the parent's axis; a smooth maximum rounds the carina."""
    away = points - points[0]
    off_axis = np.linalg.norm(away - (away @ parent_direction)[:, None] * parent_direction, axis=1)
    inside = parent_radius - off_axis
    smooth = np.logaddexp(6.0 * radius, 6.0 * inside) / 6.0
    far = off_axis > 2 * parent_radius
    smooth = np.where(far, radius, np.minimum(smooth, parent_radius))
    smooth[0] = parent_radius
    return smooth


def build_tree(vessels: Sequence[Vessel], section_names: tuple[str, ...]) -> VesselTree:
    """Cut vessels, parents first, at their branching points; branches are in the order in which they leave, and
    `section_names` in that which numbers them."""
    number = {name: i for i, name in enumerate(section_names)}
    branches: list[Branch] = []

    def grow(index: int, parent: int, before_mm: float, normal: Float[np.ndarray, "3"] | None) -> None:
        vessel = vessels[index]
        along = before_mm + length_along(vessel.points)
        normals = shape.parallel_normals(shape.tangents(vessel.points), normal)
        labels = np.array([number[name] for name in vessel.section])
        children = [i for i, other in enumerate(vessels) if other.parent == index]
        begin = 0
        for end in sorted({vessels[i].origin for i in children} | {len(vessel.points) - 1}):
            if end > begin:
                piece = slice(begin, end + 1)
                label = labels[piece].copy()
                label[0] = label[1]
                line = Centerline(vessel.points[piece], vessel.radius[piece], along[piece], normals[piece])
                branches.append(Branch(line, parent, label))
                parent, begin = len(branches) - 1, end
            for child in children:
                if vessels[child].origin == end:
                    grow(child, parent, float(along[end]), normals[end])

    grow(0, -1, 0.0, None)
    return VesselTree(tuple(branches), section_names)


def lumens_collide(vessels: Sequence[Vessel], carina_mm: float = _BEND_MM) -> bool:
    """Return whether lumens touch far apart along the tree: beyond `carina_mm` and twice their radii behind a fork."""
    points = np.concatenate([vessel.points for vessel in vessels])
    radii = np.concatenate([vessel.radius for vessel in vessels])
    place = np.concatenate([length_along(vessel.points) for vessel in vessels])
    owner = np.repeat(np.arange(len(vessels)), [len(vessel.points) for vessel in vessels])
    near = KDTree(points).query_pairs(2 * radii.max() + _CLEARANCE_MM, output_type="ndarray")
    reach = radii[near].sum(axis=1)
    gap = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1) - reach
    near, reach = near[gap < _CLEARANCE_MM], reach[gap < _CLEARANCE_MM]
    common, entry, beyond = _meetings(vessels)
    paths = []
    for one, two in (near.T, near.T[::-1]):
        pair = owner[one], owner[two]
        direct = common[pair] == owner[one]
        paths.append((np.where(direct, place[one], entry[pair]), np.where(direct, 0.0, beyond[pair] + place[one])))
    distance = np.abs(paths[0][0] - paths[1][0]) + paths[0][1] + paths[1][1]
    same = owner[near[:, 0]] == owner[near[:, 1]]
    return bool(np.any(distance > 2.2 * reach + np.where(same, _BEND_MM, carina_mm)))


def _meetings(vessels: Sequence[Vessel]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each pair of vessels a, b the vessel that their paths to the root meet on, the place (mm) where a's
    path enters it, and the length of a's path between the vessel a itself and that place, mm."""
    lengths = [length_along(vessel.points) for vessel in vessels]
    paths: list[dict[int, tuple[float, float]]] = []
    for vessel in vessels:
        path, beyond = {}, 0.0
        while vessel.parent >= 0:
            entry = float(lengths[vessel.parent][vessel.origin])
            path[vessel.parent] = (entry, beyond)
            beyond += entry
            vessel = vessels[vessel.parent]
        paths.append(path)
    count = len(vessels)
    common, entry, beyond = np.zeros((count, count), dtype=np.int64), np.zeros((count, count)), np.zeros((count, count))
    for a in range(count):
        for b in range(count):
            meeting = next(vessel for vessel in (a, *paths[a]) if vessel in (b, *paths[b]))
            common[a, b] = meeting
            entry[a, b], beyond[a, b] = paths[a].get(meeting, (0.0, 0.0))
    return common, entry, beyond
