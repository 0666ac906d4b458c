"""Write the blocks of a dataset, simulated on the cores of this machine or on the workers of a Dask cluster."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import parquet, schema
from endopilot.dataset.layout import Block, Layout, version
from endopilot.dataset.navigations import Draw, draw_navigations, simulate_navigations
from endopilot.devices.stack import column_prefixes
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.parallel import CORES
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy


def write_block(
    layout: Layout, block: Block, *, threads: int = 1, advance: Callable[[int], None] = lambda _: None
) -> None:
    """Simulate one block and write it; `advance` is called with the numbers of samples simulated."""
    config, anatomy, stack = layout.config, _read(block.patient.folder, block.patient.identity), layout.stack
    draw = draw_navigations(config, stack.wire, anatomy, block.sequences, devices=len(stack))
    world = layout.world.leaning(config.seed)
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
            motion=block.patient.motion,
            robot=layout.robot,
            ostium_mm=world.ostium_mm,
            seeds=draw.seeds,
            advance=advance,
        )
    store_block(layout, block, draw, trajectory, stopped)


def store_block(
    layout: Layout, block: Block, draw: Draw, trajectory: Trajectory, stopped: Bool[np.ndarray, "n"]
) -> None:
    """Write a block's navigations, one world each: their episodes, then their samples, which mark both as complete."""
    data_path, episodes_path = schema.paths_of_file(layout.output, block.number)
    samples = parquet.sample_table(trajectory, block.first_episode, layout.key)
    for path, table in (
        (episodes_path, parquet.marked_table(_episodes(layout, block, draw, trajectory, stopped), layout.key)),
        (data_path, samples),
    ):
        with writing(path) as partial:
            partial.write_bytes(parquet.parquet_bytes(table))


@lru_cache(maxsize=4)
def _read(folder: Path, identity: str) -> Anatomy:
    """Read an anatomy, kept for the next block; InputError if it is not the one that the dataset was begun with."""
    anatomy = read_anatomy(folder)
    if anatomy.identity != identity:
        raise InputError(f"{folder}: is not the anatomy that the dataset was begun with; restore that anatomy")
    return anatomy


def _episodes(
    layout: Layout, block: Block, draw: Draw, trajectory: Trajectory, stopped: Bool[np.ndarray, "n"]
) -> dict[str, Any]:
    """Return the columns of the episode table; the first seven and the last two are LeRobot's."""
    n, samples = trajectory.valid.shape
    set_up, prefixes = trajectory.set_up, column_prefixes(trajectory.devices)
    whole = [bool(valid.all()) for valid in trajectory.valid]
    episode = block.first_episode + np.arange(n)
    chunk, file = divmod(block.number, schema.FILES_PER_CHUNK)
    return {
        "episode_index": episode,
        "tasks": [[layout.task]] * n,
        "length": np.full(n, samples),
        "dataset_from_index": episode * samples,
        "dataset_to_index": (episode + 1) * samples,
        "data/chunk_index": np.full(n, chunk),
        "data/file_index": np.full(n, file),
        "anatomy": [block.patient.name] * n,
        "anatomy_sha256": [block.patient.identity] * n,
        "sequence": np.array(block.sequences),
        "split": block.splits.tolist(),
        "device": [layout.stack.wire.name] * n,
        "tip_bend_rad": draw.tip_bend_rad,
        "tip_stiffness_factor": draw.tip_stiffness_factor,
        **{f"{prefix}friction": set_up.friction[:, k] for k, prefix in enumerate(prefixes)},
        **{
            f"{prefix}initial_{name}": set_up.initial[:, k, axis]
            for k, prefix in enumerate(prefixes)
            for axis, name in enumerate(("inserted_length_mm", "rotation_rad"))
        },
        **{f"catheter_{k + 1}": [each.name] * n for k, each in enumerate(layout.stack.catheters)},
        "stopped_short": stopped,
        "valid": whole,
        "invalid_reason": ["" if valid else trajectory.why_invalid(world) for world, valid in enumerate(whole)],
        "meta/episodes/chunk_index": np.full(n, chunk),
        "meta/episodes/file_index": np.full(n, file),
    }


Done = Callable[[Block, float], None]  # called with each written block and its processor time, s
Item, Result = TypeVar("Item"), TypeVar("Result")
_CONNECT_TIMEOUT_S = 10  # time limit for a scheduler to answer, s


class _Interrupted(Exception):
    """Ends the threads of an interrupted or failed run."""


def run_locally(layout: Layout, blocks: Sequence[Block], done: Done, advance: Callable[[int], None]) -> None:
    """Write blocks with one thread each, one a core at a time; of fewer blocks the rod core uses the other cores."""
    cores = layout.config.simulator.threads or CORES
    workers = max(1, min(cores, len(blocks)))
    threads = cores // workers
    stop = threading.Event()

    def report(samples: int) -> None:
        if stop.is_set():
            raise _Interrupted
        advance(samples)

    started = time.process_time()
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(write_block, layout, b, threads=threads, advance=report): b for b in blocks}
        try:
            for future in as_completed(futures):
                future.result()
                now = time.process_time()
                done(futures[future], now - started)
                started = now
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_on_cluster(
    work: Callable[[Item], Result], items: Sequence[Item], done: Callable[[Item, Result], None], scheduler: str
) -> None:
    """Do the same work (a module's function, or a `functools.partial` of one) for every item on a Dask cluster's
    workers, which share the folders; a dead one's item goes to another. Raises InputError without `distributed` or a
    scheduler, for another version of endopilot, or where workers keep dying."""
    try:
        import distributed
    except ImportError as error:
        raise InputError("scheduler: needs Dask; install it with pip install 'endopilot[cluster]'") from error
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"scheduler: {scheduler} cannot be reached; check the address, and that `dask scheduler` runs there"
        ) from error
    with client:
        _check_versions(client, scheduler)
        futures = {client.submit(work, item, pure=False, retries=0): item for item in items}
        try:
            for future in distributed.as_completed(futures):
                done(futures[future], future.result())
        except distributed.KilledWorker as error:
            raise InputError(
                f"scheduler: workers of {scheduler} died over the same file several times; give them more memory"
            ) from error
        except BaseException:
            client.cancel(list(futures))
            raise


def _check_versions(client, scheduler: str) -> None:
    try:
        found = client.run(version)
    except Exception as error:  # of any kind, from the worker
        raise InputError(f"scheduler: a worker of {scheduler} has no endopilot ({error}); install it there") from error
    if not found:
        raise InputError(f"scheduler: {scheduler} has no workers; start some with `dask worker {scheduler}`")
    for worker, other in found.items():
        if other != version():
            raise InputError(f"scheduler: worker {worker} has {other}, here is {version()}; install the same")


def write_timed(layout: Layout, block: Block) -> float:
    """Write a block and return the processor time that it took, s."""
    started = time.process_time()
    write_block(layout, block)
    return time.process_time() - started
