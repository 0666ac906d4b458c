"""What a navigation is: one vessel, one wire, one target, and when it counts as reached. One definition for all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.errors import InputError
from endopilot.simulation.device import Device
from endopilot.types import Anatomy, TipProjection

DECISION_PERIOD_S = 0.5
"""Time between two decisions, s: the paper's sample period, at which its models speak."""
SUCCESS_MM = 2.0
"""A target counts as reached when the tip lies in its branch, this near to it along the centerline, mm."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """A place on the centerline.

    Attributes:
        branch: index of the branch in `VesselTree.branches`.
        abscissa: distance from the ostium along the path, mm; it lies on that branch.
    """

    branch: int
    abscissa: float

    def position(self, anatomy: Anatomy) -> Float[np.ndarray, "3"]:
        """Return the target's place on the centerline, LPS mm."""
        line = anatomy.tree.branches[self.branch].centerline
        return np.array([np.interp(self.abscissa, line.abscissa, axis) for axis in line.points.T])


@dataclass(frozen=True, kw_only=True, eq=False)
class Navigation:
    """One wire that is to be brought to one target.

    Attributes:
        anatomy: the vessel.
        device: the wire.
        target: where its tip is to go.
        start_inserted_mm: inserted length Δ at the start, mm.
        start_rotation: rotation φ at the start, rad.
        seconds: time in which the target is to be reached, s.
        force_limit_n: largest force of the wall on one node that is safe, N.
    """

    anatomy: Anatomy
    device: Device
    target: Target
    start_inserted_mm: float = 2.0
    start_rotation: float = 0.0
    seconds: float = 60.0
    force_limit_n: float = 0.5

    def __post_init__(self) -> None:
        """Check the target and the limits.

        Raises:
            InputError: the target does not lie on the tree, or a limit is not positive.
        """
        branches = self.anatomy.tree.branches
        if not 0 <= self.target.branch < len(branches):
            raise InputError(
                f"target.branch: {self.target.branch}; {self.anatomy.name} has branches 0 to {len(branches) - 1}"
            )
        line = branches[self.target.branch].centerline.abscissa
        if not line[0] <= self.target.abscissa <= line[-1]:
            raise InputError(
                f"target.abscissa: {self.target.abscissa:g} mm; branch {self.target.branch} of {self.anatomy.name} "
                f"runs from {line[0]:.1f} to {line[-1]:.1f} mm"
            )
        for name in ("seconds", "force_limit_n"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: {getattr(self, name)} is not positive; give a positive number")

    def reached(self, tip: TipProjection) -> Bool[np.ndarray, "..."]:
        """Return which tips have reached the target: in its branch, within `SUCCESS_MM` of it along the centerline."""
        return reached(tip, self.target.branch, self.target.abscissa)


def reached(
    tip: TipProjection, branch: int | Int[np.ndarray, "..."], abscissa: float | Float[np.ndarray, "..."]
) -> Bool[np.ndarray, "..."]:
    """Return which tips have reached targets: in their branch, within `SUCCESS_MM` of them along the centerline.

    Args:
        tip: the tips.
        branch: of the target of all, or of each.
        abscissa: of the target of all, or of each, mm.
    """
    return (np.abs(tip.abscissa - abscissa) <= SUCCESS_MM) & (tip.branch == branch)
