"""Bands around one predicted tip, and when X-ray is due: `Watch`, which an agent and a plan's forecast step.

`Innovations` says whether a model is wrong. An innovation is what an exposure shows less what was predicted. Its
covariance is that of the prediction plus that of the measurement. Where the innovations are larger, the bands are
widened until both agree (covariance matching).

`Allowance` is what no calibration knows. A wire that is pushed while its tip rests buckles, and then snaps or folds,
which no two wires do alike. In a wide lumen it lies down on the outer walls of bends before, which simulated wires
predict.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.belief.adviser import AdviserConfig, Predicted, XrayAdviser
from endopilot.belief.bands import Calibration
from endopilot.devices.drive_limits import SLACK_WIDTHS, WIDE_MM

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
_PROOF, _WIDER, _UNKNOWN = 3, 1.5, 2.5
"""Images in a row that lie within the bands of a belief that was identified before it is trusted; how much wider its
bands begin: members that a few images chose are more alike than they are right; and where no hypothesis explains the
images: an assumption, until innovations tell."""


class Innovations:
    """Whether a model is wrong, by the innovations of a navigation: what exposures show less what was predicted.

    The covariance of an innovation is that of the prediction plus that of the measurement. Where the innovations are
    larger, the bands are widened until both agree (covariance matching).

    Attributes:
        factor: by which the bands of Δtip and γtip are widened, 1 or more.
        alarm: whether the model is taken to be wrong: since two of three innovations lay outside, or one or their mean
            was far; until two in a row lie inside, three of a belief that was identified.
    """

    def __init__(self) -> None:
        self._shares, self._off = list[float](), list[Float[np.ndarray, "2"]]()
        self.factor, self.alarm = np.ones(2), False
        self._excess, self._weight = np.full(2, _PRIOR), np.full(2, _PRIOR)

    def renew(self, *, unknown: bool = False) -> None:
        """Take another belief, which has yet to prove itself, or explains nothing: what is wrong is unknown."""
        wider = _UNKNOWN if unknown else _WIDER
        self.factor, self._shares, self._off = np.full(2, wider), [], []
        self.alarm, self._inside, self._needed = True, 0, _PROOF
        self._excess, self._weight = np.full(2, wider**2 * _PRIOR), np.full(2, _PRIOR)

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


_LUMEN_SHARE, _LUMEN_MM = 0.12, 0.3
"""The lumen's radius may be off by this share, and no more than this, mm: CT shows it to a tenth or a voxel and blooms,
an assumption."""
_FREE_MM, _HELD_SHARE = 5.0, np.array([0.3, 0.05])
"""A wire that is moved by more than this while its tip rests buckles: standard deviations of (Δtip, γtip) that this
adds, as shares of what goes beyond, mm; found in coronary arteries with compliant walls, on patients to improve agents
on. In a wide lumen it folds later (`SLACK_WIDTHS`)."""
_TIP_MM = np.array([0.2, 0.0])
"""Standard deviations of (Δtip, γtip) that are always added, mm: a tip is shaped by hand, and simulated wires that all
have the given one agree better than they are right; found with other tips, on patients to improve agents on."""


class Allowance:
    """What a wire's bands allow for that no calibration knows.

    The lumen may be another than CT shows it, and the tip another than it is given. A wire that is pushed while its tip
    rests buckles, and then snaps or folds, which no two wires do alike. In a wide lumen it lies down on the outer walls
    of bends before, which simulated wires predict.

    Attributes:
        held_mm: by how much the wire was moved while its tip rested, since the last exposure, mm.
    """

    def __init__(self, inserted_mm: float, abscissa_mm: float, *, alone: bool) -> None:
        """Begin at an exposure.

        Args:
            alone: whether no catheter is around the wire; nothing is allowed for where one is.
        """
        self._at, self._alone, self.held_mm = np.array([inserted_mm, abscissa_mm]), alone, 0.0
        self._width_mm = 0.0

    def move(self, inserted_mm: float, abscissa_mm: float, radius_mm: float) -> None:
        """Take where the wire's ends are a period later, and the lumen's radius at its tip, mm."""
        self._width_mm = max(self._width_mm, 2 * radius_mm)
        now = np.array([inserted_mm, abscissa_mm])
        moved, tip_moved = np.abs(now - self._at).tolist()
        self._at, self.held_mm = now, self.held_mm + max(moved - tip_moved, 0.0)

    def exposed(self) -> None:
        """Begin anew at an exposure."""
        self.held_mm = 0.0

    def wall_mm(self, radius_mm: float) -> float:
        """Return by how much the lumen's radius may be another, mm, where it is given as this, mm."""
        return min(_LUMEN_SHARE * radius_mm, _LUMEN_MM) * self._alone

    @property
    def sd_mm(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of (Δtip, γtip), mm."""
        free_mm = SLACK_WIDTHS * self._width_mm if self._width_mm > WIDE_MM else _FREE_MM
        return np.hypot(_HELD_SHARE * max(self.held_mm - free_mm, 0.0), _TIP_MM) * self._alone


_PRESSES = np.array([0.8, 1.0, 1.25])
"""Shares of the largest force that the wall may press with, by simulated wires and the drive's load, at which it is
looked at: both ends of the band, for they err by a fifth, as wires do, and its middle."""
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
        self._half, self._presses = self.half_width, 0

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
        self,
        at: Predicted,
        variance_mm2: Float[np.ndarray, "2"] | float = 0.0,
        *,
        changed: bool = False,
        pressed: float = 0.0,
    ) -> bool:
        """Return whether an exposure is due, once a period.

        Args:
            at: what is predicted for now, after the exposure if there was one.
            variance_mm2: of (Δtip, γtip), which the calibration does not know of, mm².
            changed: whether the model is another than the given one, which erred.
            pressed: force of the wall as a share of what it may be.
        """
        self._presses, pressed_before = int((pressed >= _PRESSES).sum()), self._presses
        due = self._adviser.advise(
            at,
            np.sqrt(variance_mm2 + self._allowance.sd_mm**2),
            factor=self.innovations.factor,
            always=self.innovations.alarm,
            erred=changed or bool((self.innovations.factor > 1).any()),
            wall_mm=self._allowance.wall_mm(at.radius_mm),
            presses=self._presses > pressed_before,
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
        return "the wall presses hard" if self._presses else "the tip may be reaching the wall"

    @property
    def half_width(self) -> Float[np.ndarray, "2"]:
        """Half-widths of the bands of Δtip and γtip at the last call of `advise`, mm."""
        return self._adviser.half_width
