"""The digital twin: the rod core itself as a model, with what is uncertain about it found from the given tips.

An ensemble of wires differs in friction, in the stiffness of the tip and in where along the catheter's axis the ostium
lies. All are driven by the known controls; each is weighted by how well it retraces the tips that were seen. A second
ensemble, drawn closer around the best of the first, is weighted likewise; its weighted median is the prediction, its
weighted spread the uncertainty. There is nothing to train.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import qmc

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.models.config import WINDOW, TwinConfig
from endopilot.models.open_loop import Observed, OpenLoop, Prediction, begin_after, given_states
from endopilot.models.tip_tracking import track
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.device import Device
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

LEVELS = 7
"""Tips of different stiffness in an ensemble. A simulation has one rod, so members share the few."""
NARROWEST = 0.15
"""The second ensemble is spread over this share of the first at least; and over two standard deviations of it."""
GOOD = 3.0
"""A good member misses a seen tip by this many of the scales of `TwinConfig` at most."""
_MISSES = 3
"""Times in a row that the foretold tip must have missed the seen one to be doubted."""
Members = Float[np.ndarray, "members episodes 3"]
"""Friction factor, tip stiffness factor and depth of the ostium (mm) of each member, for each episode."""
_BELIEVED = np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class TwinPrediction(Prediction):
    """What the ensemble foretells: the weighted median of its members, and their weighted deviation from it.

    The spread is no smaller than what the median missed each of the last three seen tips by beyond what a good member
    does.

    Attributes:
        parameters: friction factor, tip stiffness factor and depth of the ostium (mm) of the likeliest member.
    """

    parameters: Float[np.ndarray, "episodes 3"]


@dataclass(frozen=True, eq=False)
class TwinPredictor:
    """The rod core as a predictor.

    Attributes:
        device: the wire as it is believed to be.
        simulator: settings of the rod core.
        config: size and spread of the ensemble.
        told: what the given states of the episodes foretell that it has been asked about; all protocols share it.
        led: the controls that lead the tip along the desired one, likewise.
    """

    device: Device
    simulator: SimulatorConfig
    config: TwinConfig
    told: WeakKeyDictionary[Dataset, TwinPrediction] = field(default_factory=WeakKeyDictionary, repr=False)
    led: WeakKeyDictionary[Dataset, OpenLoop] = field(default_factory=WeakKeyDictionary, repr=False)

    def foretell(self, episodes: Dataset, seen: Observed) -> TwinPrediction:
        """Predict the tips of episodes under their controls, from those that were seen.

        Args:
            episodes: their controls, and the tips where `seen`; no other tip is looked at.
            seen: samples at which the tip was measured, for example by X-ray.
        """
        shape = (len(episodes), episodes.valid.shape[1], 2)
        tip, spread, parameters = np.full(shape, np.nan), np.full(shape, np.nan), np.full((len(episodes), 3), np.nan)
        for anatomy, chosen in _by_anatomy(episodes):
            data = episodes.select(chosen)
            members, paths = self._narrowed_ensemble(anatomy, data, seen)
            weight = _weights(paths, _tips(data), seen, self.config)
            tip[chosen], own = _median_and_spread(paths, weight)
            each = np.broadcast_to(seen, data.valid.shape)
            spread[chosen] = np.hypot(own, _unexplained(tip[chosen], _tips(data), each, self.config))
            parameters[chosen] = members[weight.argmax(axis=0), np.arange(len(data))]
        return TwinPrediction(tip, spread, parameters)

    def ensemble(self, episodes: Dataset, seen: Observed) -> Float[np.ndarray, "members episodes samples 2"]:
        """Return the tips, mm, of every wire that is likely after the seen ones; NaN from where a simulation fails.

        `weigh` says what they foretell, and again, without another simulation, when more tips are seen.
        """
        paths = np.full((self.config.members, len(episodes), episodes.valid.shape[1], 2), np.nan)
        for anatomy, chosen in _by_anatomy(episodes):
            paths[:, chosen] = self._narrowed_ensemble(anatomy, episodes.select(chosen), seen)[1]
        return paths

    def _narrowed_ensemble(
        self, anatomy: Anatomy, data: Dataset, seen: Observed
    ) -> tuple[Members, Float[np.ndarray, "members episodes s 2"]]:
        """Return the second ensemble of the episodes of one anatomy, and its tips."""
        members = self._members(np.tile(_BELIEVED, (len(data), 1)), np.tile(self._spread, (len(data), 1)))
        paths = self._simulate(anatomy, data, members, int(np.flatnonzero(seen).max(initial=0)) + 1)
        weight = _weights(paths, _tips(data), seen, self.config)
        members = self._members(*_narrowed(members, weight, self._spread))
        return members, self._simulate(anatomy, data, members, data.valid.shape[1])

    def rollout_forward(self, episodes: Dataset) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        tip = self._told(episodes).tip
        return OpenLoop(
            tip=tip[:, WINDOW:], proximal=_proximal(episodes)[:, WINDOW:], control=_control(episodes)[:, WINDOW:]
        )

    def rollout_inverse(self, episodes: Dataset) -> OpenLoop:
        """P2: predict the controls that make the tip go the true way."""
        found = self.rollout_dual(episodes)
        return OpenLoop(tip=_tips(episodes)[:, WINDOW:], proximal=found.proximal, control=found.control)

    def rollout_dual(self, episodes: Dataset, seen: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that make the tip go the true way, and the tip that they make.

        The likeliest member is driven along the desired tips, one sample at a time: see `tracking.track`.
        """
        if seen is not None:
            return self._lead(episodes, self.foretell(episodes, seen).parameters, begin_after(seen))
        if episodes not in self.led:
            self.led[episodes] = self._lead(episodes, self._told(episodes).parameters, WINDOW)
        return self.led[episodes]

    def _told(self, episodes: Dataset) -> TwinPrediction:
        if episodes not in self.told:
            self.told[episodes] = self.foretell(episodes, given_states(episodes))
        return self.told[episodes]

    def _lead(self, episodes: Dataset, likeliest: Float[np.ndarray, "episodes 3"], begin: int) -> OpenLoop:
        """Drive wires of these parameters along the desired tips from a sample on."""
        desired = _tips(episodes)[:, begin:]
        tip, control = np.empty(desired.shape), np.empty(desired.shape)
        wires = {stiffness: self._wire(stiffness) for stiffness in np.unique(likeliest[:, 1])}
        for anatomy, chosen in _by_anatomy(episodes):
            data, ours = episodes.select(chosen), likeliest[chosen]
            tip[chosen], control[chosen] = track(
                anatomy,
                [wires[stiffness] for stiffness in ours[:, 1]],
                friction=self.device.friction * ours[:, 0],
                start=np.column_stack([data.initial_inserted_length + ours[:, 2], data.initial_rotation]),
                given=data.asked[:, :begin],
                desired=desired[chosen],
                config=self.simulator,
            )
        proximal = _proximal(episodes)[:, begin - 1 : begin] + SAMPLE_PERIOD_S * np.cumsum(control, axis=1)
        return OpenLoop(tip=tip, proximal=proximal, control=control)

    @property
    def _spread(self) -> Float[np.ndarray, "3"]:
        config = self.config
        return np.array([config.friction_spread, config.stiffness_spread, config.ostium_spread_mm])

    def _members(self, center: Float[np.ndarray, "episodes 3"], spread: Float[np.ndarray, "episodes 3"]) -> Members:
        """Return ensembles around some centers, each first: the same Sobol sequence for all."""
        count = self.config.members  # the point after 0 is the middle
        unit = qmc.Sobol(3, scramble=False).random_base2(count.bit_length())[1 : count + 1]
        members = center + (2 * unit[:, None] - 1) * spread
        members = np.clip(members, _BELIEVED - self._spread, _BELIEVED + self._spread)
        level = np.linspace(1 - self.config.stiffness_spread, 1 + self.config.stiffness_spread, LEVELS)
        members[..., 1] = level[np.abs(members[..., 1, None] - level).argmin(axis=-1)]
        return members

    def _wire(self, stiffness: float) -> Device:
        return self.device.with_tip(bend_rad=self.device.tip_bend_rad, stiffness_factor=float(stiffness))

    def _simulate(
        self, anatomy: Anatomy, data: Dataset, members: Members, samples: int
    ) -> Float[np.ndarray, "members episodes s 2"]:
        """Return (Δtip, γtip) of every member over the first samples, mm; NaN from where a simulation fails."""
        paths = np.full((*members.shape[:2], samples, 2), np.nan)
        for stiffness in np.unique(members[..., 1]):
            member, episode = np.nonzero(members[..., 1] == stiffness)
            control = data.asked[episode, :samples]
            least = -(SAMPLE_PERIOD_S * np.cumsum(control[..., 0], axis=1)).min(axis=1).clip(max=0.0)
            start = np.maximum(data.initial_inserted_length[episode] + members[member, episode, 2], least)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a member that fails has no weight
                rollout = simulate(
                    anatomy,
                    self._wire(stiffness),
                    control,
                    initial=np.column_stack([start, data.initial_rotation[episode]]),
                    config=self.simulator,
                    friction=self.device.friction * members[member, episode, 0],
                )
            tip = np.stack([rollout.tip.abscissa, rollout.tip.offset], axis=-1)
            paths[member, episode] = np.where(rollout.valid[..., None], tip, np.nan)
        return paths


def weigh(
    paths: Float[np.ndarray, "members episodes samples 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    seen: Bool[np.ndarray, "episodes samples"],
    config: TwinConfig,
) -> tuple[Float[np.ndarray, "episodes samples 2"], Float[np.ndarray, "episodes samples 2"]]:
    """Return what an ensemble foretells, and its spread, mm, from the tips that were seen of each episode.

    Args:
        paths: of the members, mm, as `TwinPredictor.ensemble` gives them.
        tips: (Δtip, γtip) where `seen`, mm; no other is looked at.
        seen: samples at which the tip was measured.
        config: scales of what a good member misses a seen tip by.
    """
    return _median_and_spread(paths, _weights(paths, tips, seen, config))


def _unexplained(
    middle: Float[np.ndarray, "episodes samples 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    seen: Bool[np.ndarray, "episodes samples"],
    config: TwinConfig,
) -> Float[np.ndarray, "episodes samples 2"]:
    """Return by how much more than a good member it missed the tip each of the last times it was seen, mm.

    Where something else than the ensemble's parameters is off, all members may agree on what is wrong: their spread
    does not tell. A single miss may be one of the measurement.
    """
    off = np.nan_to_num(np.abs(middle - np.where(seen[..., None], tips, middle)))
    beyond = np.maximum(off - GOOD * np.array([config.abscissa_sd_mm, config.offset_sd_mm]), 0.0)
    count = np.cumsum(seen, axis=1)
    order = np.argsort(~seen, axis=1, kind="stable")  # seen samples first
    last = np.maximum(count[..., None] - 1 - np.arange(_MISSES), 0)
    episode = np.arange(len(seen))[:, None, None]
    persistent = beyond[episode, order[episode, last]].min(axis=2)
    return np.where(count[..., None] >= _MISSES, persistent, 0.0)


def _weights(
    paths: Float[np.ndarray, "members episodes s 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    seen: Bool[np.ndarray, "*episodes samples"],
    config: TwinConfig,
) -> Float[np.ndarray, "members episodes"]:
    """Return the members' weights: the product of Cauchy densities of what they miss the seen tips by.

    Heavy tails, because a snap that comes a moment too early is off by a millimetre and says little about friction.
    """
    at = np.flatnonzero(seen.any(axis=tuple(range(seen.ndim - 1))))
    at = at[at < paths.shape[2]]
    off = (paths[:, :, at] - tips[:, at]) / np.array([config.abscissa_sd_mm, config.offset_sd_mm])
    score = np.where(seen[..., at, None], np.nan_to_num(-np.log1p(off**2), nan=-1e3), 0.0).sum(axis=(2, 3))
    weight = np.exp(score - score.max(axis=0))
    return weight / weight.sum(axis=0)


def _narrowed(
    members: Members, weight: Float[np.ndarray, "members episodes"], spread: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "episodes 3"], Float[np.ndarray, "episodes 3"]]:
    """Return center and spread of the second ensemble of each episode."""
    mean = np.einsum("me,mec->ec", weight, members)
    variance = np.einsum("me,mec->ec", weight, (members - mean) ** 2)
    return mean, np.clip(2 * np.sqrt(variance), NARROWEST * spread, spread)


def _median_and_spread(
    paths: Float[np.ndarray, "members episodes s 2"], weight: Float[np.ndarray, "members episodes"]
) -> tuple[Float[np.ndarray, "episodes s 2"], Float[np.ndarray, "episodes s 2"]]:
    """Return the weighted median over the members, and the standard deviation around it, mm; NaN where none is left."""
    share = np.where(np.isfinite(paths), weight[:, :, None, None], 0.0)
    total = share.sum(axis=0)
    order = np.argsort(paths, axis=0)  # NaN last
    reached = np.cumsum(np.take_along_axis(share, order, axis=0), axis=0) >= 0.5 * total
    middle = np.take_along_axis(paths, np.take_along_axis(order, reached.argmax(axis=0)[None], axis=0), axis=0)[0]
    variance = (share * np.nan_to_num(paths - middle) ** 2).sum(axis=0)
    left = total > 0
    spread = np.sqrt(np.divide(variance, total, out=np.full_like(total, np.nan), where=left))
    return np.where(left, middle, np.nan), spread


def _by_anatomy(episodes: Dataset) -> Iterator[tuple[Anatomy, Int[np.ndarray, "chosen"]]]:
    for name in np.unique(episodes.anatomy):
        yield read_anatomy(episodes.anatomy_folder(str(name))), np.flatnonzero(episodes.anatomy == name)


def _tips(episodes: Dataset) -> Float[np.ndarray, "episodes samples 2"]:
    return np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float)


def _proximal(episodes: Dataset) -> Float[np.ndarray, "episodes samples 2"]:
    return np.stack([episodes.inserted_length, episodes.rotation], axis=-1).astype(float)


def _control(episodes: Dataset) -> Float[np.ndarray, "episodes samples 2"]:
    return episodes.control.astype(float)
