"""What reality may be other than it is given: `HYPOTHESES`, and which of them explains what X-ray showed: `Family`.

Members of an ensemble differ in the parameters of all hypotheses at once. A regression over them says how what X-ray
shows depends on each parameter, and how badly a line describes that: snaps count little. Each hypothesis, each two of
them, and that all is as given, is then a linear model of the innovations with a Gaussian prior of its own. What no
hypothesis frees is as sure as it usually is. "None of these" takes innovations to be larger, and explains nothing; it
wins, too, where all hypotheses together leave more of the innovations than of nearly all members', had these been seen.
An innovation has a Cauchy density, with heavy tails: a tip that snapped a moment too early says little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from endopilot.simulation.motion import AMPLITUDES, Motion
from endopilot.simulation.world import World

COMPLIANT_N_MM2 = 0.01
"""Stiffness of a wall of compliance 1: that of an artery in the heart's muscle, docs/concepts/wall.md."""
_RIGID = 0.03
"""A wall of less compliance is rigid: it yields by less than a rigid one's own contacts."""


class Parameter(NamedTuple):
    """What a hypothesis leaves open, in units in which it has a normal distribution before anything was seen."""

    name: str
    """Of a field of `World`, or of a motion."""
    usual: float
    """Standard deviation where the hypothesis is not made: of what is known well; of a factor's logarithm."""
    other: float
    """The same where it is: an assumption."""
    low: float
    high: float
    """Least and largest value."""
    words: str
    """What is stated of an interval."""
    factor: bool = True
    """Whether it is a factor on what is given; else 0 is as given."""


class Hypothesis(NamedTuple):
    """One thing that may be other than given."""

    name: str
    """In words."""
    parameters: tuple[Parameter, ...]
    """That it leaves open."""
    of_kind: bool = True
    """Whether worlds that differ in it are of other wires or vessels; others are simulated side by side."""
    costly: bool = False
    """Whether each value needs a simulator of its own, so that few are tried."""


def _beside(field: str, words: str, usual: float, other: float, most: float) -> tuple[Parameter, ...]:
    """Return the components of a field of a world by which X-ray shows the wire beside where it lies."""
    axes = ((f"{field} {side}", f"{words} {{:.1f}} to {{:.1f}} towards {side}") for side in _SIDES)
    return tuple(Parameter(name, usual, other, -most, most, what, False) for name, what in axes)


_SIDES = ("left", "back", "head")  # of LPS


def _made(world: World, values: Mapping[str, float]) -> World:
    """Return a world in which parameters have these values; a heart beats otherwise only if it is known to beat."""
    changed: dict[str, Any] = {name: each for name, each in values.items() if name in World.__dataclass_fields__}
    for field in ("registration_mm", "drift_mm_min"):
        if f"{field} {_SIDES[0]}" in values:
            changed[field] = tuple(values[f"{field} {side}"] for side in _SIDES)
    if "compliance" in values:  # 0 is rigid
        compliance = values["compliance"]
        changed["compliant_wall_n_mm2"] = None if compliance < _RIGID else COMPLIANT_N_MM2 / compliance
    if (known := world.motion) is not None and "heart_volume_factor" in values:
        share = min(known.heart_volume_share * values["heart_volume_factor"], 0.3)
        annulus_mm = known.annulus_mm * values["annulus_factor"]
        changed["motion"] = replace(known, annulus_mm=annulus_mm, heart_volume_share=share)
    return replace(world, **changed)


def _of_patients(amplitude: str, name: str) -> Parameter:
    mean, sd = AMPLITUDES[amplitude][:2]
    return Parameter(name, sd / mean, sd / mean, 0.1, 2.5, name.replace("_", " ") + " {:.2f} to {:.2f}")


LUMEN, HEART = "another lumen", "another heartbeat"
REGISTRATION, DRIFT = "another registration", "a patient who drifts"
HYPOTHESES = (
    Hypothesis(
        "another tip",
        (
            Parameter("tip_bend_factor", 0.05, 0.25, 0.5, 1.8, "tip bend ×{:.2f} to {:.2f}"),
            Parameter("tip_bend_length_factor", 0.05, 0.2, 0.6, 1.6, "bent length ×{:.2f} to {:.2f}"),
        ),
    ),
    Hypothesis(
        "another stiffness",
        (
            Parameter("tip_stiffness_factor", 0.12, 0.4, 0.4, 2.5, "tip stiffness ×{:.2f} to {:.2f}"),
            Parameter("shaft_stiffness_factor", 0.05, 0.4, 0.4, 2.5, "shaft stiffness ×{:.2f} to {:.2f}"),
        ),
    ),
    Hypothesis(LUMEN, (Parameter("lumen_factor", 0.03, 0.1, 0.75, 1.3, "lumen ×{:.2f} to {:.2f}"),), costly=True),
    Hypothesis("a wall that yields", (Parameter("compliance", 0.01, 0.7, 0.0, 1.0, "", False),), costly=True),
    Hypothesis(
        "another friction",
        (Parameter("friction_factor", 0.15, 0.6, 0.3, 3.0, "friction ×{:.2f} to {:.2f}"),),
        of_kind=False,
    ),
    Hypothesis(
        "another ostium",
        (Parameter("ostium_mm", 0.3, 2.0, -6.0, 6.0, "wire {:.1f} to {:.1f} mm deeper than by its encoder", False),),
        of_kind=False,
    ),
    Hypothesis(REGISTRATION, _beside("registration_mm", "registered beside by, mm,", 0.1, 1.0, 5.0), of_kind=False),
    Hypothesis(DRIFT, _beside("drift_mm_min", "drifts by, mm a minute,", 0.05, 1.5, 8.0), of_kind=False),
    Hypothesis(
        HEART,
        (
            _of_patients("annulus_mm", "annulus_factor"),
            _of_patients("heart_volume_share", "heart_volume_factor"),
        ),
        costly=True,
    ),
)
"""What may be other. Usual deviations are those of the ladder's patients (±20 %, 0.3 mm), those of other hypotheses
are assumptions; heartbeats differ as published."""
_PRIOR = 0.3
"""How likely any one hypothesis is before, against that all is as given: an assumption."""
_NONE_SCALE, _NONE_PRIOR = 4.0, 0.05
"""By how much larger innovations are where none of these explains them, and how likely that is before: assumptions."""
_REFUTED, _WRONG = 0.05, 0.1
"""The whole family is refuted where no more than this share of its own members would be explained as badly; a share of
the images, the worst, which may have gone wrong, is left out. Of 34 worlds drawn to improve agents on that refuted 5 of
5 with a motion, and 0 of 19 whose kinds are hypotheses."""
_FAR_MM = 4.0
"""Differences between tips are cut off here, mm: beyond, a wire has snapped, or lies in another branch."""
MEDIAN_SQUARE = 0.455
"""Median of the square of a normal deviate."""
_REFITS = 10
"""Times that weights follow from how well each image is explained."""
_RIDGE = 1e-3
_LEAST_MEMBERS = 8
"""Fewer members whose simulation held tell nothing."""


def log_likelihood(error: Float[np.ndarray, "..."], scale: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return logarithms of the Cauchy density of innovations, up to a constant: the likelihood of all that is seen."""
    return -np.log1p((error / scale) ** 2)


def likelihoods(score: Float[np.ndarray, "members *n"]) -> Float[np.ndarray, "members *n"]:
    """Return how likely members are, in the sum 1, from their logarithmic likelihoods up to a constant."""
    weight = np.exp(score - score.max(axis=0))
    return weight / weight.sum(axis=0)


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is believed after some exposures.

    Attributes:
        mean: of the parameters where all hypotheses are made, in their standard deviations `Parameter.other`.
        sd: standard deviations of these.
        center: the mean of the likeliest explanation.
        factor: its covariance is this times its transpose.
        probability: of each hypothesis.
        none: of none of these; near 1 where a test of misfit refutes the whole family.
    """

    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]
    center: Float[np.ndarray, "p"]
    factor: Float[np.ndarray, "p p"]
    probability: Float[np.ndarray, "hypotheses"]
    none: float


class Family:
    """Some hypotheses, as members of an ensemble have them.

    Attributes:
        parameters: of all, one after the other.
        usual: their standard deviations where nothing is other, as shares of those where it is.
        costly: whether each is costly to try.
    """

    def __init__(self, hypotheses: Sequence[Hypothesis]) -> None:
        self.hypotheses = tuple(hypotheses)
        self.parameters = tuple(each for hypothesis in hypotheses for each in hypothesis.parameters)
        self.usual = np.array([each.usual / each.other for each in self.parameters])
        owner = [k for k, hypothesis in enumerate(hypotheses) for _ in hypothesis.parameters]
        self._owner = np.array(owner)
        self._of_kind = np.array([hypotheses[k].of_kind for k in owner])
        self.costly = np.array([hypotheses[k].costly for k in owner])
        ends = np.array([[self._number(each, end) for end in (each.low, each.high)] for each in self.parameters])
        self._low, self._high = ends.T

    @staticmethod
    def _number(parameter: Parameter, value: float) -> float:
        return (float(np.log(value)) if parameter.factor else value) / parameter.other

    def as_given(self, none: float = 0.0) -> Posterior:
        """Return what is believed before anything was seen."""
        nothing, unlikely = np.zeros(len(self.parameters)), np.zeros(len(self.hypotheses))
        return Posterior(nothing, np.ones(len(nothing)), nothing, np.diag(self.usual), unlikely, none)

    def drawn(
        self,
        center: Float[np.ndarray, "p"],
        factor: Float[np.ndarray, "p p"],
        kinds: int,
        each: int,
        *,
        vessels: int = 4,
        seed: int = 0,
    ) -> Float[np.ndarray, "members p"]:
        """Return members evenly around a center, in a normal distribution: some of each kind, in few simulators.

        Args:
            factor: the covariance is this times its transpose.
            kinds: wires in vessels that differ.
            each: members of a kind, which differ in what needs no other wire or vessel.
            vessels: how many values of what is costly are tried, no more than kinds.
            seed: of the Sobol sequence.
        """
        from scipy.stats import qmc  # slow to import

        size = len(self.parameters)

        def normal(points: int, stream: int) -> Float[np.ndarray, "points p"]:
            made = qmc.Sobol(size, rng=np.random.default_rng([seed, stream])).random_base2((points - 1).bit_length())
            return ndtri(np.clip(made[:points], 1e-3, 1 - 1e-3))

        unit = normal(kinds * each, 0)
        unit[:, self._of_kind] = np.repeat(normal(kinds, 1), each, axis=0)[:, self._of_kind]
        found = center + unit @ factor.T
        kind = np.arange(kinds * each) // each
        found[:, self._of_kind] = found[kind * each][:, self._of_kind]
        found[:, self.costly] = found[kind % vessels * each][:, self.costly]
        return np.clip(found, self._low, self._high)

    def values(self, unit: Float[np.ndarray, "p"]) -> dict[str, float]:
        """Return the values of the parameters, by name."""
        pairs = zip(self.parameters, unit.tolist(), strict=True)
        return {each.name: float(np.exp(each.other * z)) if each.factor else each.other * z for each, z in pairs}

    def world(self, unit: Float[np.ndarray, "p"], motion: Motion | None = None) -> World:
        """Return what reality is with these parameters, in a vessel that is known to move so."""
        return _made(World(motion=motion), self.values(unit))

    @cached_property
    def _sets(self) -> list[tuple[int, ...]]:
        """What may be other: nothing, one thing, or two at once."""
        count = range(len(self.hypotheses))
        return [(), *((k,) for k in count), *combinations(count, 2)]

    def update(
        self,
        members: Float[np.ndarray, "members p"],
        simulated: Float[np.ndarray, "members n axes"],
        shown: Float[np.ndarray, "n axes"],
        scale: Float[np.ndarray, "n axes"],
        *,
        noisy: bool = False,
    ) -> Posterior:
        """Return what is believed after some exposures.

        Args:
            members: parameters.
            simulated: what each member shows in them, mm; NaN where its simulation failed.
            shown: what X-ray showed, mm.
            scale: standard deviations of both together, mm.
            noisy: whether exposures may err by more than that, along some axes: by as much as nothing explains.
        """
        size, whole = len(self.parameters), np.isfinite(simulated).all(axis=(1, 2))
        if whole.sum() < _LEAST_MEMBERS or not len(shown):
            return self.as_given(float(not whole.any()))
        unit, y = members[whole], simulated[whole].reshape(whole.sum(), -1)
        center = np.median(y, axis=0)
        y, away = np.clip(y - center, -_FAR_MM, _FAR_MM), np.clip(shown.ravel() - center, -_FAR_MM, _FAR_MM)
        lines = np.column_stack([np.ones(len(unit)), unit])
        slope = np.linalg.solve(lines.T @ lines + _RIDGE * np.eye(size + 1), lines.T @ y)
        left = ((y - lines @ slope) ** 2).mean(axis=0)
        variance, away, y, slope = scale.ravel() ** 2 + left, away - slope[0], y - slope[0], slope[1:]
        as_badly = 1.0 if noisy else self._as_badly(slope, away, y, variance, scale)
        if noisy:
            for _ in range(_REFITS):
                misfit = (away - self._fit(slope, away, variance, np.ones(size))[0] @ slope) ** 2
                noise = np.median(misfit.reshape(shown.shape), axis=0) / MEDIAN_SQUARE
                variance = scale.ravel() ** 2 + left + np.tile(noise, len(shown))
        fits = []
        for chosen in self._sets:
            sd = np.where(np.isin(self._owner, chosen), 1.0, self.usual)
            found, precision = self._fit(slope, away, variance, sd)
            seen = log_likelihood(away - found @ slope, np.sqrt(variance)).sum()
            occam = 0.5 * (np.linalg.slogdet(precision)[1] + 2 * np.log(sd).sum() + ((found / sd) ** 2).sum())
            fits.append((seen - occam + len(chosen) * np.log(_PRIOR), found, np.linalg.inv(precision)))
        none = (log_likelihood(away, _NONE_SCALE * np.sqrt(variance)) - np.log(_NONE_SCALE)).sum() + np.log(_NONE_PRIOR)
        share = likelihoods(np.array([*(fit[0] for fit in fits), none]))
        weight = share[:-1] / max(share[:-1].sum(), 1e-9)
        mean, precision = self._fit(slope, away, variance, np.ones(size))
        sd = np.sqrt(np.diag(np.linalg.inv(precision)))
        _, best, covariance = fits[int(np.argmax(weight))]
        within = range(len(self.hypotheses))
        probability = np.array([weight[[k in some for some in self._sets]].sum() for k in within])
        none = float(share[-1]) if as_badly > _REFUTED else 1.0 - as_badly
        return Posterior(mean, sd, best, np.linalg.cholesky(covariance), probability, none)

    def _as_badly(
        self,
        slope: Float[np.ndarray, "p n"],
        away: Float[np.ndarray, "n"],
        members: Float[np.ndarray, "members n"],
        variance: Float[np.ndarray, "n"],
        scale: Float[np.ndarray, "images axes"],
    ) -> float:
        """Return the share of members that all hypotheses together would explain as badly as what was seen, summed over
        all images, had these been seen in its place, with errors of the same size."""
        noise = scale.ravel() * np.random.default_rng(0).standard_normal(members.shape)

        def explained(seen: Float[np.ndarray, "n"]) -> float:
            found, _ = self._fit(slope, seen, variance, np.ones(len(slope)))
            each = log_likelihood(seen - found @ slope, np.sqrt(variance)).reshape(scale.shape).sum(axis=1)
            return float(np.sort(each)[int(np.ceil(_WRONG * len(each))) :].sum())

        least = explained(away)
        return float(np.mean([explained(each) <= least for each in members + noise]))

    @staticmethod
    def _fit(
        slope: Float[np.ndarray, "p n"], away: Float[np.ndarray, "n"], variance: np.ndarray, sd: Float[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p p"]]:
        """Return the likeliest parameters of a linear model with a normal prior, and their precision there."""
        found, precision = np.zeros(len(sd)), np.diag(sd**-2.0)
        for _ in range(_REFITS):
            weight = 2 / (variance + (away - found @ slope) ** 2)
            precision = (slope * weight) @ slope.T + np.diag(sd**-2.0)
            found = np.linalg.solve(precision, (slope * weight) @ away)
        return found, precision

    def interval(self, found: Posterior, name: str, deviations: float) -> tuple[float, float]:
        """Return the interval of a parameter within so many standard deviations of its mean, and its range."""
        k = [each.name for each in self.parameters].index(name)
        ends = np.clip(found.mean[k] + np.array([-deviations, deviations]) * found.sd[k], self._low[k], self._high[k])
        of, scale = self.parameters[k], self.parameters[k].other
        low, high = (np.exp(scale * ends) if of.factor else scale * ends).tolist()
        return low, high
