"""How reality differs from the navigation that a policy is given: `ModelMismatch`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from endopilot.anatomy.catheter_axis import turned_axis, with_axis
from endopilot.devices.catheter import Catheter
from endopilot.settings import Finite, NonNegative, Positive, Within, settings
from endopilot.types import Anatomy

QUANTITIES = ("friction", "stiffness", "latency", "ostium")
"""What differs: friction coefficient, stiffness of the tip, the robot's latency, and the position of the ostium along
the catheter's axis, the last in units of the lumen's diameter there. The robot holds its latency itself, and delays
its copy with `RobotConfig.delayed`."""


@settings
class ModelMismatch:
    """How vessel and devices differ in reality from the navigation that the policy is given.

    The robot is no part of a navigation: `RobotConfig` says how it truly is.
    """

    friction_factor: NonNegative = 1.0
    """Factor on the friction coefficient."""
    stiffness_factor: Positive = 1.0
    """Factor on the stiffness of the wire's distal 10 mm."""
    ostium_mm: Finite = 0.0
    """The wire is inserted this much deeper than the encoder says, mm: the ostium lies elsewhere along the catheter."""
    axis_deg: Annotated[float, Within(0, 45)] = 0.0
    """The guiding catheter leans by this angle off its given axis, degrees."""
    axis_side_deg: Finite = 0.0
    """To which side it leans, degrees around the given axis."""

    def anatomy(self, given: Anatomy) -> Anatomy:
        """Return the vessel with its guiding catheter as it is in reality."""
        if self.axis_deg == 0:
            return given
        return with_axis(given, turned_axis(given.insertion.direction, self.axis_deg, self.axis_side_deg))

    def catheters(self, given: Sequence[Catheter]) -> tuple[Catheter, ...]:
        """Return catheters as they are in reality: their friction on the wall differs as the wire's does."""
        return tuple(replace(each, friction=each.friction * self.friction_factor) for each in given)


def drawn_sides(share: float, random: np.random.Generator) -> dict[str, float]:
    """Return by which share each of `QUANTITIES` differs: all by the same, each up or down."""
    return dict(zip(QUANTITIES, (share * random.choice([-1.0, 1.0], 4)).tolist(), strict=True))


def mismatch_by(change: Mapping[str, float], anatomy: Anatomy) -> ModelMismatch:
    """Return the mismatch in which some of `QUANTITIES` differ by a share; the latency is the robot's.

    Args:
        change: share by quantity; what is not there does not differ.
        anatomy: the vessel, whose lumen at the ostium is the unit of the ostium's place.
    """
    diameter_mm = 2 * float(anatomy.tree.branches[0].centerline.radius[0])
    return ModelMismatch(
        friction_factor=1 + change.get("friction", 0.0),
        stiffness_factor=1 + change.get("stiffness", 0.0),
        ostium_mm=change.get("ostium", 0.0) * diameter_mm,
    )
