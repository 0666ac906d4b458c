"""The model of simulated wires: rod cores that are weighted by the given tips, and led along desired ones.

A few wires that differ in what `hypotheses` may be other follow the known commands through the given states; in a
patient who moves the heart may do so otherwise, too. Breath moves vessel and catheter together, and so no tip in its
vessel. A regression over them says which wire retraces those states best, and how surely. Wires around it follow the
commands to the end: their weighted median is the prediction. There is nothing to train: a vessel and devices are all
that the model needs.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, OpenLoop, Steps2
from endopilot.models.hypotheses import (
    DRIFT,
    HYPOTHESES,
    LUMEN,
    MEDIAN_SQUARE,
    REGISTRATION,
    Family,
    Posterior,
    likelihoods,
    log_likelihood,
)
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulationSetUp
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

FAMILY = Family([each for each in HYPOTHESES if each.name not in (LUMEN, REGISTRATION, DRIFT)])
"""What members differ in; a lumen of their own would need a map of the vessel each, and tips along a vessel show no
registration."""
SCALES_MM = np.array([0.05, 0.025])
"""Scales of a good wire's error in Δtip and γtip where the tip is known exactly, mm."""
NARROWEST = 0.1
"""Members are spread over this share of what is usual at least."""
GENERATIONS = 2
"""Times that wires are tried through what was seen; those of the next are drawn around the best of the last."""
TRIED, FOLLOWED = (8, 4), (2, 4)
"""Kinds of wires in a generation, and how many of each; and of those that follow the commands to the end, around the
best one."""
TRANSLATIONS_MM_S = (-5.0, -1.5, 0.0, 1.5, 5.0)
"""Speeds that are tried, beyond the one that would move a tip without slack to where it is desired."""
ROTATIONS_RAD_S = (-2.0, 0.0, 2.0)
"""Rotations that are tried with each."""
Paths = Float[np.ndarray, "members episodes samples 2"]
"""(Δtip, γtip) of each member at each sample, mm; NaN from where its simulation fails."""


@dataclass(frozen=True, eq=False)
class SimulatedWires:
    """The rod core as a predictor of whatever devices episodes have.

    Attributes:
        identified: what is believed after the given states of episodes, by anatomy; all protocols share it.
        tracked: controls that lead the tip along the desired one; P2 and P3 share them.
    """

    identified: WeakKeyDictionary[Episodes, dict[str, list[Posterior]]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    tracked: WeakKeyDictionary[Episodes, OpenLoop] = field(default_factory=WeakKeyDictionary, repr=False)

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        tip, least = np.empty((*episodes.tip[:, WINDOW:].shape,)), np.diag(NARROWEST * FAMILY.usual)
        for chosen, anatomy, data, believed in self._believed(episodes):
            around = [FAMILY.drawn(each.center, each.factor + least, *FOLLOWED) for each in believed]
            members = np.stack([np.concatenate([e.center[None], m]) for e, m in zip(believed, around, strict=True)], 1)
            paths = _replayed(anatomy, data, members, data.tip.shape[1])
            weight = weights(paths[:, :, :WINDOW], data.tip[:, :WINDOW].astype(float))
            tip[chosen] = weighted_median(paths[:, :, WINDOW:], weight)
        return OpenLoop(tip=tip, control=episodes.control[:, WINDOW:].astype(float))

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        return replace(self.rollout_dual(episodes), tip=episodes.tip[:, WINDOW:].astype(float))

    def rollout_dual(self, episodes: Episodes) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        The wire that retraces the given tips best is led along the desired ones, one sample at a time: see `track`.
        """
        if episodes in self.tracked:
            return self.tracked[episodes]
        desired = episodes.tip[:, WINDOW:].astype(float)
        tip, control = np.empty(desired.shape), np.empty(desired.shape)
        for chosen, anatomy, data, believed in self._believed(episodes):
            best, stack = [FAMILY.world(each.center) for each in believed], Stack.of(data.device)
            tip[chosen], control[chosen] = track(
                anatomy,
                [each.stack(stack) for each in best],
                friction=stack.frictions(stack.wire.friction * np.array([each.friction_factor for each in best])),
                start=_as_deep(data.start, np.array([each.ostium_mm for each in best])),
                command=data.command,
                desired=desired[chosen],
                config=data.simulator,
                motion=data.known_motions.get(anatomy.name),
            )
        self.tracked[episodes] = OpenLoop(tip=tip, control=control)
        return self.tracked[episodes]

    def _believed(
        self, episodes: Episodes
    ) -> Iterator[tuple[Int[np.ndarray, "chosen"], Anatomy, Episodes, list[Posterior]]]:
        """Yield the episodes of each anatomy, and what is believed of them after the given states."""
        known = self.identified.setdefault(episodes, {})
        for name in np.unique(episodes.anatomy).tolist():
            chosen, anatomy = np.flatnonzero(episodes.anatomy == name), episodes.anatomies[name]()
            data = episodes.select(chosen)
            if name not in known:
                known[name] = _identify(anatomy, data)
            yield chosen, anatomy, data, known[name]


def _identify(anatomy: Anatomy, data: Episodes) -> list[Posterior]:
    count, size, found = len(data), len(FAMILY.parameters), list[Posterior]()
    tips = data.tip[:, :WINDOW].astype(float)
    scale = np.broadcast_to(SCALES_MM, tips.shape[1:])
    center, spread = np.zeros((count, size)), np.ones((count, size))
    for generation in range(GENERATIONS):
        each = zip(center, spread, strict=True)
        members = np.stack([FAMILY.drawn(c, np.diag(s), *TRIED, seed=generation) for c, s in each], axis=1)
        paths = _replayed(anatomy, data, members, WINDOW)
        found = [FAMILY.update(members[:, k], paths[:, k], tips[k], scale, noisy=True) for k in range(count)]
        center = np.array([each.mean for each in found])
        spread = np.clip([2 * each.sd for each in found], NARROWEST, 1.0)
    return found


def _replayed(
    anatomy: Anatomy, data: Episodes, members: Float[np.ndarray, "members episodes p"], samples: int
) -> Paths:
    """Drive every member, given its parameters of `FAMILY`, from the start of each episode as the robot was commanded,
    for some samples."""
    count, episodes, size = members.shape
    stack, motion = Stack.of(data.device), data.known_motions.get(anatomy.name)
    worlds = [FAMILY.world(each, motion) for each in members.reshape(-1, size)]
    starts = _as_deep(np.tile(data.start, (count, 1, 1)), np.array([each.ostium_mm for each in worlds]))
    commands = np.tile(data.command[:, :samples], (count, 1, 1, 1)).astype(float)
    made = np.full((len(worlds), samples, 2), np.nan)
    friction = stack.frictions(stack.wire.friction * np.array([each.friction_factor for each in worlds]))
    alike = [replace(each, friction_factor=1.0, ostium_mm=0.0) for each in worlds]
    devices = {each: each.stack(stack) for each in alike}  # members of one kind share the processor's lanes
    cores = [(each.motion, each.core(data.simulator)) for each in worlds]
    for core in dict.fromkeys(cores):
        rows = np.array([k for k, each in enumerate(cores) if each == core])
        set_up = SimulationSetUp(
            anatomies=[anatomy] * len(rows),
            stacks=[devices[alike[k]] for k in rows],
            initial=starts[rows],
            friction=friction[rows],
            actuation="velocity",
            motion=core[0],
            config=core[1],
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails is left out
            run = run_set_up(set_up, commands[rows], period_s=SAMPLE_PERIOD_S, record_shape=False)
        tip = run.tip[:, :, 0]
        made[rows] = np.where(run.valid[..., None], np.stack([tip.abscissa, tip.offset], axis=-1), np.nan)
    return made.reshape(count, episodes, -1, 2)


def _as_deep(
    start: Float[np.ndarray, "n devices 2"], ostium_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n devices 2"]:
    """Return starts of devices that lie so much deeper than the encoders have it, mm."""
    return np.stack([np.maximum(start[..., 0] + ostium_mm[:, None], 0.0), start[..., 1]], axis=-1)


def weights(paths: Paths, tips: Float[np.ndarray, "episodes samples 2"]) -> Float[np.ndarray, "members episodes"]:
    """Return how likely the members are: the product of Cauchy densities of their errors at the tips that were seen.

    Heavy tails, because a snap that comes a moment too early errs by a millimetre and says little about friction. The
    scale is no smaller than what the best member leaves unexplained, such as in a world that no member is like.
    """
    error = np.nan_to_num(np.abs(paths - tips), nan=1e3)
    misfit = np.median(error, axis=2).min(axis=0) / np.sqrt(MEDIAN_SQUARE)
    return likelihoods(log_likelihood(error, np.maximum(SCALES_MM, misfit[:, None])).sum(axis=(2, 3)))


def weighted_median(paths: Paths, weight: Float[np.ndarray, "members episodes"]) -> Steps2:
    """Return the weighted median of the members' tips, mm; NaN where none is left."""
    share = np.where(np.isfinite(paths), weight[:, :, None, None], 0.0)
    total, order = share.sum(axis=0), np.argsort(paths, axis=0)  # NaN last
    reached = np.cumsum(np.take_along_axis(share, order, axis=0), axis=0) >= 0.5 * total
    middle = np.take_along_axis(paths, np.take_along_axis(order, reached.argmax(axis=0)[None], axis=0), axis=0)[0]
    return np.where(total > 0, middle, np.nan)


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
