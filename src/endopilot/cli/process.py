"""How a command runs and ends as a process: its signals, what reaches the screen, and its exit code.

Whatever happens, a command ends in one line on standard error, and its exit code says how.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import logging
import os
import re
import resource
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from endopilot.errors import STOPPING, InputError, Remark, Stopped, stop, stop_soon
from endopilot.extras import what_is_missing

EXIT_FAILED = 1  # a figure misses its bar
EXIT_BAD_INPUT = 2
EXIT_DEFECT = 70
EXIT_INTERRUPTED = 128 + signal.SIGINT
EXIT_UNREAD = 141
TO_END_S = 10.0  # time in which a command that is stopped tidies up, s; then it leaves
LEAST_MEMORY = 2**30
"""Address space, bytes, that the libraries of a command take: `endopilot anatomy` of the smallest mask maps 1.0 GB. In
less, OpenBLAS hangs or ends the process while it is loaded."""
_OUT_OF_MEMORY = re.compile(
    "out of memory|allocate memory|bad.?alloc(ation)?|maximum allowed (size|dimension) exceeded|failed to map segment"
    "|can't start new thread|launch worker thread|NULL without setting an exception",
    re.IGNORECASE,
)
"""How libraries, the loader of libraries and Python say it in exceptions of several kinds."""
_FULL = (errno.ENOSPC, errno.EDQUOT)


def carry_out(name: str, work: Callable[[], int | None]) -> int:
    """Do the work of a command and return its exit code: the one that the work returns, 0 if none."""
    with _signals() as arrived, _remarks(name):
        try:
            code = work() or 0
            sys.stdout.flush()
            return code
        except BaseException as error:
            if arrived or isinstance(error, Stopped):  # whatever a library that was interrupted made of it
                code = 128 + arrived[0] if arrived else int(str(error.args[0]))  # it came before the block began
                return _say(name, "interrupted" if code == EXIT_INTERRUPTED else "terminated", code)
            try:
                return _end(name, error)
            except MemoryError as again:
                return _end(name, again)


def check_memory_limit() -> None:
    """Raise InputError, before libraries are loaded, if the shell does not leave the memory for them (`ulimit -v`)."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 <= limit < LEAST_MEMORY:
        raise InputError(
            f"memory: limited to {limit / 2**30:.2g} GiB by `ulimit -v`, and the libraries alone take "
            f"{LEAST_MEMORY / 2**30:g} GiB; raise the limit"
        )


def own_streams() -> None:
    """Keep standard error for our own lines and standard output for results, in a process that runs one command.
    Libraries in C++ (VTK, ITK, Mesa, libtorch), logs and worker processes write to the file descriptors. What they
    write to standard error is kept for the record of a defect; what they write to standard output goes to standard
    error."""
    sys.stdout.flush()
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = os.fdopen(
            os.dup(number),
            "w",
            buffering=1 if number == 2 or os.isatty(number) else -1,
            encoding=getattr(sys, name).encoding,
            errors="backslashreplace",  # which JSON understands
        )
        setattr(sys, name, stream)
    os.dup2(sys.stderr.fileno(), 1)
    with tempfile.TemporaryFile() as kept:
        os.dup2(kept.fileno(), 2)
    logging.getLogger().addHandler(logging.StreamHandler(sys.__stderr__))
    threading.excepthook = lambda found: _end("", found.exc_value or found.exc_type())


def leave(code: int) -> None:
    """End the process, at once if it was stopped or a signal still comes: threads that work are not waited for."""
    for number in STOPPING:
        signal.signal(number, lambda *_: os._exit(code))  # the result is there
        atexit.register(signal.signal, number, signal.SIG_IGN)
    sys.stdout.flush()
    if code in [128 + number for number in STOPPING]:
        os._exit(code)
    sys.exit(code)


def one_line(text: str) -> str:
    """Return a text with its line breaks, other control characters, and bytes that are no UTF-8 escaped."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]", lambda found: ascii(found[0])[1:-1], text.strip())


def _say(name: str, line: str, code: int) -> int:
    print(f"endopilot {name}: {one_line(line)}" if name else f"endopilot: {one_line(line)}", file=sys.stderr)
    return code


def _end(name: str, error: BaseException) -> int:
    """Say in one line why a command ends by an exception, and return the exit code."""
    if isinstance(error, KeyboardInterrupt):
        return _say(name, "interrupted", EXIT_INTERRUPTED)
    if isinstance(error, BrokenPipeError):  # the reader has closed the output, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to flush into
        return EXIT_UNREAD
    if reason := _mendable(error):
        return _say(name, reason, EXIT_BAD_INPUT)
    from endopilot.plugins import described

    return _say(
        name, f"a defect of endopilot ({described(error)}); please report it with {_record(error)}", EXIT_DEFECT
    )


def _mendable(error: BaseException) -> str | None:
    """Return what happened and what the user can do about it; None if the error is a defect."""
    text = " ".join(str(error).split())
    if _for_want_of_memory(error):
        size = re.search(r"allocate ([\d.]+ \w+)", text)
        what = f"{size[1]} of memory are asked for" if size else "the memory is used up"
        return f"{what}, more than there is; ask for less at once: fewer, shorter or coarser"
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        return what_is_missing(error)
    if isinstance(error, RuntimeError) and text.startswith("Symlink loop"):  # as pathlib has it
        return f"{text}; check the path"
    if isinstance(error, OSError) and error.errno in _FULL:
        return "the disk is full; free some space and run the same command again"
    if isinstance(error, OSError) and error.errno is not None:
        place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return f"{place}{error.strerror or text}; check the path and its permissions"
    return None


def _for_want_of_memory(error: BaseException | None) -> bool:
    """Return whether memory was used up, whatever was made of that on the way."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        if not isinstance(error, InputError) and _OUT_OF_MEMORY.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _record(error: BaseException) -> str:
    """Write a defect's traceback, and what libraries wrote to standard error, into a file, and return its path."""
    kept = b""
    with contextlib.suppress(OSError):
        kept = os.pread(2, 1 << 20, 0)  # a file after `own_streams`
    with tempfile.NamedTemporaryFile(prefix="endopilot-defect-", suffix=".txt", delete=False) as file:
        file.write("".join(traceback.format_exception(error)).encode(errors="backslashreplace") + kept)
    return file.name


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Let Ctrl-C and SIGTERM raise `Stopped` once inside the block; yields the list that takes the signal's number."""
    arrived: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield arrived
        return
    last = threading.Timer(TO_END_S, lambda: os._exit(128 + arrived[0]))
    last.daemon = True

    def arrive(number: int, frame: FrameType | None) -> None:
        if not arrived:
            arrived.append(number)
            last.start()
        stop(number, frame)

    def swallowed(found: Any) -> None:
        """Stop again where the first time fell into a destructor or a callback, which cannot raise."""
        if isinstance(found.exc_value, Stopped):
            stop_soon(arrived[0])

    before = {number: signal.signal(number, arrive) for number in STOPPING}
    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    try:
        yield arrived
    finally:
        last.cancel()
        if arrived:
            signal.setitimer(signal.ITIMER_REAL, 0)  # of `stop_soon`; the work has ended
        else:
            for number, handler in before.items():
                signal.signal(number, handler)
        sys.unraisablehook = hook


@contextlib.contextmanager
def _remarks(name: str) -> Iterator[None]:
    """Show our own warnings in one line each; those of libraries go where their other lines go."""
    with warnings.catch_warnings():

        def show(message: Warning | str, category: type[Warning], *where: Any, **_: Any) -> None:
            if issubclass(category, Remark):
                _say(name, str(message), 0)
            elif sys.__stderr__ is not None:
                print(warnings.formatwarning(message, category, *where[:2]), end="", file=sys.__stderr__)

        warnings.showwarning = show
        yield
