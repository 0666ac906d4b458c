"""Anatomical sections for every point of a tree: AHA/SCCT segments, named vessels, or generation and order.

Segments after Austen et al., Circulation 1975;51:5-40 (AHA) and Leipsic et al., J Cardiovasc Comput Tomogr
2014;8:342-58 (SCCT), by where a branch leaves and goes in LPS axes: other axes give wrong names, not an error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.labels_coronary import LONGEST_LEFT_MAIN_MM, NEAREST_CRUX_MM, label_lca, label_rca
from endopilot.anatomy.labels_tree import (
    ARCH_SECTIONS,
    CEREBRAL_SECTIONS,
    LCA_SECTIONS,
    PORTAL_SECTIONS,
    RCA_SECTIONS,
    Labeller,
)
from endopilot.types import Branch, VesselTree
from endopilot.vessels.coronary_ostia import Crux

_LOW = 0.39
"""A posterolateral branch that leaves this far under the fork of the left main, against the distance from there to the
apex, feeds the inferior wall (Dodge's CP)."""

LEFT, FRONT = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])

_LONG_MM = 35.0  # where two branches with this much behind them part, the internal carotid ends
_TRUNK_MM = 15.0  # where two branches with this much behind them part, M1 ends
_SHORTEST_A1_MM = 5.0
_TURN_MM = 1.0  # the anterior cerebral artery has turned up this far behind the end of A1
_RIGHT_SHARE = 0.3  # veins that end in this right share of the tree's width are of the right lobe for certain


def label_arch(labeller: Labeller) -> None:
    """Name the sections of an aortic arch that is entered from the descending aorta."""
    tree = labeller.tree
    aorta = tree.route(max(tree.leaves(), key=lambda leaf: float(tree.branches[leaf].centerline.radius[-5:].mean())))
    sides = labeller.sides(aorta)
    labeller.along(aorta, [("descending aorta", np.inf)])
    if not sides:
        return
    trunk = max(sides, key=lambda side: labeller.reach(side, -LEFT))
    others = [side for side in sides if side != trunk]
    subclavian = max(others, key=lambda side: labeller.reach(side, LEFT), default=trunk)
    ends = (labeller.origin(subclavian), labeller.origin(trunk))
    labeller.along(aorta, [("descending aorta", ends[0]), ("aortic arch", ends[1]), ("ascending aorta", np.inf)])
    for side in others:
        labeller.fill(side, "left subclavian" if side == subclavian else "left common carotid")
    labeller.fill(trunk, "brachiocephalic trunk")
    ordered = sorted(tree.leaves(trunk), key=labeller.leftward)
    if len(ordered) > 1:
        labeller.fill(labeller.own(ordered[0]), "right subclavian")
        labeller.fill(labeller.own(ordered[1]), "right common carotid")
    for leaf in ordered[2:]:
        labeller.fill(labeller.own(leaf), "left common carotid")


def label_cerebral(labeller: Labeller) -> None:
    """Name the sections of one side's anterior cerebral circulation that is entered from the internal carotid."""
    tree, terminus = labeller.tree, labeller.fork(0, _LONG_MM)
    carotid = tree.route(terminus)
    labeller.along(carotid, [("ICA", np.inf)])
    parted = labeller.major(terminus, _LONG_MM)
    for side in labeller.sides(carotid):
        if side not in parted:
            labeller.fill(side, "ophthalmic" if float(labeller.heading(side, 15.0) @ FRONT) > 0 else "PCom")
    if len(parted) < 2:
        return
    # The carotid has come from the side towards the midline; the anterior cerebral artery continues in that direction.
    line = tree.path(terminus)
    inwards = np.sign(line.points[-1] - line.points[0]) * LEFT
    anterior = max(parted, key=lambda child: float(labeller.heading(child, 12.0) @ inwards))
    for middle in parted:
        if middle != anterior:
            _label_middle(labeller, middle, inwards)
    line = tree.path(tree.longest_leaf(anterior))
    own = np.flatnonzero(line.abscissa >= labeller.origin(anterior) + _SHORTEST_A1_MM)
    step = np.gradient(line.points[own], axis=0)
    up = step[:, 2] > np.abs(step[:, 0])
    turn = float(line.abscissa[own[up.argmax() if up.any() else -1]]) - _TURN_MM
    labeller.fill(anterior, "A2")
    labeller.along(labeller.onwards(anterior, tree.longest_leaf(anterior)), [("A1", turn), ("A2", np.inf)])


def _label_middle(labeller: Labeller, branch: int, inwards: Float[np.ndarray, "3"]) -> None:
    end = labeller.fork(branch, _TRUNK_MM)
    labeller.fill(branch, "M1")
    # From the inferior trunk at the back over the middle one on the outside to the superior one in front.
    order = FRONT + 0.6 * inwards
    trunks = sorted(labeller.major(end, _TRUNK_MM), key=lambda child: float(labeller.heading(child, 25.0) @ order))
    if len(trunks) < 2:
        return
    for trunk in trunks:
        labeller.fill(trunk, "M2 middle")
    labeller.fill(trunks[0], "M2 inferior")
    labeller.fill(trunks[-1], "M2 superior")


def label_portal(labeller: Labeller) -> None:
    """Name the sections of a portal vein that is entered from its confluence."""
    tree = labeller.tree
    leaves = sorted(tree.leaves(), key=labeller.leftward)
    labeller.fill(0, "MPV")
    if len(leaves) < 2:
        return
    low, high = labeller.leftward(leaves[0]), labeller.leftward(leaves[-1])
    # A branch that leaves the path to the leftmost end before the veins of the far right do leads to the right lobe.
    part = {leaf: _parting(labeller, leaf, leaves[-1]) for leaf in leaves[:-1]}
    last = max(part[leaf] for leaf in part if labeller.leftward(leaf) <= low + _RIGHT_SHARE * (high - low))
    right = {leaf for leaf in part if part[leaf] <= last}
    posterior = _right_posterior(labeller, right)
    groups = {"LPV": set(leaves) - right, "RPPV": posterior, "RAPV": right - posterior}
    for branch in range(len(tree.branches)):
        behind = set(tree.leaves(branch))
        inside = [name for name, group in groups.items() if behind <= group]
        name = inside[0] if inside else "RPV" if behind <= right else "MPV"
        labeller.sections[branch][:] = labeller.names.index(name)
    for name, lower, upper in (("RPPV", "S6", "S7"), ("RAPV", "S5", "S8")):
        for leaf in groups[name]:
            labeller.fill(labeller.own(leaf), upper)
        if len(groups[name]) > 1:
            labeller.fill(
                labeller.own(min(groups[name], key=lambda leaf: float(tree.branches[leaf].centerline.points[-1, 2]))),
                lower,
            )
    left = sorted(groups["LPV"], key=labeller.leftward)
    if len(left) > 1:
        labeller.fill(labeller.own(left[0]), "S4")
        lateral = sorted(left[1:], key=lambda leaf: float(tree.branches[leaf].centerline.points[-1, 1]))
        for leaf in lateral[:-1]:
            labeller.fill(labeller.own(leaf), "S3")
        labeller.fill(labeller.own(lateral[-1]), "S2" if len(lateral) > 1 else "S3")


def _parting(labeller: Labeller, one: int, other: int) -> float:
    common = [branch for branch in labeller.tree.route(one) if branch in labeller.tree.route(other)]
    return float(labeller.tree.branches[common[-1]].centerline.abscissa[-1])


def _right_posterior(labeller: Labeller, right: set[int]) -> set[int]:
    """Return the ends of the right posterior branch: of what leads to the right lobe alone, the part at the back."""
    tree = labeller.tree
    alone = [branch for branch in range(len(tree.branches)) if set(tree.leaves(branch)) <= right]
    first = [branch for branch in alone if tree.branches[branch].parent not in alone]
    while len(first) == 1 and tree.children(first[0]):
        first = list(tree.children(first[0]))
    back = min(first, key=lambda branch: float(labeller.heading(branch, 30.0) @ FRONT))
    return set(tree.leaves(back)) if len(first) > 1 else set()


Scheme = Literal["rca", "lca", "arch", "cerebral", "portal", "generic"]

_RULES: dict[str, tuple[tuple[str, ...], Callable[[Labeller], None]]] = {
    "rca": (RCA_SECTIONS, label_rca),
    "lca": (LCA_SECTIONS, label_lca),
    "arch": (ARCH_SECTIONS, label_arch),
    "cerebral": (CEREBRAL_SECTIONS, label_cerebral),
    "portal": (PORTAL_SECTIONS, label_portal),
}


def label_tree(tree: VesselTree, scheme: Scheme, *, crux: Crux | None = None) -> VesselTree:
    """Return the tree (LPS mm) with every point's section.

    Args:
        scheme: "rca" and "lca" name AHA/SCCT segments, "arch", "cerebral" and "portal" the vessels of these anatomies
            (`labels_tree` lists all names); "generic" names branches "G0", "G1.1", "G1.2", …: generation (bifurcations
            from the root), then order, widest first.
        crux: where the crux of the heart lies and which artery reaches it, if both are known.
    """
    if scheme == "generic":
        return _generic(tree)
    names, rules = _RULES[scheme]
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


def missing_main_vessel(tree: VesselTree) -> list[str]:
    """Say so if a labelled left coronary tree lacks one of the two main vessels: then all names are less sure."""
    missing = [
        name
        for number, name in (("6", "anterior descending"), ("11", "circumflex"))
        if number not in tree.sections_present
    ]
    if tree.section_names != LCA_SECTIONS or not missing:
        return []
    return [
        f"the left main does not fork within {LONGEST_LEFT_MAIN_MM:g} mm here: the {missing[0]} artery is missing, cut "
        "off or a piece apart, and the sections of the other one are named by its course alone"
    ]


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
