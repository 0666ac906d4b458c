"""The same work on several items at once, in several processes: `each`."""

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
"""A volume being processed takes some 1 GB of memory."""


def each(title: str, items: Sequence[Path], work: Callable[[Path], None]) -> dict[Path, InputError]:
    """Do the same work for every item, in as many processes as there are cores, under one progress bar.

    Args:
        title: name of the work, for the progress bar.
        items: files or folders to work on.
        work: a function of a module, or a `functools.partial` of one, since other processes import it.

    Returns:
        The items whose work raised `InputError`, each with its error. Any other exception ends the work and is raised.
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
        # Spawned, since a fork of a process with running threads can deadlock.
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
    """Leave interrupts and progress bars to the parent process, and end when it ends, even if it is killed."""
    silence()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
