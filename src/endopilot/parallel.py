"""The same work on several items at once, one process each: `each`."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path

from endopilot.errors import InputError
from endopilot.progress import progress, silence

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""Processor cores that this process may use: a batch system may leave it fewer than the machine has."""
MOST_PROCESSES = 8
"""A volume under work takes some 1 GB of memory."""


def each(title: str, items: Sequence[Path], work: Callable[[Path], None]) -> dict[Path, InputError]:
    """Do the same work for every item, under one progress bar, on as many processes as there are cores.

    Args:
        title: what is being done.
        items: what it is done to.
        work: a function of a module, or a `functools.partial` of one, since other processes must find it.

    Returns:
        The items whose input was bad, each with what was wrong. Any other exception ends the work and is raised.
    """
    bad: dict[Path, InputError] = {}

    def settle(item: Path, result: Callable[[], None]) -> None:
        try:
            result()
        except InputError as error:
            bad[item] = error

    processes = min(len(items), CORES, MOST_PROCESSES)
    with progress(title, len(items)) as advance:
        if processes <= 1:
            for item in items:
                settle(item, lambda item=item: work(item))
                advance(remark=item.name)
            return bad
        # Started afresh, since a fork of a process with running threads can lock up.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(processes, mp_context=context, initializer=follow_the_parent) as pool:
            futures: dict[Future[None], Path] = {pool.submit(work, item): item for item in items}
            try:
                for future in as_completed(futures):
                    settle(futures[future], future.result)
                    advance(remark=futures[future].name)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in multiprocessing.active_children():
                    process.terminate()
                raise
    return bad


def follow_the_parent() -> None:
    """Leave interrupts and the screen to the parent, and end with it even where it is killed."""
    silence()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
