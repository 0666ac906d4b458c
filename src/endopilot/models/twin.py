"""The digital twin: the rod core itself as a model, whose uncertain parameters are identified from the given tips.

An ensemble of wires differs in friction, in the stiffness of the tip and in where along the catheter's axis the ostium
lies. All are driven by the known controls; each is weighted by how well it retraces the observed tips. A second
ensemble, drawn closer around the best of the first, is weighted likewise; its weighted median is the prediction, its
weighted spread the uncertainty. There is nothing to train. In a patient who moves the wires are simulated in a vessel
that moves as far as that is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.models.config import WINDOW, TwinConfig
from endopilot.models.ensemble import NOMINAL, Ensemble, likelihoods, with_stiffnesses
from endopilot.models.episodes import (
    EachObserved,
    Episodes,
    Observed,
    OpenLoop,
    Prediction,
    Steps2,
    begin_after,
    given_states,
    jumps,
)
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

TRANSLATIONS_MM_S = (-5.0, -1.5, 0.0, 1.5, 5.0)
"""Speeds that are tried, beyond the one that would move a tip without slack to where it is desired."""
ROTATIONS_RAD_S = (-2.0, 0.0, 2.0)
"""Rotations that are tried with each."""


def track(
    anatomy: Anatomy,
    wires: Sequence[Wire],
    *,
    friction: Float[np.ndarray, "episodes"],
    start: Float[np.ndarray, "episodes 2"],
    given: Float[np.ndarray, "episodes given 2"],
    desired: Steps2,
    config: SimulatorConfig,
    motion: Motion | None = None,
) -> tuple[Steps2, Steps2]:
    """Drive each episode's wire by its given controls, then sample by sample along the desired tips.

    At every sample each wire tries all combinations of `TRANSLATIONS_MM_S` and `ROTATIONS_RAD_S` from its present state
    and keeps the one whose tip ends nearest to the desired (Δtip, γtip), in the sum of both distances.

    Args:
        wires: the device of each episode; the same object where it is the same.
        friction: Coulomb friction coefficient of each episode.
        start: (Δ mm, φ rad) before the first given control.
        given: controls (mm/s, rad/s) that come first.
        desired: (Δtip, γtip) mm at the end of each sample period after them.

    Returns:
        Tip (Δtip, γtip) mm, and control (mm/s, rad/s) as the drive made it, after the given ones.
    """
    tries = np.array([(v, w) for v in TRANSLATIONS_MM_S for w in ROTATIONS_RAD_S])
    episodes, each = len(wires), len(tries)
    simulator = Simulator(anatomy, [wire for wire in wires for _ in range(each)], config=config, motion=motion)
    inserted, rotation = np.repeat(start, each, axis=0).T
    simulator.reset(inserted_length=inserted.clip(min=0.0), rotation=rotation, friction=np.repeat(friction, each))
    limits = DriveLimits.of(wires[0], anatomy)
    for sample in np.moveaxis(given, 1, 0):
        command = np.repeat(sample, each, axis=0)
        simulator.step(limits.clip(command, simulator.inserted_length[:, 0], SAMPLE_PERIOD_S), SAMPLE_PERIOD_S)
    tip, control = np.empty(desired.shape), np.empty(desired.shape)
    for k in range(desired.shape[1]):
        now = simulator.project().abscissa[:, 0]
        lead = (np.repeat(desired[:, k, 0], each) - now) / SAMPLE_PERIOD_S
        command = np.tile(tries, (episodes, 1))
        command[:, 0] += lead
        command = limits.clip(command, simulator.inserted_length[:, 0], SAMPLE_PERIOD_S)
        step = simulator.step(command, SAMPLE_PERIOD_S)
        reached = simulator.project()[:, 0]
        error = np.abs(reached.abscissa - np.repeat(desired[:, k, 0], each))
        error += np.abs(reached.offset - np.repeat(desired[:, k, 1], each))
        error[~step.valid] = np.inf
        best = error.reshape(episodes, each).argmin(axis=1) + each * np.arange(episodes)
        tip[:, k] = np.stack([reached.abscissa[best], reached.offset[best]], axis=-1)
        slip = np.stack([step.slip, step.rotation_slip], axis=-1)[best, 0]
        control[:, k] = command[best] - slip / SAMPLE_PERIOD_S
        simulator.copy_worlds(np.repeat(best, each))
    return tip, control


LEVELS = 7
"""Tips of different stiffness in an ensemble. A simulation has one rod, so members share the few."""
NARROWEST = 0.15
"""The second ensemble is spread over this share of the first at least; and over two standard deviations of it."""
GOOD = 3.0
"""A good member errs by this many of the scales of `TwinConfig` at most where the tip is observed."""
_PERSISTENT = 3
"""Observations in a row that the predicted tip must have differed from before the spread is widened."""
Members = Float[np.ndarray, "members episodes 3"]
"""Friction factor, tip stiffness factor and depth of the ostium (mm) of each member, for each episode."""


@dataclass(frozen=True, eq=False)
class TwinPrediction(Prediction):
    """The prediction of the ensemble: the weighted median of its members, and their weighted deviation from it.

    The spread is no smaller than the median's error at each of the last three observed tips, less the error of a good
    member.

    Attributes:
        parameters: friction factor, tip stiffness factor and depth of the ostium (mm) of the likeliest member.
    """

    parameters: Float[np.ndarray, "episodes 3"]


@dataclass(frozen=True, eq=False)
class TwinPredictor:
    """The rod core as a predictor.

    Attributes:
        device: the nominal wire.
        predicted: predictions from the given states, by episodes; all protocols share them.
        tracked: controls that lead the tip along the desired one, likewise.
    """

    device: Wire
    simulator: SimulatorConfig
    config: TwinConfig
    predicted: WeakKeyDictionary[Episodes, TwinPrediction] = field(default_factory=WeakKeyDictionary, repr=False)
    tracked: WeakKeyDictionary[Episodes, OpenLoop] = field(default_factory=WeakKeyDictionary, repr=False)

    def predict(self, episodes: Episodes, observed: Observed | EachObserved) -> TwinPrediction:
        """Predict the tips of episodes from their controls and from the observed tips: see `ProbabilisticPredictor`."""
        tip, spread = np.full(episodes.tip.shape, np.nan), np.full(episodes.tip.shape, np.nan)
        parameters, jump = np.full((len(episodes), 3), np.nan), np.zeros(episodes.branch.shape)
        seen = np.broadcast_to(observed, episodes.branch.shape)
        for anatomy, chosen in _by_anatomy(episodes):
            data, each = episodes.select(chosen), seen[chosen]
            members, paths = self._narrowed_ensemble(anatomy, data, each)
            scale = _scales(data.tip_sd, self.config)
            weight = _weights(paths, data.tip.astype(float), each, scale)
            tip[chosen], own = _median_and_spread(paths, weight)
            beyond = _unexplained(tip[chosen], data.tip.astype(float), each, scale)
            spread[chosen] = np.hypot(own, beyond)
            inserted = np.broadcast_to(data.proximal[..., 0], paths.shape[:-1])
            jump[chosen] = np.einsum(
                "me,mes->es", weight, [jumps(*each) for each in zip(paths[..., 0], inserted, strict=True)]
            )
            parameters[chosen] = members[weight.argmax(axis=0), np.arange(len(data))]
        return TwinPrediction(tip, spread, jump, parameters)

    def ensemble(
        self, episodes: Episodes, observed: Observed | EachObserved
    ) -> Float[np.ndarray, "members episodes samples 2"]:
        """Return the tips, mm, of every wire that is likely after the observed ones; NaN from where a simulation fails.

        `weigh` makes a prediction of them, and again, without another simulation, when more tips are observed.
        """
        paths = np.full((self.config.members, *episodes.tip.shape), np.nan)
        for anatomy, chosen in _by_anatomy(episodes):
            seen = np.broadcast_to(observed, episodes.branch.shape)[chosen]
            paths[:, chosen] = self._narrowed_ensemble(anatomy, episodes.select(chosen), seen)[1]
        return paths

    def _narrowed_ensemble(
        self, anatomy: Anatomy, data: Episodes, observed: EachObserved
    ) -> tuple[Members, Float[np.ndarray, "members episodes s 2"]]:
        """Return the second ensemble of the episodes of one anatomy, and its tips."""
        members = self._members(np.tile(NOMINAL, (len(data), 1)), np.tile(self._spread, (len(data), 1)))
        paths = self._simulate(anatomy, data, members, int(np.nonzero(observed)[1].max(initial=0)) + 1)
        weight = _weights(paths, data.tip.astype(float), observed, _scales(data.tip_sd, self.config))
        members = self._members(*_narrowed(members, weight, self._spread))
        return members, self._simulate(anatomy, data, members, data.samples)

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        later = slice(WINDOW, None)
        tip = self._from_given(episodes).tip[:, later]
        return OpenLoop(tip, episodes.proximal[:, later].astype(float), episodes.control[:, later].astype(float))

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        found = self.rollout_dual(episodes)
        return OpenLoop(tip=episodes.tip[:, WINDOW:].astype(float), proximal=found.proximal, control=found.control)

    def rollout_dual(self, episodes: Episodes, observed: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        The likeliest member is driven along the desired tips, one sample at a time: see `track`.
        """
        if observed is not None:
            return self._track(episodes, self.predict(episodes, observed).parameters, begin_after(observed))
        if episodes not in self.tracked:
            self.tracked[episodes] = self._track(episodes, self._from_given(episodes).parameters, WINDOW)
        return self.tracked[episodes]

    def _from_given(self, episodes: Episodes) -> TwinPrediction:
        if episodes not in self.predicted:
            self.predicted[episodes] = self.predict(episodes, given_states(episodes))
        return self.predicted[episodes]

    def _track(self, episodes: Episodes, likeliest: Float[np.ndarray, "episodes 3"], begin: int) -> OpenLoop:
        desired = episodes.tip[:, begin:].astype(float)
        tip, control = np.empty(desired.shape), np.empty(desired.shape)
        wires = with_stiffnesses(self.device, likeliest[:, 1])
        for anatomy, chosen in _by_anatomy(episodes):
            data, ours = episodes.select(chosen), likeliest[chosen]
            tip[chosen], control[chosen] = track(
                anatomy,
                [wires[stiffness] for stiffness in ours[:, 1]],
                friction=self.device.friction * ours[:, 0],
                start=np.column_stack([data.initial[:, 0] + ours[:, 2], data.initial[:, 1]]),
                given=data.command[:, :begin],
                desired=desired[chosen],
                config=self.simulator,
                motion=data.setup.known_motions.get(anatomy.name),
            )
        start = episodes.proximal[:, begin - 1 : begin].astype(float)
        proximal = start + SAMPLE_PERIOD_S * np.cumsum(control, axis=1)
        return OpenLoop(tip=tip, proximal=proximal, control=control)

    @property
    def _spread(self) -> Float[np.ndarray, "3"]:
        config = self.config
        return np.array([config.friction_spread, config.stiffness_spread, config.ostium_spread_mm])

    def _members(self, center: Float[np.ndarray, "episodes 3"], spread: Float[np.ndarray, "episodes 3"]) -> Members:
        """Return ensembles around some centers, each first: the same Sobol sequence for all."""
        from scipy.stats import qmc  # slow to import

        count = self.config.members  # the point after 0 is the middle
        unit = qmc.Sobol(3, scramble=False).random_base2(count.bit_length())[1 : count + 1]
        members = center + (2 * unit[:, None] - 1) * spread
        members = np.clip(members, NOMINAL - self._spread, NOMINAL + self._spread)
        level = np.linspace(1 - self.config.stiffness_spread, 1 + self.config.stiffness_spread, LEVELS)
        members[..., 1] = level[np.abs(members[..., 1, None] - level).argmin(axis=-1)]
        return members

    def _simulate(
        self, anatomy: Anatomy, data: Episodes, members: Members, samples: int
    ) -> Float[np.ndarray, "members episodes s 2"]:
        """Return (Δtip, γtip) of every member over the first samples, mm; NaN from where a simulation fails."""
        count = len(members)
        ensemble = Ensemble(
            anatomy,
            self.device,
            members.reshape(-1, 3),
            start=np.tile(data.initial[:, None], (count, 1, 1)),
            config=self.simulator,
            motion=data.setup.known_motions.get(anatomy.name),
        )
        return ensemble.replay(np.tile(data.command[:, :samples], (count, 1, 1))).reshape(count, len(data), samples, 2)


def weigh(
    paths: Float[np.ndarray, "members episodes samples 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    observed: Bool[np.ndarray, "episodes samples"],
    sd_mm: Float[np.ndarray, "episodes samples 2"],
    config: TwinConfig,
) -> tuple[Float[np.ndarray, "episodes samples 2"], Float[np.ndarray, "episodes samples 2"]]:
    """Return the tip that an ensemble predicts, and its spread, mm, from the observed tips of each episode.

    Args:
        paths: of the members, mm, as `TwinPredictor.ensemble` gives them.
        tips: (Δtip, γtip) where `observed`, mm; no other is read.
        sd_mm: standard deviations of these tips as whatever measured them states them, mm; 0 where it states none.
        config: scales of the error of a good member.
    """
    return _median_and_spread(paths, _weights(paths, tips, observed, _scales(sd_mm, config)))


def _scales(
    sd_mm: Float[np.ndarray, "episodes samples 2"], config: TwinConfig
) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the scales of a good member's error at each sample, mm: no smaller than what the measurement states."""
    return np.maximum([config.abscissa_sd_mm, config.offset_sd_mm], sd_mm)


def _unexplained(
    middle: Float[np.ndarray, "episodes samples 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    observed: Bool[np.ndarray, "episodes samples"],
    scale: Float[np.ndarray, "episodes samples 2"],
) -> Float[np.ndarray, "episodes samples 2"]:
    """Return by how much more than a good member the median erred at every one of the last observations, mm.

    Where something else than the ensemble's parameters is wrong, all members may err alike: their spread does not show
    it. A single error may be one of the measurement.
    """
    error = np.nan_to_num(np.abs(middle - np.where(observed[..., None], tips, middle)))
    beyond = np.maximum(error - GOOD * scale, 0.0)
    count = np.cumsum(observed, axis=1)
    order = np.argsort(~observed, axis=1, kind="stable")  # observed samples first
    last = np.maximum(count[..., None] - 1 - np.arange(_PERSISTENT), 0)
    episode = np.arange(len(observed))[:, None, None]
    persistent = beyond[episode, order[episode, last]].min(axis=2)
    return np.where(count[..., None] >= _PERSISTENT, persistent, 0.0)


def _weights(
    paths: Float[np.ndarray, "members episodes s 2"],
    tips: Float[np.ndarray, "episodes samples 2"],
    observed: Bool[np.ndarray, "episodes samples"],
    scale: Float[np.ndarray, "episodes samples 2"],
) -> Float[np.ndarray, "members episodes"]:
    """Return the members' weights: the product of Cauchy densities of their errors at the observed tips.

    Heavy tails, because a snap that comes a moment too early errs by a millimetre and says little about friction.
    """
    at = np.flatnonzero(observed.any(axis=0))
    at = at[at < paths.shape[2]]
    error = (paths[:, :, at] - tips[:, at]) / scale[:, at]
    score = np.where(observed[..., at, None], np.nan_to_num(-np.log1p(error**2), nan=-1e3), 0.0).sum(axis=(2, 3))
    return likelihoods(score)


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


def _by_anatomy(episodes: Episodes) -> Iterator[tuple[Anatomy, Int[np.ndarray, "chosen"]]]:
    for name in np.unique(episodes.anatomy):
        yield episodes.setup.anatomies[str(name)](), np.flatnonzero(episodes.anatomy == name)
