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
_FAR, _RECENT = 2.0, 6
"""Innovations to the same side add up: one this many times its bound is enough, and so is a mean of n, at most so many,
this many times its bound over √n. Bounds are those of bands as calibrated."""
_OUTSIDE, _OF = 1.5, 3
"""Two of so many innovations this many times their bounds are enough too. Bounds are those of widened bands."""
_PROOF, _WIDER = 3, 1.5
"""Images in a row that lie within the bands of a belief that was identified before it is trusted; and how much wider
its bands begin: members that a few images chose are more alike than they are right."""


class Innovations:
    """The innovations of a navigation.

    Attributes:
        factor: by which the bands of Δtip and γtip are widened, 1 or more.
        alarm: whether the model is taken to be wrong: since two of three innovations lay outside, or one or their mean
            was far; until two in a row lie inside, three of a belief that was identified.
    """

    def __init__(self) -> None:
        """Begin with the bands as they are calibrated."""
        self._shares, self._off = list[float](), list[Float[np.ndarray, "2"]]()
        self.factor, self.alarm = np.ones(2), False
        self._excess, self._weight = np.full(2, _PRIOR), np.full(2, _PRIOR)

    def renew(self) -> None:
        """Take another belief, which has yet to prove itself."""
        self.factor, self._shares, self._off = np.full(2, _WIDER), [], []
        self.alarm, self._inside, self._needed = True, 0, _PROOF
        self._excess, self._weight = np.full(2, _WIDER**2 * _PRIOR), np.full(2, _PRIOR)

    @property
    def outside(self) -> bool:
        """Whether one of the last images lay well outside the bands."""
        return max(self._shares[-_OF:], default=0.0) > _OUTSIDE

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
        self._shares.append(share)
        predicted, measured = (np.maximum(half_mm, 1e-3) / _WITHIN) ** 2, noise**2
        information = (predicted / (predicted + measured)) ** 2
        self._excess = _FORGETS * self._excess + information * (innovation**2 - measured) / predicted
        self._weight = _FORGETS * self._weight + information
        self.factor = np.sqrt(np.maximum(self._excess / self._weight, 1.0))
        self._off.append(innovation / np.hypot(half_mm, _WITHIN * noise))
        if self.alarm:
            self._inside = self._inside + 1 if share <= 1.0 else 0
            self.alarm = self._inside < self._needed
        else:
            sums = np.abs(np.cumsum(self._off[: -_RECENT - 1 : -1], axis=0)).max(axis=1)
            biased = sums > _FAR * np.sqrt(np.arange(1, len(sums) + 1))
            outside = np.array(self._shares[-_OF:]) > _OUTSIDE
            self.alarm = bool(biased.any() or outside.sum() >= 2)
            self._inside, self._needed = 0, 2
