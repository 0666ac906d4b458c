"""Bands around one predicted tip, and when X-ray is due: `Watch`, which an agent and a plan's forecast step.

`Innovations` says whether a model is wrong. An innovation is what an exposure shows less what was predicted. Its
covariance is that of the prediction plus that of the measurement. Where the innovations are larger, the bands are
widened until both agree (covariance matching).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import AdviserConfig, Calibration, Predicted
from endopilot.devices.drive_limits import SLACK_WIDTHS, WIDE_MM
from endopilot.tasks.navigation import DECISION_PERIOD_S

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


_ALWAYS = 3
"""Periods from one exposure to the next where a model is taken to be wrong, and each image is to test it."""
_STILL_MM = 0.1
"""Where neither tip nor proximal end has moved by more since an exposure, mm, another shows the same."""
_SOFT_MM = 0.03
"""Added to the standard deviation of how far a tip is from τ, mm: the lumen's radius is read off a smoothed line."""
_FORCE_SD = 0.2
"""Standard deviation of the logarithm of a simulated wire's force: it errs by a fifth, as wires do."""
MISMATCH = "model mismatch"
"""Why X-ray is asked for while the model is taken to be wrong."""


class Watch:
    """Says when to switch X-ray on where a model predicts one tip, and how wide the bands around it are.

    An exposure is due where the tip is δ astray, or came to the wall unseen, more likely than the calibration bears
    (`onset`); where the wall begins to press; after an interval as long as any that was calibrated on; and every 1.5 s
    while the model is taken to be wrong. One shows what began within the last 0.5 s, so none follows another sooner
    than after 1 s, and a wire that rests is not looked at twice.

    Bands allow for what no calibration knows, too: the lumen may be another than CT shows it, the tip another than it
    is given. A wire that is pushed while its tip rests buckles, and then snaps or folds, which no two wires do alike.
    In a wide lumen it lies down on the outer walls of bends before, which simulated wires predict.

    Attributes:
        innovations: what exposures showed of the predictions.
        half_width: of the whole bands of Δtip and γtip at the last call of `advise`, mm.
        held_mm: by how much the wire was moved while its tip rested, since the last exposure, mm.
    """

    def __init__(
        self, calibration: Calibration, config: AdviserConfig, tip_radius_mm: float, at: Predicted, *, alone: bool
    ) -> None:
        """Begin at an exposure.

        Args:
            config: τ and δ.
            alone: whether the model is of a wire that no catheter is around; else nothing is allowed for.
        """
        self.innovations, self._alone = Innovations(), alone
        self._calibration, self._config, self._tip_radius_mm = calibration, config, tip_radius_mm
        self._inserted_mm, self._travel_mm, self._periods = float(at.proximal[0]), 0.0, 0
        self._ends_mm, self._width_mm, self.held_mm = np.array([at.proximal[0], *at.tip]), 0.0, 0.0
        self._moved_mm, self._astray, self._late, self._pressed, self._presses = 0.0, False, False, 0.0, False
        self.half_width = self._half = self._widths(at.spread, np.zeros(2))
        self._at_wall = self._contact(at)

    def move(self, at: Predicted) -> None:
        """Take what is predicted a period later."""
        self._width_mm = max(self._width_mm, 2 * at.radius_mm)
        now = np.array([at.proximal[0], *at.tip])
        moved, tip_moved, across = np.abs(now - self._ends_mm).tolist()
        self._ends_mm, self.held_mm = now, self.held_mm + max(moved - tip_moved, 0.0)
        self._moved_mm += max(moved, tip_moved, across)

    def compare(self, innovation: Float[np.ndarray, "2"], sd_mm: tuple[float, float]) -> None:
        """Take measured less predicted (Δtip, γtip), and the standard deviations that the measurement states, mm."""
        self.innovations.take(innovation, self._half, sd_mm)

    def exposed(self, offset_mm: float, at: Predicted) -> None:
        """Begin anew at an exposure that shows γtip, mm, with what the model then predicts."""
        self._periods, self._travel_mm, self.held_mm, self._moved_mm = 0, 0.0, 0.0, 0.0
        shown = safety_ratio(np.array([offset_mm]), np.array([at.radius_mm]), self._tip_radius_mm)
        self._at_wall = float(shown[0] >= self._config.wall_ratio)

    def advise(
        self,
        at: Predicted,
        variance_mm2: Float[np.ndarray, "2"] | float = 0.0,
        *,
        harder: float = 1.0,
    ) -> bool:
        """Return whether an exposure is due, once a period.

        Args:
            at: what is predicted for now, after the exposure if there was one.
            variance_mm2: of (Δtip, γtip), which the calibration does not know of, mm².
            harder: how much harder the drive pushes than is predicted: walls press on simulated wires by as much more.
        """
        inserted_mm, factor = float(at.proximal[0]), self.innovations.factor
        self._periods, self._travel_mm = self._periods + 1, self._travel_mm + abs(inserted_mm - self._inserted_mm)
        self._inserted_mm = inserted_mm
        half = factor * self._widths(at.spread, np.sqrt(variance_mm2 + self.sd_mm**2))
        self.half_width = np.array([half[0], np.hypot(half[1], self.wall_mm(at.radius_mm))])
        self._half = self.half_width / factor
        onset, members = self._calibration.onset, at.members
        to_either_side = np.multiply.outer((1.0, -1.0), members.apart_mm) - self._config.abscissa_mm
        astray = ndtr(to_either_side * _WITHIN / max(half[0], 1e-9)).sum(axis=0)
        self._astray = float(members.weight @ astray) >= onset
        self._late = self._periods * DECISION_PERIOD_S >= self._calibration.longest_s
        pressed = float(members.weight @ ndtr(np.log(np.maximum(harder * members.pressed, 1e-9)) / _FORCE_SD))
        self._presses = pressed - self._pressed >= onset
        comes = 0.0
        if self._periods > 1:  # else X-ray shows it
            before, self._at_wall = self._at_wall, self._contact(at)
            comes = self._at_wall * (1 - before)
        due = comes >= onset or self._astray or self._late or self._presses
        due = due or (self.innovations.alarm and self._periods >= _ALWAYS)
        due = due and self._periods > 1 and self._moved_mm > _STILL_MM
        if due:
            self._periods, self._travel_mm = 0, 0.0
        self._pressed = pressed if due else min(self._pressed, pressed)
        return due

    def _contact(self, at: Predicted) -> float:
        """Return how likely the tip is at the wall."""
        members = at.members
        missing = self._config.wall_ratio - safety_ratio(members.offset_mm, members.radius_mm, self._tip_radius_mm)
        clearance_mm = np.maximum(members.radius_mm - self._tip_radius_mm, 1e-9)
        away = missing * clearance_mm / (float(self.half_width[1]) / _WITHIN + _SOFT_MM)
        return float(members.weight @ ndtr(-away))

    def _widths(self, spread: Float[np.ndarray, "2"], beside_mm: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return the half-widths of the bands for a spread and for standard deviations beside it, mm."""
        seconds, travel_mm = np.array([self._periods * DECISION_PERIOD_S]), np.array([self._travel_mm])
        half = self._calibration.half_width(seconds, travel_mm, spread[None])[0]
        return np.hypot(half, ndtri(0.5 + 0.5 * self._calibration.level) * beside_mm)

    def wall_mm(self, radius_mm: float) -> float:
        """Return by how much the lumen's radius may be another, mm, where it is given as this, mm: a tip on the wall is
        then off by as much, and the edges of that band count too."""
        return min(_LUMEN_SHARE * radius_mm, _LUMEN_MM) * self._alone

    @property
    def sd_mm(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of (Δtip, γtip) that no calibration knows, mm."""
        free_mm = SLACK_WIDTHS * self._width_mm if self._width_mm > WIDE_MM else _FREE_MM
        return np.hypot(_HELD_SHARE * max(self.held_mm - free_mm, 0.0), _TIP_MM) * self._alone

    @property
    def reason(self) -> str:
        """Why X-ray is due if it was at the last call of `advise`."""
        if self.innovations.alarm:
            return MISMATCH
        if self._late:
            return "the last exposure is long ago"
        if self._astray:
            return f"Δtip is known to ±{self.half_width[0]:.1f} mm only"
        return "the wall presses hard" if self._presses else "the tip may be reaching the wall"
