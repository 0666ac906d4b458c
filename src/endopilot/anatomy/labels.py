"""Anatomical sections for every point of a tree: AHA/SCCT segments of the coronaries, or generation and order.

Segments after Austen et al., Circulation 1975;51:5-40 (AHA) and Leipsic et al., J Cardiovasc Comput Tomogr
2014;8:342-58 (SCCT). Which branch is which follows from where it leaves and where it goes in the patient's axes (LPS):
left, posterior, up. A tree stored in other axes gets wrong names, not an error.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.types import Branch, VesselTree

RCA_SECTIONS = ("1", "2", "3", "4", "16", "conus", "SA", "RV", "AM")
"""Proximal, mid, distal; posterior descending; posterolateral; then conus, sinus node, right ventricular and acute
marginal branches."""

LCA_SECTIONS = ("5", "6", "7", "8", "9", "10", "11", "12", "13", "14", "15", "16", "D", "septal")
"""Left main; LAD proximal, mid, distal; first and second diagonal; LCx proximal; first obtuse marginal; LCx distal;
further marginal or posterolateral; left posterior descending; ramus intermedius; further diagonals; septals."""

ACUTE_MARGIN = 0.64
"""The acute margin lies at this share of the way from the ostium to the crux (Dodge et al., Circulation
1988;78:1167-80, R2 distal); segment 1 ends half the way to it."""

MAJOR_MM = 6.0
"""A branch with at least this much length behind it counts as a named end vessel, mm."""

_EARLY, _LATE = 0.22, 0.4
"""A conus branch leaves within the first share of the way to the crux, a sinus node branch within the second."""

_RAMUS_MM = 4.0
"""Where LAD and LCx divide again this near the left main's end, the middle branch is the ramus intermedius."""


def label_tree(tree: VesselTree, scheme: Literal["rca", "lca", "generic"]) -> VesselTree:
    """Return the tree with every point's section.

    Args:
        tree: centerlines in LPS mm.
        scheme: "rca" and "lca" name AHA/SCCT segments; "generic" names branches "G0", "G1.1", "G1.2", …: generation
            (bifurcations from the root), then order, widest first.
    """
    if scheme == "generic":
        return _generic(tree)
    names = RCA_SECTIONS if scheme == "rca" else LCA_SECTIONS
    sections = [np.zeros(len(branch.centerline.points), dtype=np.int64) for branch in tree.branches]
    labeller = _Labeller(tree, names, sections)
    (_label_rca if scheme == "rca" else _label_lca)(labeller)
    branches = tuple(
        Branch(branch.centerline, branch.parent, section)
        for branch, section in zip(tree.branches, sections, strict=True)
    )
    return VesselTree(branches, names)


def dominance(tree: VesselTree) -> str | None:
    """Return "right", "balanced" or "left" for a labelled coronary tree, None for any other.

    A right coronary that gives the posterior descending and a posterolateral branch is right-dominant, one that gives
    the posterior descending alone balanced, one that gives neither left; a left coronary with a posterior descending
    branch is left-dominant.
    """
    used = {tree.section_names[index] for branch in tree.branches for index in np.unique(branch.section)}
    if tree.section_names == RCA_SECTIONS:
        return "right" if {"4", "16"} <= used else "balanced" if "4" in used else "left"
    if tree.section_names == LCA_SECTIONS:
        return "left" if "15" in used else "right"
    return None


class _Labeller:
    """A tree with the questions that both coronary schemes ask of it."""

    def __init__(self, tree: VesselTree, names: tuple[str, ...], sections: list[np.ndarray]) -> None:
        self.tree, self.names, self.sections = tree, names, sections

    def fill(self, branch: int, name: str) -> None:
        """Name a branch and everything behind it."""
        self.sections[branch][:] = self.names.index(name)
        for child in self.tree.children(branch):
            self.fill(child, name)

    def along(self, route: tuple[int, ...], ends: list[tuple[str, float]]) -> None:
        """Name the points of a route by the abscissa up to which each name reaches, mm."""
        indices = np.array([self.names.index(name) for name, _ in ends])
        for branch in route:
            abscissa = self.tree.branches[branch].centerline.abscissa.copy()
            abscissa[0] += 1e-3  # a branch that starts where a section ends belongs to the next one
            self.sections[branch][:] = indices[np.searchsorted([end for _, end in ends], abscissa)]

    def longest_leaf(self, branch: int) -> int:
        leaves = [leaf for leaf in self.tree.leaves() if branch in self.tree.route(leaf)]
        return max(leaves, key=lambda leaf: self.tree.branches[leaf].centerline.abscissa[-1])

    def length_behind(self, branch: int) -> float:
        """Length from a branch's start to the farthest tip behind it, mm."""
        tip = self.tree.branches[self.longest_leaf(branch)].centerline.abscissa[-1]
        return float(tip - self.tree.branches[branch].centerline.abscissa[0])

    def sides(self, route: tuple[int, ...]) -> list[int]:
        """Branches that leave a route, in the order of their origins."""
        return [child for branch in route for child in self.tree.children(branch) if child not in route]

    def origin(self, branch: int) -> float:
        return float(self.tree.branches[branch].centerline.abscissa[0])

    def heading(self, branch: int, reach_mm: float) -> Float[np.ndarray, "3"]:
        """Unit vector from a branch's start to where its longest path is after `reach_mm`."""
        line = self.tree.path(self.longest_leaf(branch))
        start = self.tree.branches[branch].centerline
        last = line.points[min(np.searchsorted(line.abscissa, start.abscissa[0] + reach_mm), len(line.points) - 1)]
        heading = last - start.points[0]
        return heading / max(float(np.linalg.norm(heading)), 1e-9)

    def arriving(self, branch: int, reach_mm: float = 12.0) -> Float[np.ndarray, "3"]:
        """Unit vector along the path over the last `reach_mm` before a branch's end."""
        line = self.tree.path(branch)
        first = line.points[max(np.searchsorted(line.abscissa, line.abscissa[-1] - reach_mm) - 1, 0)]
        heading = line.points[-1] - first
        return heading / max(float(np.linalg.norm(heading)), 1e-9)


def _label_rca(labeller: _Labeller) -> None:
    tree = labeller.tree
    leaf = max(tree.leaves(), key=lambda index: tree.branches[index].centerline.abscissa[-1])
    route = tree.route(leaf)
    crux = _crux(labeller, route)
    if crux is None:
        end, trunk = _unforked_crux(labeller, route), route
    else:
        end = float(tree.branches[crux].centerline.abscissa[-1])
        trunk = tree.route(crux)
    margin = ACUTE_MARGIN * end
    labeller.along(trunk, [("1", margin / 2), ("2", margin), ("3", end), ("4", np.inf)])
    if crux is not None:
        ends = sorted(tree.children(crux), key=lambda child: _towards_apex(labeller, child))
        for child in ends[:-1]:
            labeller.fill(child, "16")
        labeller.fill(ends[-1], "4")
    _label_right_sides(labeller, trunk, crux, end)


def _crux(labeller: _Labeller, route: tuple[int, ...]) -> int | None:
    """Return the branch that ends at the crux: the first low fork into two branches after the turn to the back.

    Before the acute margin the vessel runs down and to the right; from there to the crux, to the left and the back.
    """
    forks = [
        branch
        for branch in route
        if sum(labeller.length_behind(child) >= MAJOR_MM for child in labeller.tree.children(branch)) >= 2
    ]
    back = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    height = labeller.tree.path(route[-1]).points[:, 2]
    low = height.min() + 0.3 * float(np.ptp(height))
    for branch in forks:
        end = labeller.tree.branches[branch].centerline.points[-1]
        if end[2] < low and float(labeller.arriving(branch) @ back) > 0.3:
            return branch
    return None


def _unforked_crux(labeller: _Labeller, route: tuple[int, ...]) -> float:
    """Return where segment 3 ends in a tree whose end does not fork, mm.

    If the vessel turns forwards again behind its most posterior point for long enough, what follows is the posterior
    descending artery; otherwise it ends as segment 3.
    """
    line = labeller.tree.path(route[-1])
    later = np.flatnonzero(line.abscissa > 0.5 * line.abscissa[-1])
    turn = int(later[line.points[later, 1].argmax()])
    forwards = line.points[turn, 1] - line.points[-1, 1]
    beyond = line.abscissa[-1] - line.abscissa[turn]
    return float(line.abscissa[turn]) if beyond > 15.0 and forwards > 8.0 else float(line.abscissa[-1])


def _towards_apex(labeller: _Labeller, branch: int) -> float:
    """Tell how much a branch from the crux runs forwards and down to the apex, as the posterior descending does."""
    return float(labeller.heading(branch, 25.0) @ np.array([0.0, -1.0, -0.4]))


def _label_right_sides(labeller: _Labeller, trunk: tuple[int, ...], crux: int | None, end: float) -> None:
    behind = labeller.tree.children(crux) if crux is not None else ()
    sides = [side for side in labeller.sides(trunk) if side not in behind]
    # The sinus node's branch runs back and up over the atrium, the others forwards over the right ventricle.
    atrial = np.array([-0.9, 1.45, 0.7])
    anterior = [
        side
        for side in sides
        if labeller.origin(side) > _LATE * end or float(labeller.heading(side, 20.0) @ atrial) < 0
    ]
    for side in sides:
        if side not in anterior:
            labeller.fill(side, "SA")
    first = next(iter(anterior), -1)
    conus = first if len(anterior) > 2 or labeller.origin(first) < _EARLY * end else -1
    ventricular = [side for side in anterior if side != conus]
    # Of the branches to the right ventricle, the acute marginal is the long and late one.
    marginal = max(
        ventricular,
        key=lambda side: labeller.origin(side) / (0.06 * end) + labeller.length_behind(side) / 9.0,
        default=-1,
    )
    for side in anterior:
        labeller.fill(side, "conus" if side == conus else "AM" if side == marginal else "RV")


def _label_lca(labeller: _Labeller) -> None:
    tree = labeller.tree
    fork = 0
    while True:
        major = [child for child in tree.children(fork) if labeller.length_behind(child) >= 2.5 * MAJOR_MM]
        if len(major) != 1:
            break
        fork = major[0]
    trunk = tree.route(fork)
    labeller.along(trunk, [("5", np.inf)])
    for side in labeller.sides(trunk):
        labeller.fill(side, "16")
    if len(major) < 2:
        return
    ordered = sorted(major, key=lambda child: labeller.heading(child, 30.0)[1])
    for middle in ordered[1:-1]:
        labeller.fill(middle, "16")
    end = float(tree.branches[fork].centerline.abscissa[-1])
    _label_lad(labeller, ordered[0], end)
    _label_lcx(labeller, ordered[-1], end)


def _label_lad(labeller: _Labeller, branch: int, end: float) -> None:
    tree = labeller.tree
    route = tuple(i for i in tree.route(labeller.longest_leaf(branch)) if branch in tree.route(i))
    sides = labeller.sides(route)
    # Diagonals run to the left over the free wall; septals dive to the right of the vessel's own course.
    diagonals = []
    for side in sides:
        main = next(i for i in route if tree.branches[i].parent == tree.branches[side].parent)
        leftward = labeller.heading(side, 12.0) - labeller.heading(main, 12.0)
        if labeller.origin(side) - end < _RAMUS_MM and labeller.length_behind(side) > 2.5 * MAJOR_MM:
            labeller.fill(side, "16")
        elif leftward @ np.array([1.0, 1.0, 0.0]) > 0:
            diagonals.append(side)
        else:
            labeller.fill(side, "septal")
    for order, side in enumerate(diagonals):
        labeller.fill(side, ("9", "10")[order] if order < 2 else "D")
    tip = float(tree.branches[route[-1]].centerline.abscissa[-1])
    first = [labeller.origin(side) for side in sides if labeller.origin(side) - end >= _RAMUS_MM]
    proximal = min(first) if first else end + (tip - end) / 3
    labeller.along(route, [("6", proximal), ("7", 0.5 * (proximal + tip)), ("8", np.inf)])


def _label_lcx(labeller: _Labeller, branch: int, end: float) -> None:
    tree = labeller.tree
    leaves = [leaf for leaf in tree.leaves() if branch in tree.route(leaf)]
    # The circumflex keeps to the groove, round the back; the marginals leave it to the left.
    groove = np.array([-0.5, 0.85, 0.0])
    leaf = max(leaves, key=lambda index: float(tree.branches[index].centerline.points[-1] @ groove))
    route = tuple(i for i in tree.route(leaf) if branch in tree.route(i))
    marginals = []
    for side in labeller.sides(route):
        if labeller.origin(side) - end < _RAMUS_MM and labeller.length_behind(side) > 2.5 * MAJOR_MM:
            labeller.fill(side, "16")
        else:
            marginals.append(side)
    for order, side in enumerate(marginals):
        labeller.fill(side, "12" if order == 0 else "14")
    tip = float(tree.branches[route[-1]].centerline.abscissa[-1])
    proximal = labeller.origin(marginals[0]) if marginals else end + 0.5 * (tip - end)
    labeller.along(route, [("11", proximal), ("13", _left_crux(labeller, route)), ("15", np.inf)])


def _left_crux(labeller: _Labeller, route: tuple[int, ...]) -> float:
    """Return where the circumflex becomes the left posterior descending, mm; infinity where it does not."""
    line = labeller.tree.path(route[-1])
    own = np.flatnonzero(line.abscissa >= labeller.origin(route[0]))
    turn = int(own[line.points[own, 1].argmax()])
    beyond = line.abscissa[-1] - line.abscissa[turn]
    run = line.points[-1] - line.points[turn]
    medial = line.points[turn, 0] < line.points[own[0], 0] + 20.0
    return float(line.abscissa[turn]) if beyond > 25.0 and run[1] < -12.0 and medial else np.inf


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
