"""What a navigation is: one vessel, one wire, one target, and when it counts as reached. One definition for all."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import InstanceOf, model_validator

from endopilot.settings import CountOrZero, Finite, NonNegative, Positive, settings
from endopilot.simulation.device import Device
from endopilot.types import Anatomy, TipProjection

DECISION_PERIOD_S = 0.5
"""Time between two decisions, s: the paper's sample period, at which its models speak."""
SUCCESS_MM = 2.0
"""A target counts as reached when the tip lies in its branch, this near to it along the centerline, mm."""


@settings
class Target:
    """A place on the centerline.

    Attributes:
        branch: index of the branch in `VesselTree.branches`.
        abscissa: distance from the ostium along the path, mm; it lies on that branch.
    """

    branch: CountOrZero
    abscissa: NonNegative

    def position(self, anatomy: Anatomy) -> Float[np.ndarray, "3"]:
        """Return the target's place on the centerline, LPS mm."""
        line = anatomy.tree.branches[self.branch].centerline
        return np.array([np.interp(self.abscissa, line.abscissa, axis) for axis in line.points.T])


@settings(eq=False)
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

    anatomy: InstanceOf[Anatomy]
    device: Device
    target: Target
    start_inserted_mm: NonNegative = 2.0
    start_rotation: Finite = 0.0
    seconds: Positive = 60.0
    force_limit_n: Positive = 0.5

    @model_validator(mode="after")
    def _consistent(self) -> Navigation:
        branches = self.anatomy.tree.branches
        if not 0 <= self.target.branch < len(branches):
            raise ValueError(
                f"target.branch: {self.target.branch}; {self.anatomy.name} has branches 0 to {len(branches) - 1}"
            )
        line = branches[self.target.branch].centerline.abscissa
        if not line[0] <= self.target.abscissa <= line[-1]:
            raise ValueError(
                f"target.abscissa: {self.target.abscissa:g} mm; branch {self.target.branch} of {self.anatomy.name} "
                f"runs from {line[0]:.1f} to {line[-1]:.1f} mm"
            )
        return self

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
