"""The route along the tree to a target: its branches and junctions, and how far a tip has come."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.devices.device import Device
from endopilot.devices.drive_limits import WIDE_MM
from endopilot.errors import InputError
from endopilot.lines import places_on
from endopilot.tasks.navigation import Target
from endopilot.types import Anatomy, Centerline, TipProjection, VesselTree

BEYOND_MM = 1.5
"""A waypoint lies this far beyond the wall of the parent, on the centerline of the branch that leaves it, mm."""
ENTERED_MM = 1.0
"""A tip this far beyond a waypoint has entered the branch, mm."""
NEAR_MM = 1.5
"""A tip this near to the target, in its branch, has arrived, mm: half a millimetre before it counts as reached."""


@dataclass(frozen=True, eq=False)
class Route:
    """The path from the ostium to a target.

    Attributes:
        anatomy: the vessel.
        target: where it ends.
        branches: indices of its branches, the root first.
        line: the connected centerline through them.
        junctions: abscissae of the branching points before the target, mm.
        waypoints: abscissa beyond each junction at which a tip has clearly taken the right branch, then that of
            the target, mm.
    """

    anatomy: Anatomy
    target: Target
    branches: tuple[int, ...]
    line: Centerline
    junctions: Float[np.ndarray, "j"]
    waypoints: Float[np.ndarray, "j+1"]

    @staticmethod
    def to(anatomy: Anatomy, target: Target) -> Route:
        """Return the route to a target."""
        tree = anatomy.tree
        branches = tree.route(target.branch)
        starts = [tree.branches[b].centerline for b in branches[1:]]
        junctions = np.array([line.abscissa[0] for line in starts if line.abscissa[0] < target.abscissa])
        beyond = np.array([line.abscissa[0] + line.radius[0] + BEYOND_MM for line in starts[: len(junctions)]])
        left = [_left_backwards(tree, branch) for branch in branches[1 : len(junctions) + 1]]
        beyond = np.maximum(beyond, np.array(left) + BEYOND_MM)
        beyond = np.minimum(beyond, _branch_ends(junctions, target))
        return Route(
            anatomy=anatomy,
            target=target,
            branches=branches,
            line=tree.path(target.branch),
            junctions=junctions,
            waypoints=np.append(beyond, target.abscissa),
        )

    def beyond_carinas(self) -> Route:
        """Return the route with waypoints that lie beyond the carinas of its forks, as far as its branches reach.

        Where a branch leaves obliquely from one as wide, a tip beside its line may still lie in the other lumen.
        """
        ends = _branch_ends(self.junctions, self.target)
        carinas = [_carina(self.anatomy.tree, branch) for branch in self.branches[1 : len(self.junctions) + 1]]
        deeper = np.where(np.array(carinas) < ends, np.maximum(self.waypoints[:-1], carinas), self.waypoints[:-1])
        return replace(self, waypoints=np.append(deeper, self.target.abscissa))

    @cached_property
    def leaves_at(self) -> Float[np.ndarray, "branches"]:
        """Abscissa at which the path to each branch of the tree leaves the route; infinite for those on it."""
        return self.anatomy.tree.departures(self.target.branch)

    def off_route(self, tip: TipProjection) -> Float[np.ndarray, "..."]:
        """Return how far tips are in branches that do not lie on the route, mm; 0 for those on it."""
        return np.maximum(tip.abscissa - self.leaves_at[tip.branch], 0.0)

    def progress(self, tip: TipProjection) -> Float[np.ndarray, "..."]:
        """Return how far along the route tips have come, mm; for tips off the route, as far as where they left it."""
        return np.minimum(tip.abscissa, self.leaves_at[tip.branch])

    def passed(self, tip: TipProjection, waypoint: float) -> Bool[np.ndarray, "..."]:
        """Return which tips have entered the branch of a waypoint, or reached the target if it is the last."""
        on_route = self.off_route(tip) == 0
        if waypoint >= self.target.abscissa:
            there = np.abs(tip.abscissa - waypoint) <= NEAR_MM
            return on_route & there & self.target.reached(tip[..., None])
        return on_route & (tip.abscissa >= min(waypoint + ENTERED_MM, self.target.abscissa))

    def position(self, abscissa: float) -> Float[np.ndarray, "3"]:
        """Return a place on the route, LPS mm."""
        return places_on(self.line.points, self.line.abscissa, np.array([abscissa]))[0]

    def branch(self, abscissa: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the index of the branch that the route lies in at some abscissae, mm."""
        return np.array(self.branches)[np.searchsorted(self.junctions, abscissa)]

    def width_mm(self, end: float) -> float:
        """Return the largest width of the lumen from the ostium up to an abscissa, mm."""
        return 2 * float(self.line.radius[self.line.abscissa <= end].max())

    def is_wide(self, end: float) -> bool:
        """Return whether a wire may fold in the lumen up to an abscissa, mm, and yet come forward (`WIDE_MM`)."""
        return self.width_mm(end) > WIDE_MM

    def narrow_from(self) -> float:
        """Return the abscissa from which on the lumen is nowhere wider than `WIDE_MM` up to the target, mm."""
        before = self.line.abscissa <= self.target.abscissa
        wide = self.line.abscissa[before & (2 * self.line.radius > WIDE_MM)]
        return float(wide.max(initial=0.0))

    def radius(self, abscissa: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the lumen radius along the route, mm."""
        return np.interp(abscissa, self.line.abscissa, self.line.radius)


def _branch_ends(junctions: Float[np.ndarray, "j"], target: Target) -> Float[np.ndarray, "j"]:
    """Return the abscissa before which the waypoint of each branch lies, mm: its end, or the target."""
    return np.append(junctions[1:] - ENTERED_MM, target.abscissa)[: len(junctions)]


def _left_backwards(tree: VesselTree, branch: int) -> float:
    """Return where a branch that leaves its parent by more than 90° is out of the vessels beside it, mm; else 0.

    The line of such a branch runs back through the parent, farther than the parent's radius: a tip in the mouth of the
    branch would seem to lie deep in it.
    """
    parent, own = tree.branches[branch].parent, tree.branches[branch].centerline
    out = int(np.argmax(np.append(_gap_beside(tree, branch) > 0, True)))
    if not 0 < out < len(own.points):
        return 0.0
    before = tree.branches[parent].centerline.points
    into, onto = before[-1] - before[-2], own.points[out] - own.points[out - 1]
    return float(own.abscissa[out]) if into @ onto < 0 else 0.0


def _carina(tree: VesselTree, branch: int) -> float:
    """Return where the lumen of a branch parts from the vessels beside it, mm; infinite if it does not."""
    own = tree.branches[branch].centerline
    parts = np.flatnonzero(_gap_beside(tree, branch) > own.radius)
    return float(own.abscissa[parts[0]]) if len(parts) else np.inf


def _gap_beside(tree: VesselTree, branch: int) -> Float[np.ndarray, "points"]:
    """Return how far the points of a branch's line lie from the walls of its parent and of what else leaves it, mm."""
    parent = tree.branches[branch].parent
    beside = [parent, *(other for other in tree.children(parent) if other != branch)]
    points = np.concatenate([tree.branches[other].centerline.points for other in beside])
    radius = np.concatenate([tree.branches[other].centerline.radius for other in beside])
    gap = np.linalg.norm(tree.branches[branch].centerline.points[:, None] - points, axis=2) - radius
    return np.asarray(gap.min(axis=1))


def check_passable(route: Route, device: Device) -> None:
    """Raise `InputError` where the lumen is somewhere narrower than the wire up to the target; the line says where."""
    before = route.line.abscissa <= route.target.abscissa
    abscissa, radius = route.line.abscissa[before], route.line.radius[before]
    narrow = radius <= device.tip_radius_mm
    if narrow.any():
        at = int(np.argmax(narrow))
        raise InputError(
            f"target: lies behind an occlusion of {route.anatomy.name}: at {abscissa[at]:.1f} mm the lumen is "
            f"{2 * radius[at]:.2f} mm wide and {device.name} is {device.diameter_mm:g} mm; "
            "choose a target before it or a thinner device"
        )
