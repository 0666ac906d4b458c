"""Who simulates the blocks of a dataset: the cores of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial

from endopilot.dataset.block import write_block
from endopilot.dataset.study import Block, Plan, version
from endopilot.errors import InputError
from endopilot.parallel import CORES

Done = Callable[[Block, float], None]
"""Called with each block that has been written and the processor time that it took, s."""
_PATIENCE_S = 10
"""Time in which a scheduler must answer, s."""


class _Stopped(Exception):
    """Ends the threads of a run that was interrupted or has failed."""


def work_here(plan: Plan, blocks: Sequence[Block], done: Done, advance: Callable[[int], None]) -> None:
    """Write blocks with one thread each, as many at a time as there are cores.

    Where there are fewer blocks than cores, the rod core has the others.

    Args:
        plan: what all blocks share.
        blocks: what to write.
        done: called after each block.
        advance: called with the number of samples simulated since the last call.
    """
    cores = plan.config.simulator.threads or CORES
    workers = max(1, min(cores, len(blocks)))
    threads = cores // workers
    stop = threading.Event()

    def go_on(samples: int) -> None:
        if stop.is_set():
            raise _Stopped
        advance(samples)

    started = time.process_time()
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(write_block, plan, b, threads=threads, advance=go_on): b for b in blocks}
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


def work_on_cluster(plan: Plan, blocks: Sequence[Block], done: Done, scheduler: str) -> None:
    """Write blocks on the workers of a Dask cluster, which must see the same folders.

    A worker that dies has its block done by another.

    Args:
        plan: what all blocks share.
        blocks: what to write.
        done: called after each block.
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
        client = distributed.Client(scheduler, timeout=_PATIENCE_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"scheduler: {scheduler} cannot be reached; check the address, and that `dask scheduler` runs there"
        ) from error
    with client:
        _check_versions(client, scheduler)
        futures = {client.submit(partial(_timed, plan), block, pure=False, retries=0): block for block in blocks}
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


def _timed(plan: Plan, block: Block) -> float:
    """Write a block and return the processor time that it took, s."""
    started = time.process_time()
    write_block(plan, block)
    return time.process_time() - started
