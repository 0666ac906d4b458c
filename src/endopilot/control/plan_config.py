"""Settings of a plan, `PlanConfig`, and the plan itself, `Plan`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.course import Controls
from endopilot.control.set_up import GivenConfig, TipChoice
from endopilot.settings import Within, settings
from endopilot.simulation.trajectory import Trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection

Steps = Float[np.ndarray, "samples 2"]


@settings
class PlanConfig(GivenConfig):
    """Method and limits of a plan."""

    method: Literal["search", "inverse"] = "search"
    """How the controls are found: search (searched in the rod core), or inverse (led along desired tips: by the inverse
    network of --model, or else by a simulated wire)."""
    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Speed of the desired tip along the route, and of a straight push, mm/s."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned navigation; row t is the end of sample period t, `DECISION_PERIOD_S` long.

    Attributes:
        navigation: what is to be done.
        config: its settings.
        model: the trained run that it was found with, if any.
        trajectory: what the rod core, at its own settings, makes of the plan's controls. Its columns are the tip states
            (Δtip, γtip), mm, that the method's model `predicted`, and those `desired` if it was led along some.
        choice: of the tip's shape and the catheter's axis; None where a trained model has the wire's own.
        seconds_to_plan: processor time that finding the controls took, s.
    """

    navigation: Navigation
    config: PlanConfig
    model: str | None
    trajectory: Trajectory
    choice: TipChoice | None
    seconds_to_plan: float

    @property
    def control(self) -> Controls:
        """π, mm/s and rad/s, of each device."""
        return self.trajectory.command[0]

    @property
    def predicted(self) -> Steps:
        """Tip states that the method's model predicts, mm."""
        return self.trajectory.columns["predicted"][0]

    @property
    def tip(self) -> TipProjection:
        """Where the rod core has the tips, a column a device."""
        return self.trajectory.tip[0]

    @property
    def force(self) -> Float[np.ndarray, "samples"]:
        """Largest wall force on one node in the rod core, N."""
        return self.trajectory.contact_force_max[0]

    @property
    def seconds(self) -> float:
        """How long the planned navigation takes, s."""
        return DECISION_PERIOD_S * len(self.control)

    @property
    def ratio(self) -> Float[np.ndarray, "samples"]:
        """Safety ratio γ/(r − r_w) of the wire in the rod core."""
        tip = self.tip[:, 0]
        return safety_ratio(tip.offset, tip.radius, self.navigation.device.tip_radius_mm)

    @property
    def end_mm(self) -> float:
        """Where the tip that is to go to the target ends in the rod core, mm along the centerline."""
        return float(self.tip.abscissa[-1, self.navigation.arriving])

    @property
    def reached(self) -> bool:
        """Whether the target is reached at the end of a period in the rod core."""
        return bool(self.navigation.reached(self.tip).any())

    @property
    def within_force_limit(self) -> bool:
        """Whether no node ever presses on the wall with more than the navigation's limit, in the rod core."""
        return bool(self.force.max() <= self.navigation.force_limit_n)
