"""A search for the parameters of a model by what they cost in each of many episodes, with intervals.

Differential evolution (scipy) finds the parameters that cost least over all episodes; then candidates are drawn where
others might be as good. A candidate is worse than the best if it costs more by t/2 standard errors of the sum over
episodes of the difference, t Student's 97.5 % quantile; all that are not worse make the interval. Near the best the
cost is c + a δ² - 2 b δ, with the sum of b over episodes 0: the rule excludes δ beyond t times the standard error that
the spread of b between episodes gives it (the sandwich estimator). So intervals are of 95 %, and hold where the noise
within an episode is of any kind. A parameter on which the cost does not depend keeps its whole range: the log does not
identify it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import differential_evolution
from scipy.special import stdtrit

Costs = Callable[[Float[np.ndarray, "candidates parameters"]], Float[np.ndarray, "candidates episodes"]]
_WIDER = 0.5
"""What is drawn from reaches beyond the candidates that are not worse by this share of their range."""
_LEAST_SPARE = 0.03
"""And by this share of all that was searched in, at least."""
_LEAST_SHARE = 0.1
"""Share of the candidates that count as good at least where no optimiser looked for the best."""
UNKNOWN_SHARE = 0.6
"""A parameter whose interval takes this share of what it was searched in is not identified."""
LEAST_EPISODES = 5
"""Episodes whose spread tells how sure a parameter is, at least."""


@dataclass(frozen=True)
class Estimate:
    """A parameter, as logs tell it.

    Attributes:
        value: that of the best candidate.
        low: least value that is not worse, at 95 %.
        high: largest.
        searched: least and largest value that was tried.
        unit: of the number.
    """

    value: float
    low: float
    high: float
    searched: tuple[float, float]
    unit: str = ""

    @property
    def identified(self) -> bool:
        """Whether the logs say more of it than what was tried."""
        return self.high - self.low < UNKNOWN_SHARE * (self.searched[1] - self.searched[0])

    def __str__(self) -> str:
        """Return value, interval and unit, or that the logs do not tell it."""
        if not self.identified:
            return "not identifiable from this log"
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}] {self.unit}".rstrip()


@dataclass(frozen=True, eq=False)
class Candidates:
    """Parameters that were tried.

    Attributes:
        names: of the parameters.
        values: of each candidate.
        costs: of each candidate in each episode.
        least: so many count as good at least: where few were tried, none of them is the best that there is.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, "candidates parameters"]
    costs: Float[np.ndarray, "candidates episodes"]
    least: int = 1

    @property
    def best(self) -> int:
        """The candidate that costs least."""
        return int(np.argmin(self.costs.sum(axis=1)))

    @property
    def as_good(self) -> Bool[np.ndarray, "candidates"]:
        """Which are as good as the best, as far as the episodes tell."""
        more = self.costs - self.costs[self.best]
        count = more.shape[1]
        standard_error = np.sqrt(count) * more.std(axis=1, ddof=1)
        first = np.argsort(np.argsort(more.sum(axis=1))) < self.least
        return first | (more.sum(axis=1) <= stdtrit(count - 1, 0.975) / 2 * standard_error)


def search(
    costs: Costs,
    ranges: Mapping[str, tuple[float, float]],
    *,
    generations: int,
    rounds: int,
    draws: int,
    first: int = 0,
    seed: int = 0,
) -> Candidates:
    """Find parameters, and all that are as good.

    Args:
        costs: of candidates in each episode, finite.
        ranges: of each parameter: least and largest value.
        generations: of differential evolution, of about eight candidates a parameter.
        rounds: in which candidates are drawn around those that are not worse.
        draws: number of them in each round.
        first: number that is drawn from everywhere in place of differential evolution, where each takes long.
        seed: of all.
    """
    low, high = np.array(list(ranges.values()), dtype=float).T
    tried: list[np.ndarray] = []
    cost: list[np.ndarray] = []

    def total(columns: Float[np.ndarray, "parameters candidates"]) -> Float[np.ndarray, "candidates"]:
        tried.append(columns.T.copy())
        cost.append(costs(tried[-1]))
        return cost[-1].sum(axis=1)

    def draw(number: int, bottom: np.ndarray, top: np.ndarray, seed: int) -> None:
        total((bottom + _halton(len(low), number, seed) * (top - bottom)).T)

    if first:
        draw(first, low, high, seed)
    else:
        _evolve(total, list(zip(low, high, strict=True)), generations, seed)
    for number in range(rounds):
        found = _all(tuple(ranges), tried, cost, first)
        as_good = found.values[found.as_good]
        spare = np.maximum(_WIDER * np.ptp(as_good, axis=0), _LEAST_SPARE * (high - low))
        bottom, top = np.clip([as_good.min(axis=0) - spare, as_good.max(axis=0) + spare], low, high)
        draw(draws, bottom, top, seed + number + 1)
    return _all(tuple(ranges), tried, cost, first)


def _all(names: tuple[str, ...], tried: list[np.ndarray], cost: list[np.ndarray], first: int) -> Candidates:
    values = np.concatenate(tried)
    least = max(2 * len(names) + 2, round(_LEAST_SHARE * len(values))) if first else 1
    return Candidates(names, values, np.concatenate(cost), least)


def _halton(size: int, number: int, seed: int) -> Float[np.ndarray, "number size"]:
    """Return points that fill the unit cube evenly."""
    from scipy.stats import qmc  # slow to import

    return qmc.Halton(size, seed=seed).random(number)  # pyright: ignore[reportCallIssue]


def _evolve(total: Callable[[np.ndarray], np.ndarray], ranges: list[tuple[float, float]], most: int, seed: int) -> None:
    """Let differential evolution look for the least total, for a number of generations."""
    differential_evolution(
        total,
        ranges,
        maxiter=most,
        popsize=8,
        init="sobol",
        polish=False,
        vectorized=True,
        updating="deferred",
        tol=0.0,
        seed=seed,  # pyright: ignore[reportCallIssue]  # `rng` from scipy 1.15 on
    )


def estimates(
    found: Candidates,
    ranges: Mapping[str, tuple[float, float]],
    units: Mapping[str, str],
    resolution: Mapping[str, float],
) -> dict[str, Estimate]:
    """Return each parameter with its interval.

    Args:
        found: what was tried.
        ranges: what was searched.
        units: of the parameters.
        resolution: least half-widths of intervals: what the model itself does not resolve, however long the log.
    """
    as_good, best = found.values[found.as_good], found.values[found.best]
    estimated = {}
    for i, name in enumerate(found.names):
        spare, value = resolution.get(name, 0.0), float(best[i])
        low, high = min(float(as_good[:, i].min()), value - spare), max(float(as_good[:, i].max()), value + spare)
        least, largest = ranges[name]
        estimated[name] = Estimate(value, max(low, least), min(high, largest), ranges[name], units.get(name, ""))
    return estimated
