"""The guiding catheter's axis at the ostium, turned, and φ's zero with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.distance import add_catheter
from endopilot.anatomy.tree import cross_axes
from endopilot.types import Anatomy, Insertion


def turned_axis(axis: Float[np.ndarray, "3"], tilt_deg: float, side_deg: float) -> Float[np.ndarray, "3"]:
    """Return an axis turned by `tilt_deg` to the side `side_deg`, degrees about it from the first `cross_axes`."""
    one, two = (side[0] for side in cross_axes(axis[None]))
    tilt, side = np.radians(tilt_deg), np.radians(side_deg)
    return np.cos(tilt) * axis + np.sin(tilt) * (np.cos(side) * one + np.sin(side) * two)


def lean_between(axis: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return by how much and to which side another axis leans off this one, as `turned_axis` takes both, degrees."""
    first, second = (float(other @ side[0]) for side in cross_axes(axis[None]))
    tilt, side = np.arctan2(np.hypot(first, second), other @ axis), np.arctan2(second, first)
    return float(np.degrees(tilt)), float(np.degrees(side))


def carried(
    across: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return where the shortest turn between axes takes a vector across the first; it stays if they are opposite."""
    cosine = float(axis @ other)
    turned = across - (across @ other) / (1.0 + cosine) * (axis + other) if cosine > -1 + 1e-12 else across
    turned = turned - (turned @ other) * other
    return turned / np.linalg.norm(turned)


def with_axis(anatomy: Anatomy, axis: Float[np.ndarray, "3"]) -> Anatomy:
    """Return the anatomy with its catheter, and φ's zero, turned about the ostium; its old way stays open."""
    zero = anatomy.insertion.rotation_zero
    if isinstance(zero, np.ndarray):
        zero = carried(zero, anatomy.insertion.direction, axis)
    insertion = Insertion(anatomy.insertion.position, axis, zero)
    opened = add_catheter(anatomy.distance_map, insertion, anatomy.catheter_radius_mm)
    return replace(anatomy, distance_map=opened, insertion=insertion)


def with_world_zero(anatomy: Anatomy) -> Anatomy:
    """Return the anatomy with φ's zero by the world's axes, as before anatomies held one, for controls of then."""
    return replace(anatomy, insertion=replace(anatomy.insertion, rotation_zero="world axes"))
