"""The model of simulated wires: rod cores that are weighted by what X-ray showed, and led along desired tips.

A few wires that differ in what is uncertain (`ensemble`) follow the known commands through the samples at which the tip
was seen. A regression over them says which wire retraces those best, and how surely. Wires around it follow the
commands to the end: their weighted median is the prediction, their weighted spread its band; where they part the tip
may jump. There is nothing to train: a vessel and devices are all that the model needs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.models import ensemble
from endopilot.models.config import WINDOW
from endopilot.models.ensemble import FAMILY, NARROWEST, SCALES_MM, Members, Paths
from endopilot.models.episodes import (
    EachObserved,
    Episodes,
    EpisodeSetUp,
    Observed,
    OpenLoop,
    Prediction,
    Steps2,
    begin_after,
    given_states,
    jumps,
)
from endopilot.models.hypotheses import Posterior
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

GENERATIONS = 2
"""Times that wires are tried through what was seen; those of the next are drawn around the best of the last."""
TRIED, FOLLOWED = (8, 4), (2, 4)
"""Kinds of wires in a generation, and how many of each; and of those that follow the commands to the end, around the
best one."""
TRANSLATIONS_MM_S = (-5.0, -1.5, 0.0, 1.5, 5.0)
"""Speeds that are tried, beyond the one that would move a tip without slack to where it is desired."""
ROTATIONS_RAD_S = (-2.0, 0.0, 2.0)
"""Rotations that are tried with each."""


@dataclass(frozen=True, eq=False)
class SimulatedWires:
    """The rod core as a predictor of whatever devices episodes have.

    Attributes:
        identified: what is believed after what was seen of given states, by setup and by a digest of patient, commands
            and tips; all protocols and later plans share it.
        tracked: controls that lead the tip along the desired one from the given states on; P2 and P3 share them.
    """

    identified: WeakKeyDictionary[EpisodeSetUp, dict[bytes, Posterior]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    tracked: WeakKeyDictionary[Episodes, OpenLoop] = field(default_factory=WeakKeyDictionary, repr=False)

    def predict(self, episodes: Episodes, observed: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes from their commands and from the observed tips.

        Args:
            episodes: their commands, and their tips where `observed`; no other tip is read.
            observed: samples at which the tip was observed, of all episodes alike or of each.
        """
        seen = np.broadcast_to(observed, episodes.branch.shape)
        paths, tips, sd_mm = self.paths(episodes, seen), episodes.tip.astype(float), episodes.tip_sd.astype(float)
        tip, spread = ensemble.weigh(paths, tips, seen, sd_mm)
        weight = ensemble.weights(paths, tips, seen, sd_mm)
        jumping = np.array([jumps(each[..., 0], episodes.proximal[..., 0].astype(float)) for each in paths])
        return Prediction(tip, spread, np.einsum("me,mes->es", weight, jumping))

    def paths(self, episodes: Episodes, seen: EachObserved) -> Paths:
        """Return the tips, mm, of the wires that are likely after the seen ones; NaN from where a simulation fails.

        `ensemble.weigh` makes a prediction of them, and again, without another simulation, when more tips are seen.
        """
        found = np.full((1 + np.prod(FOLLOWED), *episodes.tip.shape), np.nan)
        for anatomy, chosen in _by_anatomy(episodes):
            data = episodes.select(chosen)
            believed, least = self._identified(anatomy, data, seen[chosen]), np.diag(NARROWEST * FAMILY.usual)
            around = [FAMILY.drawn(each.center, each.factor + least, *FOLLOWED) for each in believed]
            members = np.stack([np.concatenate([e.center[None], m]) for e, m in zip(believed, around, strict=True)], 1)
            found[:, chosen] = _replayed(anatomy, data, members, data.samples)
        return found

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        later = slice(WINDOW, None)
        tip = self.predict(episodes, given_states(episodes)).tip[:, later]
        return OpenLoop(tip, episodes.proximal[:, later].astype(float), episodes.control[:, later].astype(float))

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        found = self.rollout_dual(episodes)
        return OpenLoop(tip=episodes.tip[:, WINDOW:].astype(float), proximal=found.proximal, control=found.control)

    def rollout_dual(self, episodes: Episodes, observed: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        The wire that retraces the observed tips best is led along the desired ones, one sample at a time: see `track`.
        """
        if observed is not None:
            return self._led(episodes, observed)
        if episodes not in self.tracked:
            self.tracked[episodes] = self._led(episodes, given_states(episodes))
        return self.tracked[episodes]

    def _led(self, episodes: Episodes, observed: Observed) -> OpenLoop:
        """Return the controls that lead each episode's best wire along the desired tips after the last observed one."""
        begin = begin_after(observed)
        desired = episodes.tip[:, begin:].astype(float)
        tip, control = np.empty(desired.shape), np.empty(desired.shape)
        for anatomy, chosen in _by_anatomy(episodes):
            data = episodes.select(chosen)
            believed = self._identified(anatomy, data, np.broadcast_to(observed, data.branch.shape))
            best, stack = [FAMILY.world(each.center) for each in believed], Stack.of(data.setup.device)
            tip[chosen], control[chosen] = track(
                anatomy,
                [each.stack(stack) for each in best],
                friction=ensemble.frictions(stack, np.array([each.friction_factor for each in best])),
                start=ensemble.as_deep(data.start, np.array([each.ostium_mm for each in best])),
                command=data.command,
                desired=desired[chosen],
                config=data.setup.simulator,
                motion=data.setup.known_motions.get(anatomy.name),
            )
        start = episodes.proximal[:, begin - 1 : begin].astype(float)
        return OpenLoop(tip=tip, proximal=start + SAMPLE_PERIOD_S * np.cumsum(control, axis=1), control=control)

    def _identified(self, anatomy: Anatomy, data: Episodes, seen: EachObserved) -> list[Posterior]:
        """Return what is believed of episodes of one anatomy after what was seen of the given states."""
        known, seen = self.identified.setdefault(data.setup, {}), seen[:, :WINDOW]
        digests = [_digest(data, i, seen[i]) for i in range(len(data))]
        new = np.array([i for i, digest in enumerate(digests) if digest not in known], dtype=int)
        if len(new):
            for i, found in zip(new, _identify(anatomy, data.select(new), seen[new]), strict=True):
                known[digests[i]] = found
        return [known[digest] for digest in digests]


def _digest(data: Episodes, i: int, seen: Observed) -> bytes:
    """Return what identifies an episode's patient, its commands and what was seen of its first samples."""
    given = slice(len(seen))
    signals = (
        data.start[i],
        data.command[i, given],
        np.packbits(seen),
        data.tip[i, given][seen],
        data.tip_sd[i, given],
    )
    return hashlib.sha256(b"\0".join([str(data.anatomy[i]).encode(), *(part.tobytes() for part in signals)])).digest()


def _identify(anatomy: Anatomy, data: Episodes, seen: EachObserved) -> list[Posterior]:
    count, size = len(data), len(FAMILY.parameters)
    found = [FAMILY.as_given()] * count
    samples = int(np.nonzero(seen)[1].max(initial=-1)) + 1
    tips, scale = data.tip[:, :samples].astype(float), np.maximum(SCALES_MM, data.tip_sd[:, :samples].astype(float))
    center, spread = np.zeros((count, size)), np.ones((count, size))
    for generation in range(GENERATIONS if samples else 0):
        each = zip(center, spread, strict=True)
        members = np.stack([FAMILY.drawn(c, np.diag(s), *TRIED, seed=generation) for c, s in each], axis=1)
        paths = _replayed(anatomy, data, members, samples)
        found = [
            FAMILY.update(members[:, k], paths[:, k, at], tips[k, at], scale[k, at], noisy=True)
            for k, at in enumerate(seen[:, :samples])
        ]
        center = np.array([each.mean for each in found])
        spread = np.clip([2 * each.sd for each in found], NARROWEST, 1.0)
    return found


def _replayed(anatomy: Anatomy, data: Episodes, members: Members, samples: int) -> Paths:
    setup = data.setup
    return ensemble.replay(
        anatomy,
        Stack.of(setup.device),
        members,
        start=data.start,
        command=data.command[:, :samples],
        config=setup.simulator,
        motion=setup.known_motions.get(anatomy.name),
    )


def track(
    anatomy: Anatomy,
    stacks: Sequence[Stack],
    *,
    friction: Float[np.ndarray, "episodes devices"],
    start: Float[np.ndarray, "episodes devices 2"],
    command: Float[np.ndarray, "episodes samples devices 2"],
    desired: Steps2,
    config: SimulatorConfig,
    motion: Motion | None = None,
) -> tuple[Steps2, Steps2]:
    """Drive each episode's wire by its first commands, then sample by sample along the desired tips.

    At every sample each wire tries all combinations of `TRANSLATIONS_MM_S` and `ROTATIONS_RAD_S` from its present state
    and keeps the one whose tip ends nearest to the desired (Δtip, γtip), in the sum of both distances.

    Args:
        stacks: the devices of each episode; the same object where they are the same.
        friction: Coulomb friction coefficients.
        start: (Δ mm, φ rad) before the first command.
        command: mm/s and rad/s; in the last samples, those of `desired`, catheters alone follow it.
        desired: (Δtip, γtip) mm at the end of each of the last sample periods.

    Returns:
        Tip (Δtip, γtip) mm, and control (mm/s, rad/s) as the wire's drive made it, in the last sample periods.
    """
    tries = np.array([(v, w) for v in TRANSLATIONS_MM_S for w in ROTATIONS_RAD_S])
    episodes, each = len(stacks), len(tries)
    limits, begin = DriveLimits.of(stacks[0].wire, anatomy), command.shape[1] - desired.shape[1]
    given = Simulator(anatomy, list(stacks), config=config, motion=motion)
    given.reset(inserted_length=start[..., 0], rotation=start[..., 1], friction=friction)
    for sample in range(begin):
        moved = command[:, sample].astype(float)
        moved[:, 0] = limits.clip(moved[:, 0], given.inserted_length[:, 0], SAMPLE_PERIOD_S)
        given.step(moved, SAMPLE_PERIOD_S)
    simulator = Simulator(anatomy, [stack for stack in stacks for _ in range(each)], config=config, motion=motion)
    simulator.copy_worlds(np.repeat(np.arange(episodes), each), of=given)
    tip, control = np.empty(desired.shape), np.empty(desired.shape)
    for k in range(desired.shape[1]):
        moved = np.repeat(command[:, begin + k], each, axis=0).astype(float)
        lead = (np.repeat(desired[:, k, 0], each) - simulator.project().abscissa[:, 0]) / SAMPLE_PERIOD_S
        moved[:, 0] = np.tile(tries, (episodes, 1))
        moved[:, 0, 0] += lead
        moved[:, 0] = limits.clip(moved[:, 0], simulator.inserted_length[:, 0], SAMPLE_PERIOD_S)
        step = simulator.step(moved, SAMPLE_PERIOD_S)
        reached = simulator.project()[:, 0]
        error = np.abs(reached.abscissa - np.repeat(desired[:, k, 0], each))
        error += np.abs(reached.offset - np.repeat(desired[:, k, 1], each))
        error[~step.valid] = np.inf
        best = error.reshape(episodes, each).argmin(axis=1) + each * np.arange(episodes)
        tip[:, k] = np.stack([reached.abscissa[best], reached.offset[best]], axis=-1)
        slip = np.stack([step.slip, step.rotation_slip], axis=-1)[best, 0]
        control[:, k] = moved[best, 0] - slip / SAMPLE_PERIOD_S
        simulator.copy_worlds(np.repeat(best, each))
    return tip, control


def _by_anatomy(episodes: Episodes) -> Iterator[tuple[Anatomy, Int[np.ndarray, "chosen"]]]:
    for name in np.unique(episodes.anatomy):
        yield episodes.setup.anatomies[str(name)](), np.flatnonzero(episodes.anatomy == name)
