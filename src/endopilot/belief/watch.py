"""Bands around one predicted tip, and when X-ray is due: `Watch`, which an agent and a plan's forecast step."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.belief.adviser import AdviserConfig, XrayAdviser
from endopilot.belief.allowance import Allowance
from endopilot.belief.bands import Calibration
from endopilot.belief.innovations import Innovations

AdviserInput = tuple[
    Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1 2"], Float[np.ndarray, "1"]
]
"""What an adviser is given of a navigation: (Δ, φ), mm and rad; (Δtip, γtip), mm; the spread (standard deviation) of
these as the model states it, mm; and the lumen's radius at the tip, mm."""

MISMATCH = "model mismatch"
"""Why X-ray is asked for while the model is taken to be wrong."""


class Watch:
    """Watches where a model predicts one tip: its adviser, what the bands allow for beside, and the innovations.

    Attributes:
        innovations: what exposures showed of the predictions.
    """

    def __init__(
        self, calibration: Calibration, config: AdviserConfig, tip_radius_mm: float, at: AdviserInput, *, alone: bool
    ) -> None:
        """Begin at an exposure.

        Args:
            calibration: of the model that predicts.
            config: which events X-ray must not miss.
            tip_radius_mm: radius of the wire at its tip, mm.
            at: what the model predicts there.
            alone: whether the model is of a wire that no catheter is around; else nothing is allowed for.
        """
        proximal, tip, spread, radius = at
        self.innovations = Innovations()
        self._adviser = XrayAdviser(calibration, config, tip_radius_mm)
        self._allowance = Allowance(proximal[0, 0], tip[0, 0], alone=alone)
        self._adviser.start(proximal, tip, radius)
        self._half = self._adviser.widths(spread)[0]

    def move(self, at: AdviserInput) -> None:
        """Take what is predicted a period later."""
        proximal, tip, _, radius = at
        self._allowance.move(proximal[0, 0], tip[0, 0], float(radius[0]))

    def compare(self, innovation: Float[np.ndarray, "2"], sd_mm: tuple[float, float]) -> None:
        """Take measured less predicted (Δtip, γtip), and the standard deviations that the measurement states, mm."""
        self.innovations.take(innovation, self._half, sd_mm)

    def exposed(self, offset_mm: float, at: AdviserInput) -> None:
        """Begin anew at an exposure that shows γtip, mm, with what the model then predicts."""
        self._adviser.exposed(np.array([offset_mm]), at[3])
        self._allowance.exposed()

    def advise(
        self, at: AdviserInput, variance_mm2: Float[np.ndarray, "2"] | float = 0.0, *, changed: bool = False
    ) -> bool:
        """Return whether an exposure is due, once a period.

        Args:
            at: what is predicted for now, after the exposure if there was one.
            variance_mm2: of (Δtip, γtip), which the calibration does not know of, mm².
            changed: whether the model is another than the given one, which erred.
        """
        proximal, tip, spread, radius = at
        further = np.sqrt(variance_mm2 + self._allowance.sd_mm**2)[None]
        due = self._adviser.advise(
            *(proximal, tip, spread, radius, further),
            factor=self.innovations.factor,
            always=self.innovations.alarm,
            erred=changed or bool((self.innovations.factor > 1).any()),
            wall_mm=self._allowance.wall_mm(radius),
        )
        self._half = self.half_width / self.innovations.factor
        return bool(due[0])

    @property
    def reason(self) -> str:
        """Why X-ray is due if it was at the last call of `advise`."""
        if self.innovations.alarm:
            return MISMATCH
        if self._adviser.late[0]:
            return "the last exposure is long ago"
        if self._adviser.wide[0]:
            return f"Δtip is known to ±{self.half_width[0]:.1f} mm only"
        return "the tip may be reaching the wall"

    @property
    def half_width(self) -> Float[np.ndarray, "2"]:
        """Half-widths of the bands of Δtip and γtip at the last call of `advise`, mm."""
        return self._adviser.half_width[0]
