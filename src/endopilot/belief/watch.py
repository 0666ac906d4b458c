"""Bands around one predicted tip, and when X-ray is due: `Watch`, which an agent and a plan's forecast step."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.belief.adviser import AdviserConfig, Predicted, XrayAdviser
from endopilot.belief.allowance import Allowance
from endopilot.belief.bands import Calibration
from endopilot.belief.innovations import Innovations

MISMATCH = "model mismatch"
"""Why X-ray is asked for while the model is taken to be wrong."""


class Watch:
    """Watches where a model predicts one tip: its adviser, what the bands allow for beside, and the innovations.

    Attributes:
        innovations: what exposures showed of the predictions.
    """

    def __init__(
        self, calibration: Calibration, config: AdviserConfig, tip_radius_mm: float, at: Predicted, *, alone: bool
    ) -> None:
        """Begin at an exposure.

        Args:
            alone: whether the model is of a wire that no catheter is around; else nothing is allowed for.
        """
        self.innovations = Innovations()
        self._adviser = XrayAdviser(calibration, config, tip_radius_mm, at)
        self._allowance = Allowance(at.proximal[0], at.tip[0], alone=alone)
        self._half = self.half_width

    def move(self, at: Predicted) -> None:
        """Take what is predicted a period later."""
        self._allowance.move(at.proximal[0], at.tip[0], at.radius_mm)

    def compare(self, innovation: Float[np.ndarray, "2"], sd_mm: tuple[float, float]) -> None:
        """Take measured less predicted (Δtip, γtip), and the standard deviations that the measurement states, mm."""
        self.innovations.take(innovation, self._half, sd_mm)

    def exposed(self, offset_mm: float, at: Predicted) -> None:
        """Begin anew at an exposure that shows γtip, mm, with what the model then predicts."""
        self._adviser.exposed(offset_mm, at.radius_mm)
        self._allowance.exposed()

    def advise(
        self, at: Predicted, variance_mm2: Float[np.ndarray, "2"] | float = 0.0, *, changed: bool = False
    ) -> bool:
        """Return whether an exposure is due, once a period.

        Args:
            at: what is predicted for now, after the exposure if there was one.
            variance_mm2: of (Δtip, γtip), which the calibration does not know of, mm².
            changed: whether the model is another than the given one, which erred.
        """
        due = self._adviser.advise(
            at,
            np.sqrt(variance_mm2 + self._allowance.sd_mm**2),
            factor=self.innovations.factor,
            always=self.innovations.alarm,
            erred=changed or bool((self.innovations.factor > 1).any()),
            wall_mm=self._allowance.wall_mm(at.radius_mm),
        )
        self._half = self.half_width / self.innovations.factor
        return due

    @property
    def reason(self) -> str:
        """Why X-ray is due if it was at the last call of `advise`."""
        if self.innovations.alarm:
            return MISMATCH
        if self._adviser.late:
            return "the last exposure is long ago"
        if self._adviser.wide:
            return f"Δtip is known to ±{self.half_width[0]:.1f} mm only"
        return "the tip may be reaching the wall"

    @property
    def half_width(self) -> Float[np.ndarray, "2"]:
        """Half-widths of the bands of Δtip and γtip at the last call of `advise`, mm."""
        return self._adviser.half_width
