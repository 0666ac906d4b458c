"""Settings of a plan, `PlanConfig`, and the plan itself, `Plan`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.course import Controls
from endopilot.control.search_config import Cost
from endopilot.control.set_up import TILT_DEG
from endopilot.devices.drive_limits import DriveLimits
from endopilot.settings import Finite, Positive, Seconds, Seed, Text, Within, settings
from endopilot.simulation.trajectory import Trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, Arrives, Navigation
from endopilot.types import TipProjection

Method = Literal["search", "inverse", "forward", "spin", "retract-rotate"]
Steps = Float[np.ndarray, "samples 2"]


@settings
class PlanConfig:
    """Method, limits and cost of a plan."""

    method: Method = "search"
    """How the controls are found: search (searched in the rod core), inverse (led along desired tips: by the inverse
    network of --model, or else by a simulated wire), or a baseline: forward, spin, retract-rotate."""
    seconds: Seconds = 60.0
    """Time in which the target is to be reached, s."""
    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Speed of the desired tip along the route, mm/s."""
    tip: Text = "auto"
    """Shape of the wire's tip: auto (chosen for the forks of the route), own (the device's), or angle and length such
    as 75/5, 75 degrees over 5 mm. A trained model goes with its device's own."""
    catheter_tilt_deg: Annotated[float, Within(0, 45)] = TILT_DEG
    """How far the guiding catheter may be turned at the ostium where a fork cannot be entered otherwise, degrees."""
    arrives: Arrives = "wire"
    """Whose tip is to go to the target: wire, or catheter, the one around the wire."""
    start_inserted_length_mm: Annotated[float, Within(0, 5000)] = 2.0
    """Inserted length at the start, mm."""
    start_rotation_rad: Finite = 0.0
    """Rotation at the start, rad."""
    force_limit_n: Positive = 0.5
    """Largest force of the wall on one node that is safe, N."""
    seed: Seed = 0
    """Seed of what is drawn at random."""
    cost: Cost = field(default_factory=Cost)
    """Weights of the cost."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned navigation; row t is the end of sample period t, `DECISION_PERIOD_S` long.

    Attributes:
        navigation: what is to be done.
        config: its settings.
        model: the trained run that it was found with, if any.
        trajectory: what the rod core, at its own settings, makes of the plan's controls.
        desired: desired tip states (Δtip, γtip), mm.
        predicted: tip states that the model predicts, mm.
        reached: whether the target is reached at the end of a period in the rod core.
        why: why the tip has its shape and the catheter its axis; empty where both are the given ones.
        tilt_deg: angle by which the catheter was turned from the anatomy's axis, degrees.
        seconds_to_plan: wall time that finding the controls took, s.
        processor_seconds: processor time of it, s.
    """

    navigation: Navigation
    config: PlanConfig
    model: str | None
    trajectory: Trajectory
    desired: Steps
    predicted: Steps
    reached: bool
    why: str
    tilt_deg: float
    seconds_to_plan: float
    processor_seconds: float

    @property
    def control(self) -> Controls:
        """π, mm/s and rad/s, of each device."""
        return self.trajectory.command[0]

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
    def arriving_tip(self) -> TipProjection:
        """Where the tip that is to go to the target lies in the rod core."""
        return self.tip[:, self.navigation.arriving]

    @property
    def within_force_limit(self) -> bool:
        """Whether no node ever presses on the wall with more than the navigation's limit, in the rod core."""
        return bool(self.force.max() <= self.navigation.force_limit_n)

    def cost_terms(self) -> dict[str, float]:
        """Return what each term of the cost comes to in the rod core, mm; all but `end` are the wire's."""
        device, weights = self.navigation.device, self.config.cost
        error = np.abs(self.tip.abscissa[:, 0] - self.desired[:, 0])
        share = self.force / self.navigation.force_limit_n
        fastest = DriveLimits.of(device).fastest
        h = DECISION_PERIOD_S
        return {
            "end": abs(float(self.arriving_tip.abscissa[-1]) - self.navigation.target.abscissa),
            "tip": float(weights.tip_weight * error.sum() * h),
            "ratio": float(weights.ratio_weight * (np.maximum(self.ratio - weights.safe_ratio, 0) ** 2).sum() * h),
            "force": float(weights.force_weight * (share**2).sum() * h),
            "time": float(weights.time_weight * len(error) * h),
            "smooth": float(weights.roughness(self.control[:-1, 0], self.control[1:, 0], fastest).sum()),
        }
