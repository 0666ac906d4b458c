"""A search for the parameters of a model by what they cost in each of many episodes, with intervals.

Candidates are drawn from everywhere, then where others might be as good. A candidate is worse than the best if it costs
more by t/2 standard errors of the sum over episodes of the difference, t Student's 97.5 % quantile; all that are not
worse make the interval. Near the best the cost is c + a δ² - 2 b δ, with the sum of b over episodes 0: the rule
excludes δ beyond t times the standard error that the spread of b between episodes gives it (the sandwich estimator). So
intervals are of 95 %, and hold where the noise within an episode is of any kind. A parameter on which the cost does not
depend keeps its whole range: the log does not identify it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtrit

Costs = Callable[[Float[np.ndarray, "candidates parameters"]], Float[np.ndarray, "candidates episodes"]]
_WIDER = 0.5
"""What is drawn from reaches beyond the candidates that are not worse by this share of their range."""
_LEAST_SPARE = 0.03
"""And by this share of all that was searched in, at least."""
_LEAST_SHARE = 0.1
"""Share of the candidates that count as good at least: none of them is the best that there is."""
UNKNOWN_SHARE = 0.6
"""A parameter whose interval takes this share of what it was searched in is not identified."""
LEAST_EPISODES = 5
"""Episodes whose spread tells how sure a parameter is, at least."""


@dataclass(frozen=True)
class Estimate:
    """A parameter, as logs tell it: the value of the best candidate, the least and largest that are not worse, at 95 %,
    and those that were tried."""

    value: float
    low: float
    high: float
    searched: tuple[float, float]
    unit: str = ""

    @property
    def identified(self) -> bool:
        """Whether the logs say more of it than what was tried: its interval is short, and ends in it, or at 0."""
        least, most = self.searched
        inside = self.high < most and (self.low > least or least == 0)
        return inside and self.high - self.low < UNKNOWN_SHARE * (most - least)

    def __str__(self) -> str:
        """Return value, interval and unit, or that the logs do not tell it."""
        if not self.identified:
            return "not identifiable from this log"
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}] {self.unit}".rstrip()


@dataclass(frozen=True, eq=False)
class Candidates:
    """Parameters that were tried within ranges, and what each candidate costs in each episode. So many as `least` count
    as good: where few were tried, none of them is the best that there is."""

    ranges: Mapping[str, tuple[float, float]]
    values: Float[np.ndarray, "candidates parameters"]
    costs: Float[np.ndarray, "candidates episodes"]
    least: int = 1

    @property
    def best(self) -> int:
        """The candidate that costs least."""
        return int(np.argmin(self.costs.sum(axis=1)))

    @property
    def left_out(self) -> Float[np.ndarray, "episodes"]:
        """What each episode costs by the candidate that costs least in all others."""
        others = self.costs.sum(axis=1, keepdims=True) - self.costs
        return np.take_along_axis(self.costs, np.argmin(others, axis=0)[None], axis=0)[0]

    @property
    def as_good(self) -> Bool[np.ndarray, "candidates"]:
        """Which are as good as the best, as far as the episodes tell."""
        more = self.costs - self.costs[self.best]
        count = more.shape[1]
        standard_error = np.sqrt(count) * more.std(axis=1, ddof=1)
        first = np.argsort(np.argsort(more.sum(axis=1))) < self.least
        return first | (more.sum(axis=1) <= stdtrit(count - 1, 0.975) / 2 * standard_error)

    def estimates(self, units: Mapping[str, str]) -> dict[str, Estimate]:
        """Return each parameter with its interval, and its unit if it has one."""
        columns = zip(self.ranges, self.values[self.best].tolist(), self.values[self.as_good].T, strict=True)
        return {
            name: Estimate(value, float(good.min()), float(good.max()), self.ranges[name], units.get(name, ""))
            for name, value, good in columns
        }


def search(
    costs: Costs, ranges: Mapping[str, tuple[float, float]], *, first: int, rounds: int, draws: int, seed: int = 0
) -> Candidates:
    """Find parameters within ranges by their finite costs, and all that are as good: the `first` candidates are drawn
    from everywhere, and in each of the `rounds` so many as `draws` around those that are not worse."""
    from scipy.stats import qmc  # slow to import

    low, high = np.array(list(ranges.values()), dtype=float).T
    least = max(2 * len(ranges) + 2, round(_LEAST_SHARE * (first + rounds * draws)))
    bottom, top, found = low, high, Candidates(ranges, np.empty((0, len(low))), np.empty((0, 0)))
    for number in range(rounds + 1):
        even = qmc.Halton(len(low), seed=seed + number).random(draws if number else first)  # pyright: ignore[reportCallIssue]
        values = bottom + even * (top - bottom)
        cost = costs(values)
        cost = np.concatenate([found.costs, cost]) if number else cost
        found = Candidates(ranges, np.concatenate([found.values, values]), cost, least)
        as_good = found.values[found.as_good]
        spare = np.maximum(_WIDER * np.ptp(as_good, axis=0), _LEAST_SPARE * (high - low))
        bottom, top = np.clip([as_good.min(axis=0) - spare, as_good.max(axis=0) + spare], low, high)
    return found
