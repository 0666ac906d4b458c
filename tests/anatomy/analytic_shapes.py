"""Analytic lumens for the anatomy tests: tubes whose axis, radius and wall are known in closed form."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from endopilot.anatomy.tree import make_centerline
from endopilot.types import Branch, LumenMask, VesselTree, Volume

BEND_MM = 20.0


def torus_distance(points: np.ndarray, radius: float) -> np.ndarray:
    """Signed distance to a torus around z with bend radius `BEND_MM`, positive inside."""
    return radius - np.hypot(np.hypot(points[..., 0], points[..., 1]) - BEND_MM, points[..., 2])


def mask_of(
    distance: Callable[[np.ndarray], np.ndarray], half_mm: tuple[float, float, float], spacing: tuple, rotation=None
) -> LumenMask:
    """Sample a signed distance on voxels centred at the origin, perhaps on rotated axes."""
    rotation = np.eye(3) if rotation is None else rotation
    size = np.array(spacing, dtype=float)
    count = np.ceil(2 * np.array(half_mm) / size).astype(int)
    origin = -rotation @ (size * (count - 1) / 2)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1).transpose(2, 1, 0, 3)
    empty = Volume(np.zeros(count[::-1], dtype=bool), size, origin, rotation)
    voxels = distance(empty.index_to_world(index.astype(float))) > 0
    return LumenMask(Volume(voxels, size, origin, rotation))


def line(points, radius) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(points, dtype=float)
    return points, np.broadcast_to(np.asarray(radius, dtype=float), len(points)).copy()


def forked_tree(angle_deg: float = 60.0, radius: tuple[float, float] = (2.0, 1.3)) -> VesselTree:
    """A straight vessel of 40 mm along z whose branch leaves at 20 mm in the xz plane."""
    angle = np.deg2rad(angle_deg)
    along = np.linspace(0.0, 20.0, 41)
    root = make_centerline(*line(np.outer(along, [0, 0, 1]), radius[0]))
    onwards = make_centerline(*line(np.array([0.0, 0.0, 20.0]) + np.outer(along, [0, 0, 1]), radius[0]), 20.0)
    aside_points, aside_radius = line(
        np.array([0.0, 0.0, 20.0]) + np.outer(along, [np.sin(angle), 0, np.cos(angle)]), radius[1]
    )
    aside_radius[0] = radius[0]
    aside = make_centerline(aside_points, aside_radius, 20.0)
    section = np.zeros(41, dtype=np.int64)
    return VesselTree((Branch(root, -1, section), Branch(onwards, 0, section), Branch(aside, 0, section)), ("vessel",))


def tree_distance(tree: VesselTree, points: np.ndarray) -> np.ndarray:
    """Signed distance to the union of a tree's tubes of piecewise constant radius, by brute force over its points."""
    result = np.full(points.shape[:-1], -np.inf)
    for branch in tree.branches:
        radius = branch.centerline.radius[-1]
        corners = branch.centerline.points[:: len(branch.centerline.points) - 1]  # the branches are straight
        for start, end in itertools.pairwise(corners):
            axis = end - start
            share = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
            result = np.maximum(result, radius - np.linalg.norm(points - start - share[..., None] * axis, axis=-1))
    return result
