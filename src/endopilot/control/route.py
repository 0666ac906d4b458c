"""The route along the tree to a target: its branches and junctions, and how far a tip has come."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.devices.device import Device
from endopilot.errors import InputError
from endopilot.tasks.navigation import Target
from endopilot.types import Anatomy, Centerline, TipProjection

BEYOND_MM = 1.5
"""A waypoint lies this far beyond the wall of the parent, on the centerline of the branch that leaves it, mm."""
ENTERED_MM = 1.0
"""A tip this far beyond a waypoint has entered the branch, mm."""
NEAR_MM = 1.5
"""A tip this near to the target, in its branch, has arrived, mm: half a millimetre before it counts as reached."""
OUTSIDE_MM = 2.0
"""A point this far outside the lumen is no target, mm."""


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
        ends = np.append(junctions[1:] - ENTERED_MM, target.abscissa)[: len(junctions)]  # of a branch shorter than that
        beyond = np.minimum(beyond, ends)
        return Route(
            anatomy=anatomy,
            target=target,
            branches=branches,
            line=tree.path(target.branch),
            junctions=junctions,
            waypoints=np.append(beyond, target.abscissa),
        )

    @cached_property
    def _leaves_at(self) -> Float[np.ndarray, "branches"]:
        """Abscissa at which the path to each branch of the tree leaves the route; infinite for those on it."""
        return self.anatomy.tree.departures(self.target.branch)

    def off_route(self, tip: TipProjection) -> Float[np.ndarray, "..."]:
        """Return how far tips are in branches that do not lie on the route, mm; 0 for those on it."""
        return np.maximum(tip.abscissa - self._leaves_at[tip.branch], 0.0)

    def progress(self, tip: TipProjection) -> Float[np.ndarray, "..."]:
        """Return how far along the route tips have come, mm; for tips off the route, as far as where they left it."""
        return np.minimum(tip.abscissa, self._leaves_at[tip.branch])

    def passed(self, tip: TipProjection, waypoint: float) -> Bool[np.ndarray, "..."]:
        """Return which tips have entered the branch of a waypoint, or reached the target if it is the last."""
        on_route = self.off_route(tip) == 0
        if waypoint >= self.target.abscissa:
            return on_route & (tip.branch == self.target.branch) & (np.abs(tip.abscissa - waypoint) <= NEAR_MM)
        return on_route & (tip.abscissa >= min(waypoint + ENTERED_MM, self.target.abscissa))

    def next_waypoint(self, progress: float) -> float:
        """Return the first waypoint that a tip with this progress has not passed, mm."""
        ahead = self.waypoints[self.waypoints + ENTERED_MM > progress]
        return float(ahead[0]) if len(ahead) else self.target.abscissa

    def position(self, abscissa: float) -> Float[np.ndarray, "3"]:
        """Return a place on the route, LPS mm."""
        return np.array([np.interp(abscissa, self.line.abscissa, axis) for axis in self.line.points.T])

    def branch(self, abscissa: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the index of the branch that the route lies in at some abscissae, mm."""
        return np.array(self.branches)[np.searchsorted(self.junctions, abscissa)]

    def radius(self, abscissa: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the lumen radius along the route, mm."""
        return np.interp(abscissa, self.line.abscissa, self.line.radius)


def check_passable(route: Route, device: Device) -> None:
    """Check that the wire fits through the lumen everywhere up to the target.

    Raises:
        InputError: the lumen is narrower than the wire somewhere on the route; the line says where.
    """
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


def parse_target(anatomy: Anatomy, text: str) -> Target:
    """Return the target that a text names: a section such as "4" or "PDA", or a point "X,Y,Z" in LPS mm.

    A section's target is the middle of it, on the branch that holds most of it; the PDA of a coronary tree is its
    segment 4 (15 where it comes from the left).

    Raises:
        InputError: nothing is named, no such section, a point that is not three numbers, or one outside the lumen.
    """
    if not text.strip():
        raise InputError("--target: is empty; give a section such as 4, or a point X,Y,Z in LPS mm")
    parts = text.split(",")
    if len(parts) == 3:
        return _nearest(anatomy, text, parts)
    tree = anatomy.tree
    names = {name.lower(): index for index, name in enumerate(tree.section_names)}
    wanted = [name for name in _ALIASES.get(text.lower(), (text.lower(),)) if name in names]
    section = names[wanted[0]] if wanted else -1
    length = [_length(branch.centerline, branch.section == section) for branch in tree.branches]
    if not any(length):
        raise InputError(
            f"--target {text}: {anatomy.name} has no such section (it has {', '.join(tree.sections_present)}); "
            "give one of them, or a point X,Y,Z in LPS mm"
        )
    branch = int(np.argmax(length))
    own = tree.branches[branch].centerline.abscissa[tree.branches[branch].section == section]
    return Target(branch=branch, abscissa=float((own[0] + own[-1]) / 2))


_ALIASES = {"pda": ("4", "15"), "lad": ("7",), "lcx": ("13", "11"), "rca": ("3",), "pl": ("16", "14"), "lm": ("5",)}
"""Other names of AHA/SCCT segments."""


def _length(line: Centerline, own: Bool[np.ndarray, "n"]) -> float:
    at = line.abscissa[own]
    return float(at[-1] - at[0]) if len(at) else 0.0


def _nearest(anatomy: Anatomy, text: str, parts: list[str]) -> Target:
    try:
        point = np.array([float(part) for part in parts])
    except ValueError:
        point = np.full(3, np.nan)
    if not np.isfinite(point).all():
        raise InputError(f"--target {text}: not three finite numbers; give a point as X,Y,Z in LPS mm")
    best: tuple[float, int, Int[np.ndarray, ""] | int, float] | None = None
    for index, branch in enumerate(anatomy.tree.branches):
        distance = np.linalg.norm(branch.centerline.points - point, axis=1)
        at = int(np.argmin(distance))
        if best is None or distance[at] < best[0]:
            best = (float(distance[at]), index, at, float(branch.centerline.radius[at]))
    assert best is not None
    distance, index, at, radius = best
    if distance > radius + OUTSIDE_MM:
        raise InputError(
            f"--target {text}: {distance:.1f} mm from the nearest centerline of {anatomy.name}, whose lumen is "
            f"{radius:.1f} mm in radius there; give a point in the vessel, in LPS mm"
        )
    return Target(branch=index, abscissa=float(anatomy.tree.branches[index].centerline.abscissa[at]))
