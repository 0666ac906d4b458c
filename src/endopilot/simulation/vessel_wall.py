"""The wall of an anatomy for the core: the distance map, on a finer grid where it is too coarse for wide catheters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from endopilot.anatomy.distance import CATHETER_LENGTH_MM
from endopilot.devices.stack import Stack
from endopilot.simulation.config import FREE_BEHIND_MM, SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.processor import Lumen
from endopilot.types import Anatomy, DistanceMap, VesselTree

FINE_MM = 0.2
"""Spacing of a finer grid, mm, at most: a tube's axis then reads at most 0.1 mm too near to the wall."""

_APART_MM = 0.1
"""Distance between the points of the guiding catheter's axis that are looked at, mm."""


def make_wall(anatomy: Anatomy, stack: Stack, config: SimulatorConfig) -> Lumen:
    """Return an anatomy's wall as the core wants it.

    A spline rounds the ridge off that the distance to the wall has on a vessel's axis, by up to half the map's spacing.
    To a catheter hardly narrower than the vessel or the guiding catheter, the wall then seems to leave no room where
    there is some. For those the spline's grid is finer, and the inscribed spheres of the centerline and the guiding
    catheter make it sharp.

    Args:
        anatomy: the vessel.
        stack: the wire, and the catheters around it.
        config: settings of the rod core.
    """
    radius_mm = stack.outer_radius_mm
    field = _stiffened(anatomy, radius_mm, config.wall_along) if config.wall_along else anatomy.distance_map
    wall = make_lumen(field, radius_mm, config.processor, far_mm=config.wall_reach_mm)
    if not stack.catheters or _leaves_room(wall, anatomy, radius_mm):
        return wall
    return make_lumen(
        field,
        radius_mm,
        config.processor,
        far_mm=config.wall_reach_mm,
        finer=max(2, math.ceil(field.spacing_mm / FINE_MM)),
        spheres=_inscribed_spheres(wall, anatomy),
    )


def factor_at(
    abscissa_mm: Float[np.ndarray, "*n"], tree: VesselTree, factors: Sequence[float]
) -> Float[np.ndarray, "*n"]:
    """Return a factor that varies along a vessel.

    Args:
        abscissa_mm: where, along the path from the ostium; behind it, in the guiding catheter, the first counts.
        tree: centerlines.
        factors: at even distances from the ostium to the end of the longest path, linear between.
    """
    ends = np.linspace(0.0, float(tree.longest_path().abscissa[-1]), len(factors)) if len(factors) > 1 else [0.0]
    return np.interp(abscissa_mm, ends, factors)


def _stiffened(anatomy: Anatomy, radius_mm: float, factors: Sequence[float]) -> DistanceMap:
    """Return a map by which the wall is softer than where it is stiffest, as `factor_at` has it.

    A spring K d²/2 of depth d is c² times as stiff where the map gives c d: distances from where a device touches the
    wall are multiplied by the root of the factor over the largest one. So none grows, for the core takes a wall to be
    as far as the map says; the largest factor is the core's own stiffness (`core_options`).
    """
    field, tree = anatomy.distance_map, anatomy.tree
    lines = [branch.centerline for branch in tree.branches]
    nearest = KDTree(np.concatenate([line.points for line in lines]))
    abscissa, values = np.concatenate([line.abscissa for line in lines]), field.values.copy()
    where = np.argwhere(values > values.min())
    _, at = nearest.query(field.origin_mm + field.spacing_mm * where[:, ::-1])
    root, place = np.sqrt(factor_at(abscissa[at], tree, factors) / max(factors)), tuple(where.T)
    values[place] = np.maximum(radius_mm + root * (values[place] - radius_mm), values.min())
    return replace(field, values=values)


def _leaves_room(wall: Lumen, anatomy: Anatomy, radius_mm: float) -> bool:
    """Return whether a device finds room on the axis wherever vessel and guiding catheter are wider than it."""
    behind = np.arange(-FREE_BEHIND_MM, _APART_MM / 2, _APART_MM)
    axis = anatomy.insertion.position + behind[:, None] * anatomy.insertion.direction
    lines = [(axis, np.full(len(axis), anatomy.catheter_radius_mm))]
    lines += [(branch.centerline.points, branch.centerline.radius) for branch in anatomy.tree.branches]
    return not any(np.any((radius > radius_mm) & (wall.distance(points) < radius_mm)) for points, radius in lines)


def _inscribed_spheres(wall: Lumen, anatomy: Anatomy) -> Float[np.ndarray, "lines 8"]:
    """Return the inscribed spheres along the centerlines and the guiding catheter's axis, as `make_lumen` takes them.

    None is wider than the wall, rounded off as it may be, allows.
    """
    rounded_off = 0.5 * anatomy.distance_map.spacing_mm
    lines = []
    for branch in anatomy.tree.branches:
        points = branch.centerline.points
        radius = np.fmin(branch.centerline.radius, wall.distance(points) + rounded_off)
        lines.append(np.column_stack([points[:-1], points[1:], radius[:-1], radius[1:]]))
    ostium, direction = anatomy.insertion.position, anatomy.insertion.direction
    guiding = [*(ostium - CATHETER_LENGTH_MM * direction), *ostium, *[anatomy.catheter_radius_mm] * 2]
    return np.concatenate([*lines, [guiding]])
