"""One navigation as a dataset of its own, to be read beside others: `write_episode`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.dataset.block import store_block
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.draw import Draw
from endopilot.dataset.generate import describe
from endopilot.dataset.layout import make_layout
from endopilot.devices.stack import Stack
from endopilot.runs import claim
from endopilot.simulation.trajectory import Trajectory


def write_episode(
    trajectory: Trajectory,
    anatomy_folder: Path,
    output: Path,
    stack: Stack,
    *,
    task: str,
    tip_stiffness_factor: float,
    seed: int,
    origin: Mapping[str, Any],
) -> None:
    """Write a navigation that was recorded every 0.5 s as a dataset of one episode. That of a wire alone trains.

    Args:
        trajectory: the navigation, of one world.
        stack: the devices as they were given; friction and stiffness of the wire's tip may have been others.
        tip_stiffness_factor: the true factor on the stiffness of the distal 10 mm.
        origin: what else it followed from, such as target and policy.

    Raises:
        InputError: the output folder holds something else.
    """
    set_up = trajectory.set_up
    config = DatasetConfig(
        sequences=1,
        seconds=trajectory.valid.shape[1] * trajectory.period_s,
        seed=seed,
        simulator=set_up.config,
        anatomy_shares=(1.0, 0.0, 0.0),
        seen_test_share=0.0,
    )
    moved = {"motion": None if set_up.motion is None else asdict(set_up.motion)}
    layout = make_layout([anatomy_folder], output, stack, config, task=task, origin={**origin, **moved})
    layout = replace(layout, motions=(set_up.motion,))  # it was not drawn with the seed
    (block,) = layout.blocks()
    claim(output, "endopilot navigate", **layout.settings)
    drawn = Draw(
        set_up.initial,
        trajectory.command,
        friction=set_up.friction[:1, 0],
        tip_bend_rad=np.array([stack.wire.tip_bend_rad]),
        tip_stiffness_factor=np.array([tip_stiffness_factor]),
    )
    store_block(layout.context, block, drawn, trajectory, np.array([False]))
    describe(layout, [block])
