"""The wall of an anatomy for the core: the distance map, on a finer grid where it is too coarse for wide catheters."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.distance import CATHETER_LENGTH_MM
from endopilot.devices.stack import Stack
from endopilot.simulation.config import FREE_BEHIND_MM, SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.processor import Lumen
from endopilot.types import Anatomy

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
    field, radius_mm = anatomy.distance_map, stack.outer_radius_mm
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
