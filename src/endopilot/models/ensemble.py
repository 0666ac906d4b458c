"""Simulated wires that differ in what is uncertain: how they move, and how likely each is after what was seen.

They differ in what `hypotheses` may be other: in a patient who moves, in what the heart does, too. Breath moves vessel
and catheter together, and so no tip in its vessel.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.stack import Stack
from endopilot.models.hypotheses import HYPOTHESES, LUMEN, MEDIAN_SQUARE, Displaced, Family, likelihoods, log_likelihood
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.state import SimulationSetUp
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

FAMILY = Family([each for each in HYPOTHESES if each.name != LUMEN and not isinstance(each, Displaced)])
"""What members differ in; a lumen of their own would need a map of the vessel each, and tips along a vessel show no
registration."""
SCALES_MM = np.array([0.05, 0.025])
"""Scales of a good wire's error in Δtip and γtip where the tip is measured exactly, mm."""
NARROWEST = 0.1
"""Members are spread over this share of what is usual at least."""
Members = Float[np.ndarray, "members episodes p"]
"""Parameters of `FAMILY` of each member, for each episode."""
Paths = Float[np.ndarray, "members episodes samples 2"]
"""(Δtip, γtip) of each member at each sample, mm; NaN from where its simulation fails."""
Tips = Float[np.ndarray, "episodes samples 2"]
Seen = Bool[np.ndarray, "episodes samples"]


def replay(
    anatomy: Anatomy,
    stack: Stack,
    members: Members,
    *,
    start: Float[np.ndarray, "episodes devices 2"],
    command: Float[np.ndarray, "episodes samples devices 2"],
    config: SimulatorConfig,
    motion: Motion | None = None,
) -> Paths:
    """Drive every member from the start of each episode as the robot was commanded.

    Args:
        stack: the devices as they are given.
        start: inserted length (mm) and rotation (rad) of each device as the encoders have it.
        command: mm/s and rad/s of each sample.
        motion: as it is known.
    """
    count, episodes, size = members.shape
    worlds = [FAMILY.world(each, motion) for each in members.reshape(-1, size)]
    starts, commands = np.tile(start, (count, 1, 1)), np.tile(command, (count, 1, 1, 1)).astype(float)
    made = np.full((len(worlds), command.shape[1], 2), np.nan)
    friction = frictions(stack, np.array([each.friction_factor for each in worlds]))
    initial = as_deep(starts, np.array([each.ostium_mm for each in worlds]))
    alike = [replace(each, friction_factor=1.0, ostium_mm=0.0) for each in worlds]
    devices = {each: each.stack(stack) for each in alike}  # members of one kind share the processor's lanes
    cores = [(each.motion, each.core(config)) for each in worlds]
    for core in dict.fromkeys(cores):
        rows = np.array([k for k, each in enumerate(cores) if each == core])
        set_up = SimulationSetUp(
            anatomies=[anatomy] * len(rows),
            stacks=[devices[alike[k]] for k in rows],
            initial=initial[rows],
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


def frictions(stack: Stack, factors: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n devices"]:
    """Return the friction coefficients of devices whose wire has so many times its own."""
    return stack.frictions(stack.wire.friction * factors)


def as_deep(
    start: Float[np.ndarray, "n devices 2"], ostium_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n devices 2"]:
    """Return starts of devices that lie so much deeper than the encoders have it, mm."""
    return np.stack([np.maximum(start[..., 0] + ostium_mm[:, None], 0.0), start[..., 1]], axis=-1)


def weights(paths: Paths, tips: Tips, seen: Seen, sd_mm: Tips) -> Float[np.ndarray, "members episodes"]:
    """Return how likely the members are: the product of Cauchy densities of their errors at the tips that were seen.

    Heavy tails, because a snap that comes a moment too early errs by a millimetre and says little about friction. The
    scale is no smaller than what the best member leaves unexplained: of a measurement that is worse than it states, and
    of a world that no member is like.
    """
    error = np.where(seen[..., None], np.nan_to_num(paths - tips, nan=1e3), np.nan)
    scale = np.maximum(np.maximum(SCALES_MM, sd_mm), misfit(paths, tips, seen)[:, None])
    return likelihoods(np.nansum(log_likelihood(error, scale), axis=(2, 3)))


def misfit(paths: Paths, tips: Tips, seen: Seen) -> Float[np.ndarray, "episodes 2"]:
    """Return the standard deviation of what the best member leaves unexplained of the tips that were seen, mm."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nothing was seen
        error = np.where(seen[..., None], np.nan_to_num(np.abs(paths - tips), nan=1e3), np.nan)
        median = np.nanmedian(error, axis=2)
    return np.nan_to_num(median.min(axis=0)) / np.sqrt(MEDIAN_SQUARE)


def weigh(paths: Paths, tips: Tips, seen: Seen, sd_mm: Tips) -> tuple[Tips, Tips]:
    """Return the tip that members predict, and its spread, mm: their weighted median and deviation from it.

    The spread holds what no member explains too: members that all err alike agree. NaN where none is left.
    """
    weight = weights(paths, tips, seen, sd_mm)
    share = np.where(np.isfinite(paths), weight[:, :, None, None], 0.0)
    total = share.sum(axis=0)
    order = np.argsort(paths, axis=0)  # NaN last
    reached = np.cumsum(np.take_along_axis(share, order, axis=0), axis=0) >= 0.5 * total
    middle = np.take_along_axis(paths, np.take_along_axis(order, reached.argmax(axis=0)[None], axis=0), axis=0)[0]
    variance = (share * np.nan_to_num(paths - middle) ** 2).sum(axis=0)
    left = total > 0
    spread = np.sqrt(np.divide(variance, total, out=np.full_like(total, np.nan), where=left))
    return np.where(left, middle, np.nan), np.hypot(spread, misfit(paths, tips, seen)[:, None])
