"""One navigation as a dataset of its own, to be read beside others: `write_episode`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.dataset.block import store_block
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.draw import Draw
from endopilot.dataset.generate import describe
from endopilot.dataset.layout import make_layout
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device
from endopilot.runs import claim
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.types import CatheterMotion, Rollout


def write_episode(
    rollout: Rollout,
    anatomy_folder: Path,
    output: Path,
    device: Device,
    *,
    task: str,
    friction: float,
    tip_stiffness_factor: float,
    simulator: SimulatorConfig,
    catheters: Sequence[Catheter] = (),
    motion: Motion | None = None,
    seed: int,
    origin: Mapping[str, Any],
) -> None:
    """Write a navigation that was recorded every 0.5 s as a dataset of one episode. That of a wire alone trains.

    Args:
        rollout: the navigation, of one world.
        anatomy_folder: of its vessel.
        output: folder of the dataset.
        device: the wire as it was given; friction and stiffness of its tip may have been others.
        task: what was done, in words.
        friction: the true friction coefficient.
        tip_stiffness_factor: the true factor on the stiffness of the distal 10 mm.
        simulator: settings of the rod core.
        catheters: around the wire as they were given, from the inside out.
        motion: how the vessel moved; it lay still if not given.
        seed: of the navigation.
        origin: what else it followed from, such as target and policy.

    Raises:
        InputError: the output folder holds something else.
    """
    config = DatasetConfig(
        sequences=1,
        seconds=rollout.valid.shape[1] * rollout.sample_period_s,
        seed=seed,
        simulator=simulator,
        anatomy_shares=(1.0, 0.0, 0.0),
        seen_test_share=0.0,
    )
    moved = {"motion": None if motion is None else asdict(motion)}
    layout = make_layout(
        [anatomy_folder], output, device, config, catheters=catheters, task=task, origin={**origin, **moved}
    )
    layout = replace(layout, motions=(motion,))  # it was not drawn with the seed
    (block,) = layout.blocks()
    claim(output, "endopilot navigate", **layout.settings)
    start = np.column_stack([rollout.initial_inserted_length, rollout.initial_rotation])
    commanded = rollout.control
    if rollout.catheters is not None:
        start, commanded = _of_all(rollout, rollout.catheters, start)
    one = {"friction": friction, "tip_bend_rad": device.tip_bend_rad, "tip_stiffness_factor": tip_stiffness_factor}
    drawn = Draw(start, commanded, **{name: np.array([value]) for name, value in one.items()})
    store_block(layout.context, block, drawn, rollout, commanded, np.array([False]))
    describe(layout, [block])


def _of_all(
    rollout: Rollout, motion: CatheterMotion, start: Float[np.ndarray, "worlds 2"]
) -> tuple[Float[np.ndarray, "worlds numbers"], Float[np.ndarray, "worlds samples numbers"]]:
    """Return Δ and φ of wire and catheters before the first period, and what their drives were commanded."""
    period = rollout.sample_period_s
    slip = np.stack([rollout.slip, rollout.rotation_slip], axis=-1)
    slips = np.stack([motion.slip, motion.rotation_slip], axis=-1)
    state = np.stack([motion.inserted_length, motion.rotation], axis=-1)
    starts = state[:, 0] - period * motion.control[:, 0]
    commanded = np.concatenate(
        [rollout.control + slip / period, *np.moveaxis(motion.control + slips / period, 2, 0)], axis=-1
    )
    return np.concatenate([start, *np.moveaxis(starts, 1, 0)], axis=-1), commanded
