"""The same work on several items at once, in several processes: `each`, and the processes themselves: `Workers`."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TypeVar

from endopilot.errors import InputError, Stopped, stop
from endopilot.progress import progress, silence

T = TypeVar("T")
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""Processor cores that this process may use: a batch system may leave it fewer than the machine has."""
MOST_PROCESSES = 8  # a volume being processed takes some 1 GB of memory
TO_CLEAN_UP_S = 5.0  # time that a process which is stopped has to remove its half-written files, s; then it is killed


def each(
    title: str, items: Sequence[Path], work: Callable[[Path], None], pool: Workers | None = None
) -> dict[Path, InputError]:
    """Do the same work (a module's function, or a `functools.partial` of one) for every item, on all cores or in a
    given `pool`, under one progress bar; return the items whose work raised `InputError`, each with its error. Raises
    InputError where a process died."""
    bad: dict[Path, InputError] = {}

    def settle(item: Path, result: Callable[[], None]) -> None:
        try:
            result()
        except InputError as error:
            bad[item] = error

    processes = min(len(items), CORES, MOST_PROCESSES)
    with progress(title, len(items)) as advance:
        if processes <= 1 and pool is None:
            for item in items:
                settle(item, lambda item=item: work(item))
                advance(remark=item.name)
            return bad
        with nullcontext(pool) if pool else Workers(processes) as running:
            futures: dict[Future[None], Path] = {running.submit(work, item): item for item in items}
            try:
                for future in as_completed(futures):
                    settle(futures[future], future.result)
                    advance(remark=futures[future].name)
            except BrokenProcessPool as error:
                raise InputError(
                    f"{title}: a process died, perhaps for want of memory; close other programs and run the same "
                    "command again"
                ) from error
    return bad


class Workers(ProcessPoolExecutor):
    """Processes for importable work that end with this one, however it ends, at once if the block is left by an
    exception; they remove half-written files, which joblib's loky would leave."""

    def __init__(self, processes: int = min(CORES, MOST_PROCESSES)) -> None:
        """Make ready for so many processes; work starts them."""
        # Spawned, since a fork of a process with running threads can deadlock.
        super().__init__(processes, mp_context=multiprocessing.get_context("spawn"), initializer=_follow)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Give them a piece of work."""
        # Processes are started here. A blocked signal stays blocked in them, so that Ctrl-C in a terminal reaches this
        # process alone, however early it comes.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(_work, fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def stop(self) -> None:
        """End the processes, whatever they do; those that do not end in time are killed."""
        running = list((self._processes or {}).values())  # there is no public way to them
        self.shutdown(wait=False, cancel_futures=True)
        for process in running:
            process.terminate()
        end = time.monotonic() + TO_CLEAN_UP_S
        for process in running:
            process.join(max(end - time.monotonic(), 0.0))
            if process.is_alive():
                process.kill()

    def __exit__(self, kind: type[BaseException] | None, *details: Any) -> None:
        """Wait for the work, or stop it after an exception."""
        if kind is None:
            self.shutdown()
        else:
            self.stop()


def _follow() -> None:
    """Leave interrupts and progress bars to the parent process, and end when it ends, even if it is killed."""
    silence()
    gc.disable()  # until the first piece of work is imported, which leaves no garbage
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, stop)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(TO_CLEAN_UP_S)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _work(work: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
    try:
        return work(*args, **kwargs)
    except Stopped as stopped:
        os._exit(stopped.code if isinstance(stopped.code, int) else 1)
