"""One block of navigations in two files: `write_block` draws and simulates them, `store_block` writes them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.io import read_anatomy
from endopilot.anatomy.projection import project_tip
from endopilot.dataset import parquet, schema
from endopilot.dataset.draw import Draw, draw_navigations, patient_motion
from endopilot.dataset.layout import Block, BlockContext
from endopilot.dataset.navigations import simulate_navigations
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.simulation.simulate import why_invalid
from endopilot.types import Anatomy, Rollout


def write_block(
    context: BlockContext, block: Block, *, threads: int = 1, advance: Callable[[int], None] = lambda _: None
) -> None:
    """Simulate one block and write its episodes, then its samples: the sample file marks both as complete.

    Args:
        context: what all blocks share.
        block: which navigations.
        threads: of the rod core.
        advance: called with the number of samples that were simulated since the last call.
    """
    config, anatomy = context.config, _read(block.folder, block.identity)
    draw = draw_navigations(config, context.device, anatomy, block.sequences, catheters=len(context.catheters))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # invalid worlds are listed in the dataset's manifest
        rollout, started, applied, stopped = simulate_navigations(
            anatomy,
            draw.devices(context.device),
            draw.initial,
            draw.control,
            draw.friction,
            replace(config.simulator, threads=threads),
            catheters=context.catheters,
            actuation=config.control,
            motion=patient_motion(config, anatomy.name),
            advance=advance,
        )
    store_block(context, block, replace(draw, initial=started), rollout, applied, stopped)


def store_block(
    context: BlockContext,
    block: Block,
    draw: Draw,
    rollout: Rollout,
    applied: Float[np.ndarray, "n samples numbers"],
    stopped: Bool[np.ndarray, "n"],
) -> None:
    """Write navigations: their episodes, then their samples, which mark both as complete.

    Args:
        context: what all blocks share.
        block: which navigations.
        draw: their starts, friction and tips.
        rollout: their motion.
        applied: control of each, where it is a load (N, N·mm).
        stopped: which were stopped short of an end of the vessel.
    """
    config = context.config
    data_path, episodes_path = schema.paths_of_file(context.output, block.number)
    tips = None
    if rollout.catheters is not None:
        anatomy = _read(block.folder, block.identity)
        tips = project_tip(anatomy.tree, anatomy.insertion, rollout.catheters.tip_position)
    samples = parquet.sample_table(rollout, applied, config.control, block.first_episode, context.key, tips)
    for path, table in (
        (episodes_path, parquet.episode_table(_episodes(context, block, draw, rollout, stopped), context.key)),
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
    context: BlockContext, block: Block, draw: Draw, rollout: Rollout, stopped: Bool[np.ndarray, "n"]
) -> dict[str, Any]:
    """Return the columns of the episode table; the first seven and the last two are LeRobot's."""
    n, samples = rollout.valid.shape
    whole = [bool(valid.all()) for valid in rollout.valid]
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
        "device": [context.device.name] * n,
        "friction": draw.friction,
        "tip_bend_rad": draw.tip_bend_rad,
        "tip_stiffness_factor": draw.tip_stiffness_factor,
        "initial_inserted_length_mm": rollout.initial_inserted_length,
        "initial_rotation_rad": rollout.initial_rotation,
        **_of_catheters(context, draw),
        "stopped_short": stopped,
        "valid": whole,
        "invalid_reason": ["" if valid else why_invalid(rollout, world) for world, valid in enumerate(whole)],
        "meta/episodes/chunk_index": np.full(n, chunk),
        "meta/episodes/file_index": np.full(n, file),
    }


def _of_catheters(context: BlockContext, draw: Draw) -> dict[str, Any]:
    """Return the columns of each catheter: its name, and Δ and φ before the first period."""
    columns: dict[str, Any] = {}
    for k, catheter in enumerate(context.catheters):
        prefix = f"catheter_{k + 1}"
        columns[prefix] = [catheter.name] * len(draw.initial)
        columns[f"{prefix}_initial_inserted_length_mm"] = draw.initial[:, 2 * k + 2]
        columns[f"{prefix}_initial_rotation_rad"] = draw.initial[:, 2 * k + 3]
    return columns
