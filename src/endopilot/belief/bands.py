"""Bands around what a model predicts, calibrated to hold over a whole interval without X-ray.

A band is `scale` times a spread. The spread grows from the last exposure with time, travel and the model's own
estimate of its error, and is brought to a size at which either band by itself holds throughout equally many intervals.
The scale is conformal: on calibration patients, each interval scores its worst error in units of the spread, over all
samples and over Δtip and γtip together. docs/evidence/advice.md measures the coverage.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Real, Shaped
from pydantic import Field
from scipy.optimize import nnls

from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.settings import NonNegative, OpenShare, Positive, Seconds, Within, read_settings, settings
from endopilot.tasks.navigation import SUCCESS_MM

CALIBRATION_FILE = "xray.json"
"""Name of a calibration beside the run that it belongs to."""
TERMS = ("constant_mm", "per_s", "per_mm_of_travel", "per_own_spread")
"""What a spread is the sum of."""
_Terms = Annotated[tuple[NonNegative, ...], Field(min_length=len(TERMS), max_length=len(TERMS))]
Tips = Float[np.ndarray, "*n 2"]
"""(Δtip, γtip), mm, or something of each of them."""


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


class Members(NamedTuple):
    """What each of some simulated wires predicts."""

    weight: Float[np.ndarray, "members"]
    """How likely each is, in the sum 1."""
    apart_mm: Float[np.ndarray, "members"]
    """How far along the vessel its tip is from the predicted one, mm, by way of the fork between the two."""
    offset_mm: Float[np.ndarray, "members"]
    """Its γtip, mm."""
    radius_mm: Float[np.ndarray, "members"]
    """Of the lumen there."""
    pressed: Float[np.ndarray, "members"]
    """With what share of the largest force that is allowed the wall presses on it."""


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
    simulated: Members | None = None
    """What simulated wires predict each; None of a model that predicts this tip alone."""

    @property
    def members(self) -> Members:
        """What each of the simulated wires predicts: this tip, which nothing presses, where there are none."""
        one, none = np.ones(1), np.zeros(1)
        return self.simulated or Members(one, none, self.tip[1:], one * self.radius_mm, none)


@settings
class Calibration:
    """How wide the bands of one model are.

    Attributes:
        level: share of new intervals that the bands are to hold throughout.
        scale: half-width of a band in units of the spread.
        longest_s: how long the intervals without X-ray were that it was calibrated on, s. Nothing is known of longer
            ones, so X-ray is due then.
        onset: how likely an event has to begin unseen for the adviser to ask for X-ray.
        abscissa_terms: of the spread of Δtip, its terms as `TERMS` names them.
        offset_terms: of the spread of γtip.
        anatomies: patients that it was calibrated on.
        intervals: intervals of these.
        dataset: key of the dataset.
    """

    level: OpenShare
    scale: NonNegative
    abscissa_terms: _Terms
    offset_terms: _Terms
    anatomies: Annotated[int, Within(1, 10**9)]
    intervals: Annotated[int, Within(1, 10**9)]
    dataset: str
    onset: OpenShare
    longest_s: Seconds

    def half_width(self, seconds: Float[np.ndarray, "*n"], travel_mm: Float[np.ndarray, "*n"], spread: Tips) -> Tips:
        """Return the half-widths of the bands, mm.

        Args:
            seconds: since the last exposure, s.
            travel_mm: translation of the wire since then, there and back, mm.
            spread: the model's estimate of its own error, mm; 0 where it makes none.
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
        return read_settings(path, Calibration, remedy="run `endopilot advise` again")


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
        spread: the model's estimate of its own error, mm.
    """
    found = [
        nnls(_features(seconds, travel_mm, spread[..., i]).reshape(-1, len(TERMS)), np.abs(error[..., i]).ravel())[0]
        for i in range(2)
    ]
    return tuple(found[0].tolist()), tuple(found[1].tolist())


def narrowest(
    terms: tuple[tuple[float, ...], tuple[float, ...]], worst: Float[np.ndarray, "intervals 2"], level: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return terms under which the bands are narrowest that both hold throughout a share of the intervals.

    The scale is common to both bands, so each spread is first multiplied by a number of its own. Of all pairs of
    numbers with which both bands hold in that share of the intervals, the one with the smallest product is taken: the
    prediction region of the least area. Large errors that few intervals have, such as those of a tip in the wrong
    branch, are left out where they would widen a band the most.

    Args:
        worst: of each interval, the largest error over the spread of these terms, of Δtip and of γtip.
        level: share of the intervals that both hold throughout, under a scale of 1.
    """
    needed = int(np.ceil(level * len(worst) - 1e-9))
    ordered = np.maximum(worst[np.argsort(worst[:, 0])], 1e-9)
    widths = [
        (ordered[count - 1, 0], np.partition(ordered[:count, 1], needed - 1)[needed - 1])
        for count in range(needed, len(ordered) + 1)
    ]
    width = min(widths, key=lambda pair: pair[0] * pair[1])
    found = np.array(width)[:, None] * np.array(terms)
    return tuple(found[0].tolist()), tuple(found[1].tolist())


def _features(
    seconds: Float[np.ndarray, "*n"], travel_mm: Float[np.ndarray, "*n"], spread: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 4"]:
    return np.stack([np.ones_like(spread), seconds, travel_mm, spread], axis=-1)


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


def surely_missed(missed: Real[np.ndarray, "patients"], events: Real[np.ndarray, "patients"]) -> float:
    """Return the share of its events that an adviser misses, as large as a few patients leave possible.

    It is the share of all their events plus its standard error. Events of one patient are alike, so patients count, not
    events: the share is a ratio of two sums over patients, with the error that such a ratio has (W. G. Cochran,
    *Sampling techniques*, 1977, section 6.3).

    Returns:
        The share; 0 without events, and more than 1 where the patients say next to nothing.
    """
    count, total = len(events), float(np.sum(events))
    if total == 0:
        return 0.0
    share = float(np.sum(missed)) / total
    if count < 2:
        return 1.0 + share
    variance = float(np.sum((missed - share * events) ** 2)) * count / (count - 1)
    return share + float(np.sqrt(variance)) / total
