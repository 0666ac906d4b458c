"""A straight vessel of 40 mm with a side branch at 60°."""

from __future__ import annotations

import numpy as np

from benchmarks.anatomy.analytic_lumens import forked_tree, tree_distance
from endopilot.types import Anatomy, DistanceMap, Insertion

SPACING_MM = 0.4


def make_fork(radius: tuple[float, float] = (1.0, 0.8)) -> Anatomy:
    """Return the vessel: along z, with a branch that leaves after 20 mm, the ostium at 0.

    Args:
        radius: of the vessel and of the branch, mm.
    """
    tree = forked_tree(radius=radius)
    low, high = np.array([-4.0, -4.0, -26.0]), np.array([22.0, 4.0, 44.0])
    axes = [np.arange(a, b, SPACING_MM) for a, b in zip(low, high, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    grid = np.stack([x, y, z], axis=-1)
    catheter = np.where(grid[..., 2] < 1.0, 0.9 - np.hypot(grid[..., 0], grid[..., 1]), -1.0)
    inside = np.where(grid[..., 2] > 0, tree_distance(tree, grid), -1.0)
    values = np.maximum(np.maximum(inside, catheter), -1.0)
    return Anatomy(
        name="fork",
        tree=tree,
        distance_map=DistanceMap(values, SPACING_MM, low),
        # At φ = 0 a tip's bend points across the fork's plane.
        insertion=Insertion(np.zeros(3), np.array([0.0, 0.0, 1.0]), rotation_zero=np.array([0.0, -1.0, 0.0])),
        catheter_radius_mm=0.9,
    )
