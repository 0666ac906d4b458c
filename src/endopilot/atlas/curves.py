"""Curves that synthetic vessels are made of: smooth, wiggling, steered along a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from endopilot.lines import length_along

STEP_MM = 0.5  # distance between neighbouring centerline points, mm

_HEIGHT_MM = 3.0  # side branches run this far above the surface that they follow, mm: in epicardial fat


def curve_through(waypoints: Float[np.ndarray, "n 3"], step_mm: float = STEP_MM) -> Float[np.ndarray, "m 3"]:
    """Return points about `step_mm` apart, evenly spaced, on the cubic spline through `waypoints`."""
    spline = CubicSpline(length_along(waypoints), waypoints)
    dense = spline(np.linspace(0.0, spline.x[-1], 4 * round(spline.x[-1] / step_mm) + 1))
    length = length_along(dense)
    even = np.linspace(0.0, length[-1], round(length[-1] / step_mm) + 1)
    return CubicSpline(length, dense)(even)


def tangents(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit tangents of a curve given by evenly spaced points."""
    tangent = np.gradient(points, axis=0, edge_order=2)
    return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def curvature(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the curvature of a curve given by evenly spaced points, 1/mm."""
    spacing = length_along(points)[-1] / (len(points) - 1)
    return np.linalg.norm(np.gradient(tangents(points), spacing, axis=0), axis=1)


def tortuosity(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the length of a curve divided by the distance between its ends."""
    return float(length_along(points)[-1] / np.linalg.norm(points[-1] - points[0]))


def parallel_normals(
    tangent: Float[np.ndarray, "n 3"], first: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors perpendicular to the tangents, carried without twist from about the direction `first`."""
    start = np.eye(3)[np.argmin(np.abs(tangent[0]))] if first is None else first
    normals = np.empty_like(tangent)
    for i in range(len(tangent)):
        normal = start - (start @ tangent[i]) * tangent[i]
        start = normals[i] = normal / np.linalg.norm(normal)
    return normals


def bend(points: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"], angle_rad: float) -> Float[np.ndarray, "n 3"]:
    """Turn the tangents of a curve about `axis`, in proportion to the length along it, by `angle_rad` at its end."""
    share = (np.arange(len(points) - 1) + 0.5) / (len(points) - 1)
    return turned(points, angle_rad * share[:, None] * axis)


def turned(points: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the curve from the same start whose steps are turned, each by its rotation vector, rad."""
    steps = Rotation.from_rotvec(rotations).apply(np.diff(points, axis=0))
    return np.concatenate([points[:1], points[0] + np.cumsum(steps, axis=0)])


@dataclass(frozen=True, eq=False)
class Wiggle:
    """A smooth random displacement along a curve: a sum of sines of random wave number (1/mm) and phase, with weights
    in mm that grow as the wavelength to the power 1.5, so that no wavelength dominates the curvature."""

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
        """Displace a curve along smoothly turning unit normals; the start keeps its place: `quiet_mm` fade in."""
        tangent = tangents(points)
        along = length_along(points)
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
    depth: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]] | None,
) -> Float[np.ndarray, "n 3"]:
    """Return a smooth curve from `start` along `direction`, then along one course (abscissa from which it holds, mm,
    and unit direction) after another, each approached over `relaxation_mm`, `_HEIGHT_MM` above the surface that points
    lie `depth` below, mm."""
    count = max(round(length_mm / STEP_MM), 8)
    heading, aim, rise, outward = direction, direction, 0.0, np.zeros(3)
    points = [start]
    probes = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    for i in range(count):
        course = [vector for begin, vector in courses if i * STEP_MM >= begin][-1]
        if i % 2 == 0 and depth is not None:
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
