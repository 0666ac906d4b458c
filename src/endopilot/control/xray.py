"""When X-ray is needed: bands around what a model foretells, and the adviser that asks for an exposure.

A band is `scale` times a spread, and the spread of a model grows from the last exposure with time and travel, and with
what the model says of itself. The scale is conformal: on patients of their own, of each interval without X-ray the
worst error in units of the spread is taken, over all its samples and over Δtip and γtip alike; a band that is as wide
as nearly the worst of these holds over a whole interval at once, on a new patient too. docs/xray.md measures it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.optimize import nnls

from endopilot.control.policy import DECISION_PERIOD_S
from endopilot.env.task import SUCCESS_MM
from endopilot.errors import InputError
from endopilot.files import read_json, write_json

CALIBRATION_FILE = "xray.json"
"""Name of a calibration beside the run that it belongs to."""
_SPACING = 3
"""Periods from one exposure to the next, at least."""
TERMS = ("constant_mm", "per_s", "per_mm_of_travel", "per_own_spread")
"""What a spread is the sum of."""
Tips = Float[np.ndarray, "*n 2"]
"""(Δtip, γtip), mm, or something of each of them."""


@dataclass(frozen=True, kw_only=True)
class AdvisorConfig:
    """What X-ray must not miss, and how sure the bands are to be."""

    level: float = 0.9
    """Share of the intervals without X-ray in which the bands shall hold throughout."""
    wall_ratio: float = 0.7
    """τ: an event begins where γtip/(lumen radius − wire radius) reaches it; 1 is the wall."""
    abscissa_mm: float = SUCCESS_MM
    """δ: an event begins where Δtip is off by this much, mm; as near as a target counts as reached if not given."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        if not 0 < self.level < 1:
            raise InputError(f"level: {self.level} is not in (0, 1); give e.g. 0.9")
        for name in ("wall_ratio", "abscissa_mm"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name}: {getattr(self, name)}; give a positive number")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """How wide the bands of one model are.

    Attributes:
        level: share of new intervals that the bands are to hold throughout.
        scale: half-width of a band in units of the spread.
        abscissa_terms: of the spread of Δtip, its terms as `TERMS` names them.
        offset_terms: of the spread of γtip.
        anatomies: patients that it was calibrated on.
        intervals: intervals of these.
        dataset: key of the dataset.
    """

    level: float
    scale: float
    abscissa_terms: tuple[float, ...]
    offset_terms: tuple[float, ...]
    anatomies: int
    intervals: int
    dataset: str

    def half_width(self, seconds: Float[np.ndarray, "*n"], travel_mm: Float[np.ndarray, "*n"], spread: Tips) -> Tips:
        """Return the half-widths of the bands, mm.

        Args:
            seconds: since the last exposure, s.
            travel_mm: translation of the wire since then, there and back, mm.
            spread: what the model says of itself, mm; 0 where it says nothing.
        """
        return self.scale * spread_of((self.abscissa_terms, self.offset_terms), seconds, travel_mm, spread)

    def write(self, run: Path) -> None:
        """Write it beside a run, whole or not at all."""
        write_json(Path(run) / CALIBRATION_FILE, asdict(self))

    @staticmethod
    def read(run: Path) -> Calibration:
        """Read the calibration of a run.

        Raises:
            InputError: the run has none, or its file is damaged.
        """
        path = Path(run) / CALIBRATION_FILE
        if not path.exists():
            raise InputError(
                f"{run}: the model has no calibration ({CALIBRATION_FILE} is missing); make it with `endopilot advise`"
            )
        try:
            content: dict[str, Any] = read_json(path)
            for name in ("abscissa_terms", "offset_terms"):
                content[name] = tuple(content[name])
            return Calibration(**content)
        except (TypeError, KeyError) as error:
            raise InputError(
                f"{path}: no calibration of this version ({error}); run `endopilot advise` again"
            ) from None


def spread_of(
    terms: tuple[tuple[float, ...], tuple[float, ...]],
    seconds: Float[np.ndarray, "*n"],
    travel_mm: Float[np.ndarray, "*n"],
    spread: Tips,
) -> Tips:
    """Return the spread of Δtip and γtip, mm, of given terms; the arguments are those of `Calibration.half_width`."""
    parts = [_features(seconds, travel_mm, spread[..., i]) @ np.array(terms[i]) for i in range(2)]
    return np.maximum(np.stack(parts, axis=-1), 1e-6)


def fit_spread(
    error: Tips, seconds: Float[np.ndarray, "*n"], travel_mm: Float[np.ndarray, "*n"], spread: Tips
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the terms, none negative, with which the spread is nearest to the size of the errors, by least squares.

    Args:
        error: of Δtip and γtip, mm, on patients that serve neither for calibration nor for the test.
        seconds: since the last exposure, s.
        travel_mm: since then, mm.
        spread: what the model says of itself, mm.
    """
    found = [
        nnls(_features(seconds, travel_mm, spread[..., i]).reshape(-1, len(TERMS)), np.abs(error[..., i]).ravel())[0]
        for i in range(2)
    ]
    return tuple(found[0].tolist()), tuple(found[1].tolist())


def _features(
    seconds: Float[np.ndarray, "*n"], travel_mm: Float[np.ndarray, "*n"], spread: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 4"]:
    return np.stack([np.ones_like(spread), seconds, travel_mm, spread], axis=-1)


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
        state: whether the tip is at the wall, or Δtip is off by δ.
        near: which samples have an exposure near, see `near_exposures`.
    """
    begins = state[..., 1:-1] & ~state[..., :-2]
    return int(begins.sum()), int((begins & ~near[..., 1:-1]).sum())


def check_enough(patients: int, level: float) -> None:
    """Check that there are enough patients to calibrate on: with n of them no band is surer than n/(n + 1).

    Raises:
        InputError: there are too few for that level.
    """
    needed = int(np.ceil(level / (1 - level) - 1e-9))
    if patients < needed:
        raise InputError(
            f"level: {level:g} needs at least {needed} patients to calibrate on, and the split 'calibrate' has "
            f"{patients}; make the dataset with more, or with larger --anatomy-shares"
        )


def conformal_scale(
    score: Float[np.ndarray, "intervals"], anatomy: Shaped[np.ndarray, "intervals"], level: float
) -> float:
    """Return the scale under which bands hold over `level` of the intervals of a new patient.

    Intervals of one patient are alike, so patients count, not intervals. A quantile of all scores serves; which one, is
    found by leaving each patient out: the smallest whose value on the others covers `level` of the left-out ones.

    Args:
        score: of each interval, the worst error over the spread.
        anatomy: whose each is.
        level: share to be covered.

    Raises:
        InputError: there are too few patients for that level.
    """
    names = np.unique(anatomy)
    check_enough(len(names), level)
    shares = np.linspace(0.0, 1.0, 501)
    covered = np.zeros(len(shares))
    for name in names:
        bounds = np.quantile(score[anatomy != name], shares, method="higher")
        covered += (score[anatomy == name] <= bounds[:, None]).mean(axis=1) / len(names)
    enough = np.append(shares[covered >= level - 1e-9], 1.0)[0]
    return float(np.quantile(score, enough, method="higher"))


class XrayAdvisor:
    """Says when to switch X-ray on, for one navigation or many side by side.

    Between exposures it watches two bands. Where that of Δtip is as wide as δ, an exposure is due. That of γtip, over
    the clearance of the lumen there, lies below τ, above it, or across it. Below, nothing threatens; above, the tip is
    known to be at the wall; across, either may be. An exposure is due where the band reaches τ, where the foretold tip
    crosses it, and where the band has left it below. It shows what is within 0.5 s of it, so none follows another
    sooner than after 1.5 s.

    Attributes:
        half_width: of the bands of Δtip and γtip at the last call of `advise`, mm, a row for each navigation.
    """

    def __init__(self, calibration: Calibration, config: AdvisorConfig, wire_radius_mm: float) -> None:
        """Take the bands, and what must not be missed.

        Args:
            calibration: of the model whose predictions come.
            config: τ and δ.
            wire_radius_mm: radius of the wire at its tip, mm.
        """
        self._calibration, self._config, self._wire_radius_mm = calibration, config, wire_radius_mm
        self.half_width = np.zeros((0, 2))

    def start(self, proximal: Float[np.ndarray, "n 2"], tip: Tips, radius_mm: Float[np.ndarray, "n"]) -> None:
        """Begin at an exposure.

        Args:
            proximal: Δ, mm, and φ, rad, of each navigation.
            tip: where the model holds the tip to be, mm.
            radius_mm: of the lumen there, mm.
        """
        self._proximal, self._travel = proximal, np.zeros(len(proximal))
        self._since = np.zeros(len(proximal), dtype=int)
        self._beyond = [self._ratio(tip[:, 1], radius_mm) >= self._config.wall_ratio] * 3

    def advise(
        self, proximal: Float[np.ndarray, "n 2"], tip: Tips, spread: Tips, radius_mm: Float[np.ndarray, "n"]
    ) -> Bool[np.ndarray, "n"]:
        """Return for which navigations X-ray is due now, a period after the last call.

        Args:
            proximal: Δ, mm, and φ, rad.
            tip: what the model foretells for now, mm.
            spread: what it says of itself, mm.
            radius_mm: of the lumen at the foretold Δtip, mm.
        """
        self._since, self._travel = self._since + 1, self._travel + np.abs(proximal[:, 0] - self._proximal[:, 0])
        self._proximal = proximal
        self.half_width = half = self._calibration.half_width(self._since * DECISION_PERIOD_S, self._travel, spread)
        edges = [tip[:, 1] + side * half[:, 1] for side in (1.0, 0.0, -1.0)]
        beyond = [self._ratio(edge, radius_mm) >= self._config.wall_ratio for edge in edges]
        crossed = np.any([now & ~before for now, before in zip(beyond, self._beyond, strict=True)], axis=0)
        due = (crossed | (half[:, 0] >= self._config.abscissa_mm)) & (self._since >= _SPACING)
        self._beyond = [np.where(crossed & ~due, before, now) for now, before in zip(beyond, self._beyond, strict=True)]
        self._since, self._travel = np.where(due, 0, self._since), np.where(due, 0.0, self._travel)
        return due

    def _ratio(self, offset_mm: Float[np.ndarray, "n"], radius_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return offset_mm / np.maximum(radius_mm - self._wire_radius_mm, 1e-3)
