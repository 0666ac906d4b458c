"""Shapes that synthetic vessels are made of: smooth curves, lumens that taper, trees that do not cut themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from endopilot.types import Branch, Centerline, VesselTree

STEP_MM = 0.5
"""Distance between neighbouring centerline points, mm."""

_CLEARANCE_MM = 0.6
"""Tissue between two lumens that do not belong together, mm: two walls."""


_HEIGHT_MM = 3.0
"""Side branches run this far above the surface that they follow, mm: in epicardial fat."""


@dataclass(frozen=True, eq=False)
class SideBranch:
    """A vessel that leaves the main vessel.

    Attributes:
        origin: index of the main vessel's point where it leaves.
        points: positions, LPS mm; the first one is that point.
        radius: lumen radius, mm.
        section: name of its anatomical section.
    """

    origin: int
    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    section: str


def abscissa(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the length along a polyline up to each point, mm."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def curve_through(waypoints: Float[np.ndarray, "n 3"], step_mm: float = STEP_MM) -> Float[np.ndarray, "m 3"]:
    """Return points about `step_mm` apart, evenly spaced, on the cubic spline through `waypoints`."""
    spline = CubicSpline(abscissa(waypoints), waypoints)
    dense = spline(np.linspace(0.0, spline.x[-1], 4 * round(spline.x[-1] / step_mm) + 1))
    length = abscissa(dense)
    even = np.linspace(0.0, length[-1], round(length[-1] / step_mm) + 1)
    return CubicSpline(length, dense)(even)


def tangents(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit tangents of a curve given by evenly spaced points."""
    tangent = np.gradient(points, axis=0, edge_order=2)
    return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def curvature(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the curvature of a curve given by evenly spaced points, 1/mm."""
    spacing = abscissa(points)[-1] / (len(points) - 1)
    return np.linalg.norm(np.gradient(tangents(points), spacing, axis=0), axis=1)


def tortuosity(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the length of a curve divided by the distance between its ends."""
    return float(abscissa(points)[-1] / np.linalg.norm(points[-1] - points[0]))


def parallel_normals(
    tangent: Float[np.ndarray, "n 3"], first: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors perpendicular to the tangents, carried along without twist.

    Args:
        tangent: unit tangents.
        first: direction that the first normal takes as nearly as it can.
    """
    start = np.eye(3)[np.argmin(np.abs(tangent[0]))] if first is None else first
    normals = np.empty_like(tangent)
    for i in range(len(tangent)):
        normal = start - (start @ tangent[i]) * tangent[i]
        start = normals[i] = normal / np.linalg.norm(normal)
    return normals


def bend(points: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"], angle_rad: float) -> Float[np.ndarray, "n 3"]:
    """Turn the tangents of a curve about `axis`, in proportion to the way along it, by `angle_rad` at its end."""
    share = (np.arange(len(points) - 1) + 0.5) / (len(points) - 1)
    steps = Rotation.from_rotvec(angle_rad * share[:, None] * axis).apply(np.diff(points, axis=0))
    return np.concatenate([points[:1], points[0] + np.cumsum(steps, axis=0)])


@dataclass(frozen=True, eq=False)
class Wiggle:
    """A smooth random displacement along a curve: a sum of sines of random wavelength and phase.

    Amplitudes grow as the wavelength to the power 1.5, so that no single wavelength rules the curvature.

    Attributes:
        wave_number: 1/mm, one a mode.
        phase: rad, one a mode and normal direction.
        weight: mm, one a mode and normal direction.
    """

    wave_number: Float[np.ndarray, "modes"]
    phase: Float[np.ndarray, "modes 2"]
    weight: Float[np.ndarray, "modes 2"]

    @classmethod
    def draw(cls, generator: np.random.Generator, shortest_mm: float, longest_mm: float, modes: int = 10) -> Wiggle:
        """Draw a displacement of about 1 mm whose wavelengths lie between the two bounds, mm."""
        wavelength = np.exp(generator.uniform(np.log(shortest_mm), np.log(longest_mm), modes))
        weight = generator.normal(size=(modes, 2)) * ((wavelength / longest_mm) ** 1.5)[:, None]
        return cls(2 * np.pi / wavelength, generator.uniform(0, 2 * np.pi, (modes, 2)), weight)

    def apply(
        self, points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], amplitude: float, quiet_mm: float
    ) -> Float[np.ndarray, "n 3"]:
        """Displace a curve across its direction; the first `quiet_mm` mm fade in, so that the start keeps its place.

        `normal` holds unit vectors across the curve that turn smoothly along it.
        """
        tangent = tangents(points)
        along = abscissa(points)
        sines = np.sin(along[:, None, None] * self.wave_number[:, None] + self.phase)
        offset = amplitude * np.sum(self.weight * sines, axis=1)
        fade = np.clip(along / quiet_mm, 0.0, 1.0)
        offset *= (fade**3 * (10 - 15 * fade + 6 * fade**2))[:, None]
        return points + offset[:, :1] * normal + offset[:, 1:] * np.cross(tangent, normal)


def steer(
    start: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    courses: Sequence[tuple[float, Float[np.ndarray, "3"]]],
    length_mm: float,
    relaxation_mm: float,
    depth: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]],
) -> Float[np.ndarray, "n 3"]:
    """Return a smooth curve that leaves `start` along `direction` and follows one course after another on a surface.

    Args:
        start: first point, LPS mm.
        direction: unit tangent there.
        courses: (abscissa from which it holds, mm; unit direction), in order.
        length_mm: length of the curve.
        relaxation_mm: way over which the direction approaches the course by a factor e.
        depth: how deep points lie below the surface, mm; the curve seeks a height of `_HEIGHT_MM` above it.
    """
    count = max(round(length_mm / STEP_MM), 8)
    heading, aim, rise, outward = direction, direction, 0.0, direction
    points = [start]
    probes = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    for i in range(count):
        course = [vector for begin, vector in courses if i * STEP_MM >= begin][-1]
        if i % 2 == 0:
            below = depth(points[-1] + 3.0 * heading + probes)
            outward = below[0] - below[1:]
            outward = outward / max(float(np.linalg.norm(outward)), 1e-6)
            rise = np.clip((below[0] + _HEIGHT_MM) / 4.0, -0.6, 1.2)
        course = course - min(float(course @ outward), 0.0) * outward + rise * outward
        # Two relaxations in a row keep the curvature continuous where the course changes.
        aim = aim + (course / np.linalg.norm(course) - aim) * (2 * STEP_MM / relaxation_mm)
        heading = heading + (aim - heading) * (2 * STEP_MM / relaxation_mm)
        heading = heading / np.linalg.norm(heading)
        points.append(points[-1] + STEP_MM * heading)
    return np.array(points)


def mouth(
    radius: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "n 3"],
    parent_direction: Float[np.ndarray, "3"],
    parent_radius: float,
) -> Float[np.ndarray, "n"]:
    """Return a branch's radius with its mouth: inside the parent's lumen the inscribed sphere is the parent's.

    The distance from the parent's axis eats up that sphere; a smooth maximum rounds the carina.
    """
    away = points - points[0]
    off_axis = np.linalg.norm(away - (away @ parent_direction)[:, None] * parent_direction, axis=1)
    inside = parent_radius - off_axis
    smooth = np.logaddexp(6.0 * radius, 6.0 * inside) / 6.0
    far = off_axis > 2 * parent_radius
    smooth = np.where(far, radius, np.minimum(smooth, parent_radius))
    smooth[0] = parent_radius
    return smooth


def build_tree(
    main: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    section: Sequence[str],
    sides: Sequence[SideBranch],
    section_names: tuple[str, ...],
) -> VesselTree:
    """Cut the main vessel at its branching points and hang the side branches there.

    Args:
        main: the main vessel, evenly spaced, LPS mm.
        radius: its lumen radius, mm.
        section: name of the section at each of its points.
        sides: side branches, each at an origin of its own.
        section_names: all names, in the order that numbers them.
    """
    number = {name: i for i, name in enumerate(section_names)}
    along, tangent = abscissa(main), tangents(main)
    normals = parallel_normals(tangent)
    labels = np.array([number[name] for name in section])
    ordered = sorted(sides, key=lambda side: side.origin)
    branches: list[Branch] = []
    parent, begin = -1, 0
    for side in [*ordered, None]:
        end = side.origin if side is not None else len(main) - 1
        if end == begin:
            break
        piece = slice(begin, end + 1)
        label = labels[piece].copy()
        label[0] = label[1]
        line = Centerline(main[piece], radius[piece], along[piece], normals[piece])
        branches.append(Branch(line, parent, label))
        parent, begin = len(branches) - 1, end
        if side is not None:
            line = Centerline(
                side.points,
                side.radius,
                along[end] + abscissa(side.points),
                parallel_normals(tangents(side.points), normals[end]),
            )
            branches.append(Branch(line, parent, np.full(len(side.points), number[side.section])))
    return VesselTree(tuple(branches), section_names)


def lumens_collide(main: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], sides: Sequence[SideBranch]) -> bool:
    """Tell whether lumens touch that lie far apart along the tree."""
    points = np.concatenate([main, *(side.points for side in sides)])
    radii = np.concatenate([radius, *(side.radius for side in sides)])
    main_place = np.concatenate([np.arange(len(main)), *(np.full(len(s.points), s.origin) for s in sides)]) * STEP_MM
    side_place = np.concatenate([np.zeros(len(main)), *(abscissa(s.points) for s in sides)])
    owner = np.repeat(np.arange(len(sides) + 1), [len(main), *(len(s.points) for s in sides)])
    near = KDTree(points).query_pairs(2 * radii.max() + _CLEARANCE_MM, output_type="ndarray")
    a, b = near[:, 0], near[:, 1]
    way = np.where(
        owner[a] == owner[b],
        np.abs(main_place[a] - main_place[b]) + np.abs(side_place[a] - side_place[b]),
        np.abs(main_place[a] - main_place[b]) + side_place[a] + side_place[b],
    )
    reach = radii[a] + radii[b]
    gap = np.linalg.norm(points[a] - points[b], axis=1) - reach
    return bool(np.any((way > 2.2 * reach + 4.0) & (gap < _CLEARANCE_MM)))
