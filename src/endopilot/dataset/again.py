"""Recorded episodes simulated again, in the vessel and with the wires and the motion that they were recorded with."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from endopilot.dataset.loader import Dataset
from endopilot.devices.device import Device
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy, Rollout


def simulate_again(
    data: Dataset,
    anatomy: Anatomy,
    control: Float[np.ndarray, "episodes samples 2"],
    *,
    friction: Float[np.ndarray, "episodes"] | None = None,
    record_shape: bool = False,
) -> Iterator[tuple[Int[np.ndarray, "chosen"], Rollout]]:
    """Simulate the episodes of one anatomy again.

    `data.command` as the control gives the recorded episodes, to the bit.

    Args:
        data: episodes of the anatomy alone, in any order; one may stand there several times.
        anatomy: of theirs.
        control: of the drive of each episode, mm/s and rad/s.
        friction: friction coefficient of each; as recorded if not given.
        record_shape: record the positions of all nodes too.

    Yields:
        Indices of the episodes whose wires have the same tip, and their simulation: a simulation has one wire.
    """
    device, settings = from_record(Device, data.manifest["device"]), data.manifest["config"]["simulator"]
    friction = data.friction if friction is None else friction
    tips, tip_of = np.unique(np.stack([data.tip_bend, data.tip_stiffness_factor], axis=-1), axis=0, return_inverse=True)
    for kind, (bend, factor) in enumerate(tips.astype(float)):
        chosen = np.flatnonzero(tip_of.ravel() == kind)
        yield (
            chosen,
            simulate(
                anatomy,
                device.with_tip(bend_rad=float(bend), stiffness_factor=float(factor)),
                control[chosen],
                initial=data.initial[chosen],
                config=SimulatorConfig(**settings),
                record_shape=record_shape,
                friction=friction[chosen],
                motion=data.motion(anatomy.name),
            ),
        )
