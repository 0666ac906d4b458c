"""Controls that lead a simulated tip along desired tip states: `track`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.models.open_loop import Steps2
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
