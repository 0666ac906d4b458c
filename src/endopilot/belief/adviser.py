"""The adviser: when an X-ray exposure is due, from calibrated bands around what a model predicts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import Calibration
from endopilot.settings import OpenShare, Positive, settings
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM

_SPACING, _ALWAYS = 2, 3
"""Periods from one exposure to the next, at least: one shows what began within a period before it. And where a model is
taken to be wrong, and each image is to test it."""
_ERRED_SHARE = 0.6
"""Share of δ at which Δtip's band asks for X-ray once the model has erred, found on patients to improve agents on."""


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


class XrayAdviser:
    """Says when to switch X-ray on in a navigation.

    Between exposures it watches two bands. Where the band of Δtip is as wide as δ, an exposure is due. Of the band of
    γtip it uses the share that the calibration found. This, over the clearance of the lumen there, lies below τ, above
    it, or across it. Below, nothing threatens; above, the tip is known to be at the wall; across, either may be. An
    exposure is due where the band reaches τ, where the predicted tip crosses it, and where the band has left it below;
    as long as the last exposure showed the tip on the other side of τ than it is predicted; and after an interval as
    long as any that was calibrated on. It shows what began within the last 0.5 s, so none follows another sooner than
    after 1 s.

    A model that has erred is trusted less: an exposure is due as long as the band lies across τ, and where the band of
    Δtip is 0.6 δ wide.

    Attributes:
        half_width: of the whole bands of Δtip and γtip at the last call of `advise`, mm.
        wide: whether Δtip's band was too wide then.
        late: whether the last exposure was as long ago then as any interval that was calibrated on.
    """

    def __init__(self, calibration: Calibration, config: AdviserConfig, wire_radius_mm: float, at: Predicted) -> None:
        """Begin at an exposure.

        Args:
            config: τ and δ.
        """
        self._calibration, self._config, self._wire_radius_mm = calibration, config, wire_radius_mm
        self._inserted_mm, self._travel_mm, self._periods = float(at.proximal[0]), 0.0, 0
        self._beyond = self._is_beyond(np.full(5, at.tip[1]), at.radius_mm)
        self._shown: bool | None = None
        self.half_width, self.wide, self.late = self.widths(at.spread), False, False

    def advise(
        self,
        at: Predicted,
        beside_mm: Float[np.ndarray, "2"] | None = None,
        *,
        factor: Float[np.ndarray, "2"] | float = 1.0,
        always: bool = False,
        erred: bool = False,
        wall_mm: float = 0.0,
        presses: bool = False,
    ) -> bool:
        """Return whether X-ray is due now, a period after the last call.

        Args:
            beside_mm: standard deviations of Δtip and γtip by what the calibration does not know, such as the play of a
                drive, mm; none if not given.
            factor: by which the bands are wider than they are calibrated.
            always: whether an exposure is due whenever the last is 1.5 s ago.
            erred: whether the model has erred by more than its calibration knows.
            wall_mm: by which the lumen's radius may be another than it is given, mm, which the calibration does not
                know: a tip on the wall is then off by as much, and the edges of that band count too.
            presses: whether the wall begins to press with more than it may.
        """
        inserted_mm, offset_mm = float(at.proximal[0]), float(at.tip[1])
        self._periods, self._travel_mm = self._periods + 1, self._travel_mm + abs(inserted_mm - self._inserted_mm)
        self._inserted_mm = inserted_mm
        half = factor * self.widths(at.spread, beside_mm)
        used = self._calibration.offset_share * half[1]
        beyond = self._is_beyond(offset_mm + np.array([used, 0.0, -used, wall_mm, -wall_mm]), at.radius_mm)
        self.half_width = np.array([half[0], np.hypot(half[1], wall_mm)])
        crossed = bool((beyond & ~self._beyond).any())
        across = bool(beyond.any() and not beyond.all())
        disagrees = self._shown is not None and bool(beyond[1]) != self._shown
        self.wide = bool(half[0] >= self._config.abscissa_mm * (_ERRED_SHARE if erred else 1.0))
        self.late = self._periods * DECISION_PERIOD_S >= self._calibration.longest_s
        due = crossed or disagrees or self.wide or (across and erred) or self.late or presses
        due = (due and self._periods >= _SPACING) or (always and self._periods >= _ALWAYS)
        if due or not crossed:
            self._beyond = beyond
        if due:
            self._periods, self._travel_mm = 0, 0.0
        return due

    def widths(
        self, spread: Float[np.ndarray, "2"], beside_mm: Float[np.ndarray, "2"] | None = None
    ) -> Float[np.ndarray, "2"]:
        """Return the half-widths of the bands at the last call of `advise`, mm, for a spread; see there."""
        seconds, travel_mm = np.array([self._periods * DECISION_PERIOD_S]), np.array([self._travel_mm])
        half = self._calibration.half_width(seconds, travel_mm, spread[None])[0]
        if beside_mm is not None and beside_mm.any():
            half = np.hypot(half, ndtri(0.5 + 0.5 * self._calibration.level) * beside_mm)
        return half

    def exposed(self, offset_mm: float, radius_mm: float) -> None:
        """Take what an exposure shows: γtip and the lumen's radius there, mm. The bands begin anew."""
        self._periods, self._travel_mm = 0, 0.0
        self._shown = bool(self._is_beyond(np.array([offset_mm]), radius_mm)[0])

    def _is_beyond(self, offset_mm: Float[np.ndarray, "n"], radius_mm: float) -> Bool[np.ndarray, "n"]:
        ratio = safety_ratio(offset_mm, np.full(len(offset_mm), radius_mm), self._wire_radius_mm)
        return ratio >= self._config.wall_ratio
