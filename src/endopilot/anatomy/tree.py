"""Building a `VesselTree` from single lines, and the differential geometry of a line."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from endopilot.lines import length_along, places_on
from endopilot.types import Branch, Centerline, VesselTree
from endopilot.vessels.graph import Line

SAMPLE_STEP_MM = 0.1  # distance of the points by which two trees are compared


def tree_from_lines(lines: list[Line]) -> VesselTree:
    """Return the tree of lines that leave each other, cut into branches, all in section 0, "vessel"."""
    branches: list[Branch] = []
    ends: dict[tuple[int, int], int] = {}
    for index, line in enumerate(lines):
        cuts = sorted({other.place for other in lines if other.parent == index} - {0, len(line.points) - 1})
        bounds = [0, *cuts, len(line.points) - 1]
        parent = ends[line.parent, line.place] if line.parent >= 0 else -1
        for start, end in itertools.pairwise(bounds):
            points, radius = line.points[start : end + 1].copy(), line.radius[start : end + 1].copy()
            before = branches[parent].centerline if parent >= 0 else None
            if before is not None:
                points[0], radius[0] = before.points[-1], before.radius[-1]
            first = 0.0 if before is None else float(before.abscissa[-1])
            centerline = make_centerline(points, radius, first, None if before is None else before.normals[-1])
            branches.append(Branch(centerline, parent, np.zeros(len(points), dtype=np.int64)))
            parent = len(branches) - 1
            ends[index, end] = parent
    return VesselTree(tuple(branches), ("vessel",))


def make_centerline(
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    first_abscissa: float = 0.0,
    first_normal: Float[np.ndarray, "3"] | None = None,
) -> Centerline:
    """Return a centerline (LPS mm, radii) with abscissa and parallel-transported `first_normal` (or any)."""
    abscissa = first_abscissa + length_along(points)
    return Centerline(points=points, radius=radius, abscissa=abscissa, normals=parallel_transport(points, first_normal))


def parallel_transport(
    points: Float[np.ndarray, "n 3"], first_normal: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return unit normals carried along a line without twist, by double reflection (Wang et al., ACM TOG 27, 2008)."""
    direction = tangents(points)
    normal = np.eye(3)[np.abs(direction[0]).argmin()] if first_normal is None else first_normal
    normal = normal - np.dot(normal, direction[0]) * direction[0]
    if np.linalg.norm(normal) < 1e-6:
        normal = np.eye(3)[np.abs(direction[0]).argmin()]
        normal = normal - np.dot(normal, direction[0]) * direction[0]
    normals = np.empty_like(points, dtype=float)
    normals[0] = normal / np.linalg.norm(normal)
    for i in range(len(points) - 1):
        chord = points[i + 1] - points[i]
        square = max(float(chord @ chord), 1e-24)
        reflected = normals[i] - 2.0 / square * (chord @ normals[i]) * chord
        turned = direction[i] - 2.0 / square * (chord @ direction[i]) * chord
        second = direction[i + 1] - turned
        square = float(second @ second)
        normal = reflected if square < 1e-24 else reflected - 2.0 / square * (second @ reflected) * second
        normal = normal - np.dot(normal, direction[i + 1]) * direction[i + 1]
        normals[i + 1] = normal / np.linalg.norm(normal)
    return normals


def tangents(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit tangents of a line: central differences, at both ends the chords' directions carried on."""
    direction = np.gradient(points, axis=0)
    if len(points) > 2:
        for end, inwards, third in ((0, 1, 2), (-1, -2, -3)):
            last, before = points[inwards] - points[end], points[third] - points[inwards]
            size = max(float(np.linalg.norm(last)), 1e-12), max(float(np.linalg.norm(before)), 1e-12)
            share = size[0] / (size[0] + size[1])
            outwards = (1.0 + share) * last / size[0] - share * before / size[1]
            direction[end] = outwards if end == 0 else -outwards
    return direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)


def sampled(tree: VesselTree) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return points and radii every 0.1 mm along all branches."""
    points, radius = [], []
    for branch in tree.branches:
        line = branch.centerline
        at = np.arange(line.abscissa[0], line.abscissa[-1], SAMPLE_STEP_MM)
        points.append(places_on(line.points, line.abscissa, at))
        radius.append(np.interp(at, line.abscissa, line.radius))
    return np.concatenate(points), np.concatenate(radius)


def resampled(points: Float[np.ndarray, "n 3"], step_mm: float) -> Float[np.ndarray, "m 3"]:
    """Return the line through `points` in equal steps of about `step_mm`, by a monotone cubic in its length."""
    from scipy.interpolate import PchipInterpolator

    distinct = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9])
    points = points[distinct]
    if len(points) < 2:
        return points
    length = length_along(points)
    count = max(2, round(length[-1] / step_mm) + 1)
    return np.asarray(PchipInterpolator(length, points, axis=0)(np.linspace(0.0, length[-1], count)))


def smoothed(points: Float[np.ndarray, "n d"], width: float) -> Float[np.ndarray, "n d"]:
    """Blur a line with a Gaussian of `width` samples that leaves its ends in place."""
    from scipy.ndimage import gaussian_filter1d

    extra = min(int(4 * width), len(points) - 1)
    head = 2 * points[0] - points[extra:0:-1]
    tail = 2 * points[-1] - points[-2 : -extra - 2 : -1]
    return gaussian_filter1d(np.concatenate([head, points, tail]), width, axis=0)[len(head) : len(head) + len(points)]


def cross_axes(direction: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return two unit vectors perpendicular to each direction and to each other."""
    helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(direction, one)
