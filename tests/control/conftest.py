"""A straight vessel of 40 mm with a side branch at 60°, and what drives a wire through it."""

from __future__ import annotations

import numpy as np
import pytest

SPACING_MM = 0.4


@pytest.fixture(scope="session")
def fork():
    """Return the vessel: 1 mm in radius along z, a branch of 0.8 mm that leaves after 20 mm, the ostium at 0."""
    from endopilot.anatomy.analytic import forked_tree, tree_distance
    from endopilot.types import Anatomy, DistanceMap, Insertion

    tree = forked_tree(radius=(1.0, 0.8))
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
        insertion=Insertion(np.zeros(3), np.array([0.0, 0.0, 1.0])),
        catheter_radius_mm=0.9,
    )


@pytest.fixture(scope="session")
def wire():
    """Return the workhorse wire."""
    from endopilot.simulation.device import read_device

    return read_device("workhorse-014")


@pytest.fixture(scope="session")
def vessel(fork, tmp_path_factory):
    """Return the folder of the vessel."""
    from endopilot.anatomy.io import write_anatomy

    folder = tmp_path_factory.mktemp("vessel") / "fork"
    write_anatomy(fork, folder)
    return folder


@pytest.fixture(scope="session")
def found(vessel):
    """Return a plan along the vessel, made by trial in the rod core."""
    from endopilot.control.plan import PlanConfig, plan

    return plan(vessel, "0,0,33", PlanConfig(seconds=30.0, start_rotation=0.1, seed=4))
