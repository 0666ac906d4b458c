"""Anatomical sections for every point of a tree: AHA/SCCT segments, or generation and order.

Segments after Austen et al., Circulation 1975;51:5-40 (AHA) and Leipsic et al., J Cardiovasc Comput Tomogr
2014;8:342-58 (SCCT), by where a branch leaves and goes in LPS axes: other axes give wrong names, not an error.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from endopilot.anatomy.labels_coronary import NEAREST_CRUX_MM, label_lca, label_rca
from endopilot.anatomy.labels_tree import LCA_SECTIONS, RCA_SECTIONS, Labeller
from endopilot.types import Branch, VesselTree
from endopilot.vessels.coronary_ostia import Crux

_LOW = 0.39
"""A posterolateral branch that leaves this far under the fork of the left main, against the distance from there to the
apex, feeds the inferior wall (Dodge's CP)."""

Scheme = Literal["rca", "lca", "generic"]


def label_tree(tree: VesselTree, scheme: Scheme, *, crux: Crux | None = None) -> VesselTree:
    """Return the tree (LPS mm) with every point's section.

    Args:
        scheme: "rca" and "lca" name AHA/SCCT segments; "generic" names branches "G0", "G1.1", "G1.2", …: generation
            (bifurcations from the root), then order, widest first.
        crux: where the crux of the heart lies and which artery reaches it, if both are known.
    """
    if scheme == "generic":
        return _generic(tree)
    names, rules = (RCA_SECTIONS, label_rca) if scheme == "rca" else (LCA_SECTIONS, label_lca)
    sections = [np.zeros(len(branch.centerline.points), dtype=np.int64) for branch in tree.branches]
    rules(Labeller(tree, names, sections, crux))
    named = zip(tree.branches, sections, strict=True)
    return VesselTree(tuple(Branch(branch.centerline, branch.parent, own) for branch, own in named), names)


def dominance(tree: VesselTree) -> str | None:
    """Return "right", "balanced" or "left" for a labelled coronary tree, None for any other or an incomplete one.

    A right coronary with a posterolateral branch is right-dominant, with the posterior descending alone balanced, one
    that ends long before the crux left; a left one with a posterior descending branch left-dominant, with a branch to
    the inferior wall balanced.
    """
    used = set(tree.sections_present)
    if tree.section_names == RCA_SECTIONS:
        if not used & {"4", "16"}:
            return "left" if float(tree.longest_path().abscissa[-1]) < NEAREST_CRUX_MM else None
        return "right" if "16" in used else "balanced"
    if tree.section_names == LCA_SECTIONS:
        if not {"6", "11"} <= used:
            return None
        return "left" if "15" in used else "balanced" if _feeds_inferior_wall(tree) else "right"
    return None


def _feeds_inferior_wall(tree: VesselTree) -> bool:
    """Return whether a posterolateral branch of a left coronary tree leaves from the lower end of the groove."""
    number = {name: index for index, name in enumerate(tree.section_names)}
    fork = next((b.centerline.points[-1] for b in tree.branches if b.section[-1] == number["5"]), None)
    descending = [b.centerline.points for b in tree.branches if b.section[-1] in (number["7"], number["8"])]
    if fork is None or not descending:
        return False
    size = max(float(np.linalg.norm(points - fork, axis=1).max()) for points in descending)
    origins = [b.centerline.points[0, 2] for b in tree.branches if b.section[-1] == number["14"]]
    return bool(origins) and float(fork[2]) - float(min(origins)) > _LOW * size


def _generic(tree: VesselTree) -> VesselTree:
    generation = [len(tree.route(index)) - 1 for index in range(len(tree.branches))]
    names = [""] * len(tree.branches)
    for level in sorted(set(generation)):
        members = [index for index, value in enumerate(generation) if value == level]
        members.sort(key=lambda index: -float(np.median(tree.branches[index].centerline.radius)))
        for order, index in enumerate(members):
            names[index] = "G0" if level == 0 else f"G{level}.{order + 1}"
    branches = tuple(
        Branch(branch.centerline, branch.parent, np.full(len(branch.centerline.points), index, dtype=np.int64))
        for index, branch in enumerate(tree.branches)
    )
    return VesselTree(branches, tuple(names))
