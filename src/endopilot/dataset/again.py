"""Recorded episodes simulated again, in the vessel and with the wires and the motion that they were recorded with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.set_up import SimulationSetUp
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy


def episode_set_up(data: Dataset, number: int) -> SimulationSetUp:
    """Return what an episode was simulated with; its `command` then gives the recorded one to the bit.

    Raises:
        InputError: there is no such episode, or its anatomy is missing or another.
    """
    if not 0 <= number < len(data):
        raise InputError(f"world: {number}; {data.folder} has episodes 0 to {len(data) - 1}")
    one = data.select(np.array([number]))
    return episodes_set_up(one, read_anatomy(data.anatomy_folder(str(one.anatomy[0]))))


def episodes_set_up(data: Dataset, anatomy: Anatomy) -> SimulationSetUp:
    """Return what episodes of one anatomy were simulated with; one may stand there several times."""
    world, given = data.world, data.stack
    tips = list(
        zip(data.tip_bend.astype(float).tolist(), data.tip_stiffness_factor.astype(float).tolist(), strict=True)
    )
    drawn = {tip: given.wire.with_tip(bend_rad=tip[0], stiffness_factor=tip[1]) for tip in tips}
    stacks = {tip: world.stack(replace(given, wire=wire)) for tip, wire in drawn.items()}
    return SimulationSetUp(
        anatomies=[world.anatomy(anatomy)] * len(data),
        stacks=[stacks[bend, factor] for bend, factor in tips],
        initial=data.initial,
        friction=data.friction,
        actuation=data.manifest["config"]["control"],
        motion=data.motion(anatomy.name),
        config=world.core(SimulatorConfig(**data.manifest["config"]["simulator"])),
    )


def simulate_again(
    data: Dataset,
    anatomy: Anatomy,
    control: Float[np.ndarray, "episodes samples devices 2"],
    *,
    friction: Float[np.ndarray, "episodes devices"] | None = None,
    record_shape: bool = False,
) -> Trajectory:
    """Simulate the episodes of one anatomy again, a world each; `data.command` gives the recorded ones, to the bit.

    Args:
        data: episodes of the anatomy alone, in any order; one may stand there several times.
        control: of the drives, mm/s and rad/s.
        friction: Coulomb coefficients of the devices on the wall; as recorded if not given.
    """
    set_up = replace(episodes_set_up(data, anatomy), actuation="velocity")
    set_up = set_up if friction is None else replace(set_up, friction=friction)
    return run_set_up(set_up, control, period_s=data.sample_period_s, record_shape=record_shape)
