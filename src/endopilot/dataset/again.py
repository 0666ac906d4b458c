"""Recorded episodes simulated again, in the vessel and with the wires and the motion that they were recorded with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.set_up import SimulationSetUp
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import Trajectory
from endopilot.simulation.world import World
from endopilot.types import Anatomy


def episode_set_up(data: Dataset, number: int) -> SimulationSetUp:
    """Return what an episode was simulated with; its `command` then gives the recorded one to the bit.

    Args:
        data: the dataset.
        number: of the episode.

    Raises:
        InputError: there is no such episode, or its anatomy is missing or another.
    """
    if not 0 <= number < len(data):
        raise InputError(f"world: {number}; {data.folder} has episodes 0 to {len(data) - 1}")
    one = data.select(np.array([number]))
    anatomy = read_anatomy(data.anatomy_folder(str(one.anatomy[0])))
    world = data.world
    return SimulationSetUp(
        anatomies=[world.anatomy(anatomy)],
        stacks=[_stack(one, world, float(one.tip_bend[0]), float(one.tip_stiffness_factor[0]))],
        initial=one.initial,
        friction=one.friction,
        actuation=data.manifest["config"]["control"],
        motion=one.motion(anatomy.name),
        config=world.core(_config(one)),
    )


def _stack(data: Dataset, world: World, bend_rad: float, stiffness_factor: float) -> Stack:
    stack = data.stack
    drawn = replace(stack, wire=stack.wire.with_tip(bend_rad=bend_rad, stiffness_factor=stiffness_factor))
    return world.stack(drawn)


def _config(data: Dataset) -> SimulatorConfig:
    return SimulatorConfig(**data.manifest["config"]["simulator"])


def simulate_again(
    data: Dataset,
    anatomy: Anatomy,
    control: Float[np.ndarray, "episodes samples *devices 2"],
    *,
    friction: Float[np.ndarray, "episodes devices"] | None = None,
    record_shape: bool = False,
) -> Iterator[tuple[Int[np.ndarray, "chosen"], Trajectory]]:
    """Simulate the episodes of one anatomy again.

    `data.command` as the control gives the recorded episodes, to the bit.

    Args:
        data: episodes of the anatomy alone, in any order; one may stand there several times.
        anatomy: of theirs.
        control: of the drives of each episode, mm/s and rad/s.
        friction: Coulomb coefficients of the devices on the wall; as recorded if not given.
        record_shape: record the positions of all nodes too.

    Yields:
        Indices of the episodes whose wires have the same tip, and their simulation: a simulation has one wire.
    """
    friction = data.friction if friction is None else friction
    world = data.world
    tips, tip_of = np.unique(np.stack([data.tip_bend, data.tip_stiffness_factor], axis=-1), axis=0, return_inverse=True)
    for kind, (bend, factor) in enumerate(tips.astype(float)):
        chosen = np.flatnonzero(tip_of.ravel() == kind)
        yield (
            chosen,
            simulate(
                world.anatomy(anatomy),
                _stack(data, world, float(bend), float(factor)),
                control[chosen],
                initial=data.initial[chosen],
                config=world.core(_config(data)),
                record_shape=record_shape,
                friction=friction[chosen],
                motion=data.motion(anatomy.name),
            ),
        )
