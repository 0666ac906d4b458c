"""What X-ray must not miss, and what a model predicts of a tip: `AdviserConfig`, `Predicted`; `watch` advises."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from endopilot.settings import OpenShare, Positive, settings
from endopilot.tasks.navigation import SUCCESS_MM


@settings
class AdviserConfig:
    """What X-ray must not miss, and how sure the bands are to be."""

    level: OpenShare = 0.9
    """Share of the intervals without X-ray in which the bands shall hold throughout."""
    wall_ratio: Positive = 0.7
    """τ: an event begins where γtip/(lumen radius − wire radius) reaches it; 1 is the wall."""
    abscissa_mm: Positive = SUCCESS_MM
    """δ: an event begins where Δtip errs by this much, mm; as near as a target counts as reached if not given."""
    missed: OpenShare = 0.05
    """Share of the events that may be missed: the calibration finds how much of γtip's band the adviser must use."""


class Predicted(NamedTuple):
    """What a model predicts of one tip."""

    proximal: Float[np.ndarray, "2"]
    """Δ, mm, and φ, rad, of the wire."""
    tip: Float[np.ndarray, "2"]
    """Δtip and γtip, mm."""
    spread: Float[np.ndarray, "2"]
    """The model's estimate of its own error of these, a standard deviation, mm."""
    radius_mm: float
    """Of the lumen at that Δtip."""
