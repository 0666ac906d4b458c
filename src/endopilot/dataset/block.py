"""One block of navigations in two files: `write_block` draws and simulates them, `store_block` writes them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import parquet, schema
from endopilot.dataset.draw import Draw, draw_navigations, patient_motion
from endopilot.dataset.layout import Block, BlockContext
from endopilot.dataset.navigations import simulate_navigations
from endopilot.devices.stack import column_prefixes
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy


def write_block(
    context: BlockContext, block: Block, *, threads: int = 1, advance: Callable[[int], None] = lambda _: None
) -> None:
    """Simulate one block and write its episodes, then its samples: the sample file marks both as complete.

    Args:
        advance: called with the number of samples that were simulated since the last call.
    """
    config, anatomy, stack = context.config, _read(block.folder, block.identity), context.stack
    draw = draw_navigations(config, stack.wire, anatomy, block.sequences, devices=len(stack))
    world = context.world.leaning(config.seed)
    stacks = draw.stacks(stack)
    true = {id(each): world.stack(each) for each in stacks}
    friction = world.stack(stack).frictions(draw.friction * world.friction_factor)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # invalid worlds are listed in the dataset's manifest
        trajectory, stopped = simulate_navigations(
            world.anatomy(anatomy),
            [true[id(each)] for each in stacks],
            draw.initial,
            draw.control,
            friction,
            replace(world.core(config.simulator), threads=threads),
            actuation=config.control,
            motion=world.motion or patient_motion(config, anatomy.name),
            robot=context.robot,
            ostium_mm=world.ostium_mm,
            seeds=draw.seeds,
            advance=advance,
        )
    store_block(context, block, draw, trajectory, stopped)


def store_block(
    context: BlockContext, block: Block, draw: Draw, trajectory: Trajectory, stopped: Bool[np.ndarray, "n"]
) -> None:
    """Write navigations: their episodes, then their samples, which mark both as complete."""
    data_path, episodes_path = schema.paths_of_file(context.output, block.number)
    samples = parquet.sample_table(trajectory, block.first_episode, context.key)
    for path, table in (
        (episodes_path, parquet.marked_table(_episodes(context, block, draw, trajectory, stopped), context.key)),
        (data_path, samples),
    ):
        with writing(path) as partial:
            partial.write_bytes(parquet.parquet_bytes(table))


@lru_cache(maxsize=4)
def _read(folder: Path, identity: str) -> Anatomy:
    """Read an anatomy; the blocks of one anatomy follow each other.

    Raises:
        InputError: it is not the anatomy that the dataset was begun with.
    """
    anatomy = read_anatomy(folder)
    if anatomy.identity != identity:
        raise InputError(f"{folder}: is not the anatomy that the dataset was begun with; restore that anatomy")
    return anatomy


def _episodes(
    context: BlockContext, block: Block, draw: Draw, trajectory: Trajectory, stopped: Bool[np.ndarray, "n"]
) -> dict[str, Any]:
    """Return the columns of the episode table; the first seven and the last two are LeRobot's."""
    n, samples = trajectory.valid.shape
    set_up, prefixes = trajectory.set_up, column_prefixes(trajectory.devices)
    whole = [bool(valid.all()) for valid in trajectory.valid]
    episode = block.first_episode + np.arange(n)
    chunk, file = divmod(block.number, schema.FILES_PER_CHUNK)
    return {
        "episode_index": episode,
        "tasks": [[context.task]] * n,
        "length": np.full(n, samples),
        "dataset_from_index": episode * samples,
        "dataset_to_index": (episode + 1) * samples,
        "data/chunk_index": np.full(n, chunk),
        "data/file_index": np.full(n, file),
        "anatomy": [block.anatomy] * n,
        "anatomy_sha256": [block.identity] * n,
        "sequence": np.array(block.sequences),
        "split": block.splits.tolist(),
        "device": [context.stack.wire.name] * n,
        "tip_bend_rad": draw.tip_bend_rad,
        "tip_stiffness_factor": draw.tip_stiffness_factor,
        **{f"{prefix}friction": set_up.friction[:, k] for k, prefix in enumerate(prefixes)},
        **{
            f"{prefix}initial_{name}": set_up.initial[:, k, axis]
            for k, prefix in enumerate(prefixes)
            for axis, name in enumerate(("inserted_length_mm", "rotation_rad"))
        },
        **{f"catheter_{k + 1}": [each.name] * n for k, each in enumerate(context.stack.catheters)},
        "stopped_short": stopped,
        "valid": whole,
        "invalid_reason": ["" if valid else trajectory.why_invalid(world) for world, valid in enumerate(whole)],
        "meta/episodes/chunk_index": np.full(n, chunk),
        "meta/episodes/file_index": np.full(n, file),
    }
