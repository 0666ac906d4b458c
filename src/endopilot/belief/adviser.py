"""The adviser: when an X-ray exposure is due, from calibrated bands around what a model predicts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import Calibration, Tips
from endopilot.settings import OpenShare, Positive, settings
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM

_SPACING = 3
"""Periods from one exposure to the next, at least."""
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


def near_exposures(exposed: Bool[np.ndarray, "*n samples"]) -> Bool[np.ndarray, "*n samples"]:
    """Return which samples have an exposure within 0.5 s, a sample, given which were exposed."""
    near = exposed.copy()
    near[..., 1:] |= exposed[..., :-1]
    near[..., :-1] |= exposed[..., 1:]
    return near


def count_events(state: Bool[np.ndarray, "*n samples"], near: Bool[np.ndarray, "*n samples"]) -> tuple[int, int]:
    """Return how many events there are, and how many of them are missed.

    One begins at a sample in the state that follows one which is not; it is missed if no exposure is near. The last
    sample is left out: the exposure that would show it may come after the end.

    Args:
        state: whether the tip is at the wall, or Δtip errs by δ.
        near: which samples have an exposure near, see `near_exposures`.
    """
    begins = state[..., 1:-1] & ~state[..., :-2]
    return int(begins.sum()), int((begins & ~near[..., 1:-1]).sum())


class XrayAdviser:
    """Says when to switch X-ray on, for one navigation or many side by side.

    Between exposures it watches two bands. Where the band of Δtip is as wide as δ, an exposure is due. Of the band of
    γtip it uses the share that the calibration found. This, over the clearance of the lumen there, lies below τ, above
    it, or across it. Below, nothing threatens; above, the tip is known to be at the wall; across, either may be. An
    exposure is due where the band reaches τ, where the predicted tip crosses it, and where the band has left it below;
    as long as the last exposure showed the tip on the other side of τ than it is predicted; and after an interval as
    long as any that was calibrated on. It shows what is within 0.5 s of it, so none follows another sooner than after
    1.5 s.

    A model that has erred is trusted less: an exposure is due as long as the band lies across τ, and where the band of
    Δtip is 0.6 δ wide.

    Attributes:
        half_width: of the whole bands of Δtip and γtip at the last call of `advise`, mm, a row for each navigation.
        wide: whether Δtip's band was too wide then.
        late: whether the last exposure was as long ago then as any interval that was calibrated on.
    """

    def __init__(self, calibration: Calibration, config: AdviserConfig, wire_radius_mm: float) -> None:
        """Take the bands, and what must not be missed.

        Args:
            calibration: of the model whose predictions come.
            config: τ and δ.
            wire_radius_mm: radius of the wire at its tip, mm.
        """
        self._calibration, self._config, self._wire_radius_mm = calibration, config, wire_radius_mm
        self.half_width = np.zeros((0, 2))
        self.wide = self.late = np.zeros(0, dtype=bool)

    def start(self, proximal: Float[np.ndarray, "n 2"], tip: Tips, radius_mm: Float[np.ndarray, "n"]) -> None:
        """Begin at an exposure.

        Args:
            proximal: Δ, mm, and φ, rad, of each navigation.
            tip: where the model has the tip, mm.
            radius_mm: of the lumen there, mm.
        """
        self._proximal, self._travel = proximal, np.zeros(len(proximal))
        self._since = np.zeros(len(proximal), dtype=int)
        self._beyond = [self._is_beyond(tip[:, 1], radius_mm)] * 5
        self._shown = self._beyond[0].copy()
        self._is_shown = np.zeros(len(proximal), dtype=bool)

    def advise(
        self,
        proximal: Float[np.ndarray, "n 2"],
        tip: Tips,
        spread: Tips,
        radius_mm: Float[np.ndarray, "n"],
        play: Tips | None = None,
        *,
        factor: Float[np.ndarray, "2"] | float = 1.0,
        always: bool = False,
        erred: bool = False,
        wall_mm: Float[np.ndarray, "n"] | float = 0.0,
    ) -> Bool[np.ndarray, "n"]:
        """Return for which navigations X-ray is due now, a period after the last call.

        Args:
            proximal: Δ, mm, and φ, rad.
            tip: predicted for now, mm.
            spread: the model's estimate of its own error, mm.
            radius_mm: of the lumen at the predicted Δtip, mm.
            play: standard deviation that the plays of the drives add, which the calibration does not know, mm; none if
                not given.
            factor: by which the bands are wider than they are calibrated.
            always: whether an exposure is due whenever the last is 1.5 s ago.
            erred: whether the model has erred by more than its calibration knows.
            wall_mm: by which the lumen's radius may be another than it is given, mm, which the calibration does not
                know: a tip on the wall is then off by as much, and the edges of that band count too.
        """
        self._since, self._travel = self._since + 1, self._travel + np.abs(proximal[:, 0] - self._proximal[:, 0])
        self._proximal = proximal
        half = factor * self.widths(spread, play)
        used = self._calibration.offset_share * half[:, 1]
        edges = [tip[:, 1] + off for off in (used, 0.0, -used, wall_mm, -wall_mm)]
        half[:, 1] = np.hypot(half[:, 1], wall_mm)
        self.half_width = half
        beyond = [self._is_beyond(edge, radius_mm) for edge in edges]
        crossed = np.any([now & ~before for now, before in zip(beyond, self._beyond, strict=True)], axis=0)
        across = np.any(beyond, axis=0) & ~np.all(beyond, axis=0)
        disagrees = self._is_shown & (beyond[1] != self._shown)
        self.wide = half[:, 0] >= self._config.abscissa_mm * (_ERRED_SHARE if erred else 1.0)
        self.late = self._since * DECISION_PERIOD_S >= self._calibration.longest_s
        due = (crossed | disagrees | self.wide | (across & erred) | self.late | always) & (self._since >= _SPACING)
        self._beyond = [np.where(crossed & ~due, before, now) for now, before in zip(beyond, self._beyond, strict=True)]
        self._since, self._travel = np.where(due, 0, self._since), np.where(due, 0.0, self._travel)
        return due

    def widths(self, spread: Tips, play: Tips | None = None) -> Tips:
        """Return the half-widths of the bands at the last call of `advise`, mm, for a spread; see there."""
        half = self._calibration.half_width(self._since * DECISION_PERIOD_S, self._travel, spread)
        if play is not None and play.any():
            half = np.hypot(half, ndtri(0.5 + 0.5 * self._calibration.level) * play)
        return half

    def exposed(
        self,
        offset_mm: Float[np.ndarray, "shown"],
        radius_mm: Float[np.ndarray, "shown"],
        navigations: Int[np.ndarray, "shown"] | slice = slice(None),
    ) -> None:
        """Take what an exposure shows; the bands begin anew.

        Args:
            offset_mm: γtip, mm, of each navigation with an exposure.
            radius_mm: of the lumen there, mm.
            navigations: which these are; all if not given.
        """
        self._since[navigations], self._travel[navigations] = 0, 0.0
        self._shown[navigations] = self._is_beyond(offset_mm, radius_mm)
        self._is_shown[navigations] = True

    def _is_beyond(self, offset_mm: Float[np.ndarray, "n"], radius_mm: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        return safety_ratio(offset_mm, radius_mm, self._wire_radius_mm) >= self._config.wall_ratio
