"""Whether a model is wrong, by what exposures show of its predictions: `Innovations`.

An innovation is what an exposure shows less what was predicted. Its covariance is that of the prediction plus that of
the measurement. Where the innovations are larger, the bands are widened until both agree (covariance matching).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

ASSUMED_SD_MM = (0.5, 0.12)
"""Standard deviations of (Δtip, γtip) of an exposure that states none, mm."""
_WITHIN = 1.645
"""Half-width of a band of 90 %, in standard deviations."""
_FORGETS, _PRIOR = 0.7, 1.5
"""What an innovation weighs at the next exposure; and what it weighs that the bands are as wide as calibrated."""
_FAR = 2.0
"""One innovation this many times beyond its bound is enough."""


class Innovations:
    """The innovations of a navigation.

    Attributes:
        factor: by which the bands of Δtip and γtip are widened, 1 or more.
        alarm: whether the model is taken to be wrong: since two of three innovations, or one far, lay outside; until
            two in a row lie inside.
    """

    def __init__(self) -> None:
        """Begin with the bands as they are calibrated."""
        self.reset()

    def reset(self) -> None:
        """Forget all innovations: the belief is another one."""
        self.factor, self.alarm = np.ones(2), False
        self._excess, self._weight = np.full(2, _PRIOR), _PRIOR
        self._inside: list[bool] = []

    def take(
        self, innovation: Float[np.ndarray, "2"], half_mm: Float[np.ndarray, "2"], sd_mm: tuple[float, float]
    ) -> None:
        """Take what an exposure shows.

        Args:
            innovation: measured less predicted (Δtip, γtip), mm.
            half_mm: half-widths of the bands as calibrated, mm.
            sd_mm: standard deviations of the measurement, mm; 0 where it states none.
        """
        noise = np.where(np.array(sd_mm) > 0, sd_mm, ASSUMED_SD_MM)
        bound = np.hypot(self.factor * half_mm, _WITHIN * noise)
        share = float(np.max(np.abs(innovation) / bound))
        self._inside.append(share <= 1.0)
        predicted = np.maximum(half_mm / _WITHIN, 1e-3)
        self._excess = _FORGETS * self._excess + np.maximum(innovation**2 - noise**2, 0.0) / predicted**2
        self._weight = _FORGETS * self._weight + 1.0
        self.factor = np.sqrt(np.maximum(self._excess / self._weight, 1.0))
        if self.alarm:
            self.alarm = not all(self._inside[-2:])
        else:
            self.alarm = share > _FAR or self._inside[-3:].count(False) >= 2
