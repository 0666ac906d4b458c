"""The anatomical sections of every kind of vessel tree, and what labelling asks of a tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.types import VesselTree
from endopilot.vessels.coronary_ostia import Crux

RCA_SECTIONS = ("1", "2", "3", "4", "16", "conus", "SA", "RV", "AM")
"""Proximal, mid, distal; posterior descending; posterolateral; then conus, sinus node, right ventricular and acute
marginal branches."""

LCA_SECTIONS = ("5", "6", "7", "8", "9", "10", "11", "12", "13", "14", "15", "17", "D", "septal")
"""Left main; LAD proximal, mid, distal; first and second diagonal; LCx proximal; first obtuse marginal; LCx distal;
further marginal or posterolateral; left posterior descending; ramus intermedius; further diagonals; septals. Segment 16
is the right artery's alone (SCCT)."""

ARCH_SECTIONS = (
    "descending aorta",
    "aortic arch",
    "ascending aorta",
    "brachiocephalic trunk",
    "left common carotid",
    "left subclavian",
    "right common carotid",
    "right subclavian",
)
"""The arch reaches from the origin of the left subclavian artery to that of the brachiocephalic trunk."""

CEREBRAL_SECTIONS = ("ICA", "M1", "M2 inferior", "M2 superior", "M2 middle", "A1", "A2", "ophthalmic", "PCom")
"""Internal carotid, middle cerebral, anterior cerebral, ophthalmic, posterior communicating artery, of either side."""

PORTAL_SECTIONS = ("MPV", "RPV", "LPV", "RAPV", "RPPV", "S2", "S3", "S4", "S5", "S6", "S7", "S8")
"""Main, right, left portal vein; right anterior and posterior branch; veins of Couinaud's segments."""


class Labeller:
    """A tree with the queries that the schemes need."""

    def __init__(
        self, tree: VesselTree, names: tuple[str, ...], sections: list[np.ndarray], crux: Crux | None = None
    ) -> None:
        self.tree, self.names, self.sections, self.crux = tree, names, sections, crux

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

    def length_behind(self, branch: int) -> float:
        """Length from a branch's start to the farthest tip behind it, mm."""
        tip = self.tree.branches[self.tree.longest_leaf(branch)].centerline.abscissa[-1]
        return float(tip - self.tree.branches[branch].centerline.abscissa[0])

    def reach(self, branch: int, direction: Float[np.ndarray, "3"]) -> float:
        """How far a branch and everything behind it reach along a direction, mm."""
        behind = [i for i in range(len(self.tree.branches)) if branch in self.tree.route(i)]
        return max(float((self.tree.branches[i].centerline.points @ direction).max()) for i in behind)

    def major(self, branch: int, length_mm: float) -> list[int]:
        """Children of a branch with at least this much length behind their start, mm."""
        return [child for child in self.tree.children(branch) if self.length_behind(child) >= length_mm]

    def fork(self, branch: int, length_mm: float) -> int:
        """The branch, along major children, at whose end more than one of them leaves, or none."""
        while len(onwards := self.major(branch, length_mm)) == 1:
            branch = onwards[0]
        return branch

    def onwards(self, branch: int, leaf: int) -> tuple[int, ...]:
        """Branches from `branch` to `leaf`, both included."""
        return tuple(i for i in self.tree.route(leaf) if branch in self.tree.route(i))

    def sides(self, route: tuple[int, ...]) -> list[int]:
        """Branches that leave a route, in the order of their origins."""
        return [child for branch in route for child in self.tree.children(branch) if child not in route]

    def origin(self, branch: int) -> float:
        """Abscissa of a branch's start, mm."""
        return float(self.tree.branches[branch].centerline.abscissa[0])

    def heading(self, branch: int, reach_mm: float) -> Float[np.ndarray, "3"]:
        """Unit vector from a branch's start to where its longest path is after `reach_mm`."""
        line = self.tree.path(self.tree.longest_leaf(branch))
        start = self.tree.branches[branch].centerline
        last = line.points[min(np.searchsorted(line.abscissa, start.abscissa[0] + reach_mm), len(line.points) - 1)]
        heading = last - start.points[0]
        return heading / max(float(np.linalg.norm(heading)), 1e-9)

    def arriving(self, branch: int) -> Float[np.ndarray, "3"]:
        """Unit vector along the path over the last 12 mm before a branch's end."""
        line = self.tree.path(branch)
        first = line.points[max(np.searchsorted(line.abscissa, line.abscissa[-1] - 12.0) - 1, 0)]
        heading = line.points[-1] - first
        return heading / max(float(np.linalg.norm(heading)), 1e-9)
