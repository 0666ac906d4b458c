"""Simulate the blocks of a dataset on the cores of this machine or on the workers of a Dask cluster."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

from endopilot.dataset.block import write_block
from endopilot.dataset.layout import Block, BlockContext, version
from endopilot.errors import InputError
from endopilot.parallel import CORES

Done = Callable[[Block, float], None]
"""Called with each block that has been written and the processor time that it took, s."""
Item, Result = TypeVar("Item"), TypeVar("Result")
_CONNECT_TIMEOUT_S = 10
"""Time limit for a scheduler to answer, s."""


class _Interrupted(Exception):
    """Ends the threads of an interrupted or failed run."""


def run_locally(context: BlockContext, blocks: Sequence[Block], done: Done, advance: Callable[[int], None]) -> None:
    """Write blocks with one thread each, as many at a time as there are cores.

    Where there are fewer blocks than cores, the rod core uses the remaining cores.
    """
    cores = context.config.simulator.threads or CORES
    workers = max(1, min(cores, len(blocks)))
    threads = cores // workers
    stop = threading.Event()

    def report(samples: int) -> None:
        if stop.is_set():
            raise _Interrupted
        advance(samples)

    started = time.process_time()
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(write_block, context, b, threads=threads, advance=report): b for b in blocks}
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
    """Do the same work for every item on the workers of a Dask cluster, which must have access to the same folders.

    If a worker dies, another one does its item.

    Args:
        work: a function of a module, or a `functools.partial` of one.
        scheduler: address, such as tcp://host:8786.

    Raises:
        InputError: `distributed` is not installed, the scheduler cannot be reached, a worker has another version of
            endopilot or none, or workers keep dying.
    """
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


def write_timed(context: BlockContext, block: Block) -> float:
    """Write a block and return the processor time that it took, s."""
    started = time.process_time()
    write_block(context, block)
    return time.process_time() - started
