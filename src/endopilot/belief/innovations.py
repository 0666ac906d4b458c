"""Whether a model is wrong, by what exposures show of its predictions: `Innovations`.

An innovation is what an exposure shows less what was predicted. Its covariance is that of the prediction plus that of
the measurement. Where the innovations are larger, the bands are widened until both agree (covariance matching).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

ASSUMED_SD_MM = (0.5, 0.3)
"""Standard deviations of (Δtip, γtip) of an exposure that states none, mm."""
_WITHIN = 1.645
"""Half-width of a band of 90 %, in standard deviations."""
_FORGETS, _PRIOR = 0.8, 0.5
"""What an innovation weighs at the next exposure; and what it weighs that the bands are as wide as calibrated. One that
an exact measurement shows weighs 1."""
_FAR, _RECENT = 1.6, 5
"""Innovations to the same side add up: one this many times its bound is enough, and so is a mean of n, at most so many,
this many times its bound over √n."""


class Innovations:
    """The innovations of a navigation.

    Attributes:
        factor: by which the bands of Δtip and γtip are widened, 1 or more.
        alarm: whether the model is taken to be wrong: since two of three innovations lay outside, or one or their mean
            was far; until two in a row lie inside.
    """

    def __init__(self) -> None:
        """Begin with the bands as they are calibrated."""
        self.alarm = False
        self.shares: list[float] = []
        self._inside: list[bool] = []
        self._off: list[Float[np.ndarray, "2"]] = []
        self.renew()

    def renew(self) -> None:
        """Take another belief, of whose predictions nothing was seen yet."""
        self.factor, self._inside, self._off = np.ones(2), [], []
        self._excess, self._weight = np.full(2, _PRIOR), np.full(2, _PRIOR)

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
        self.shares.append(share)
        predicted, measured = (np.maximum(half_mm, 1e-3) / _WITHIN) ** 2, noise**2
        information = (predicted / (predicted + measured)) ** 2
        self._excess = _FORGETS * self._excess + information * (innovation**2 - measured) / predicted
        self._weight = _FORGETS * self._weight + information
        self.factor = np.sqrt(np.maximum(self._excess / self._weight, 1.0))
        self._off.append(innovation / bound)
        if self.alarm:
            self.alarm = not (len(self._inside) >= 2 and all(self._inside[-2:]))
        else:
            biased = np.abs(np.sum(self._off[-_RECENT:], axis=0)).max() > _FAR * np.sqrt(len(self._off[-_RECENT:]))
            self.alarm = bool(biased) or self._inside[-3:].count(False) >= 2
