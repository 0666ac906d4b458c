"""Settings of the search for a course, `SearchConfig`, and the cost of plans by a network: `Cost`."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float

from endopilot.settings import NonNegative, Positive, Seconds, Within, settings


@settings
class Cost:
    """Weights of the cost of a navigation. One unit is one mm of tip error at the end.

    The cost of a control sequence is e_T + Σ_t c_t·h + w_smooth·Σ_t [ (Δv_t/v_max)² + (Δω_t/ω_max)² ] with
    c = w_tip·e + w_ratio·max(0, ρ − ρ₀)² + w_force·f² + w_time: h is the sample period (s), e the distance of the tip
    from where it is to be (mm), ρ = γ/(r − r_w) the safety ratio and ρ₀ the safe one, f the largest wall force
    on a node over the limit, v and ω the controls.
    """

    tip_weight: NonNegative = 0.1
    """Tip error before the end, 1/s."""
    ratio_weight: NonNegative = 0.05
    """Safety ratio above `safe_ratio`, mm/s. A wire lies on the wall most of the time, which is no harm by itself."""
    safe_ratio: NonNegative = 0.8
    """Safety ratio below which nothing is charged."""
    force_weight: NonNegative = 8.0
    """Contact force, as a share of the limit squared, mm/s."""
    time_weight: NonNegative = 1.0
    """Time, mm/s."""
    smooth_weight: NonNegative = 0.05
    """Changes of the control, as a share of the drive's limits squared, mm."""

    def roughness(
        self, before: Float[np.ndarray, "*n 2"], after: Float[np.ndarray, "*n 2"], limits: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "*n"]:
        """Return what a change from one control to the next costs, mm."""
        return self.smooth_weight * np.square((after - before) / limits).sum(axis=-1)


@settings
class SearchConfig:
    """How fast devices are moved in a search, and how a catheter follows its wire; `motions.yaml` has what is tried."""

    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Translation of a device that is pushed straight on, mm/s."""
    turn_rad_s: Annotated[float, Within(0.01, 1000)] = 7.0
    """Fastest rotation that is tried, rad/s."""
    lead_mm: Positive = 4.0
    """Devices are turned this far before a junction, mm, or 1.4 lumen radii where that is more."""
    behind_mm: Positive = 10.0
    """The catheter follows to this far behind the wire's tip, mm, except to the target if its own tip is to arrive."""
    together: bool = False
    """The wire goes on while its catheter follows, instead of resting: in half the time."""
    longest_s: Seconds = 30.0
    """A motion that leads past a place takes this much longer than twice the way at full speed at most, s."""
