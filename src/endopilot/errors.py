"""How work ends that does not end well (`InputError`, `Stopped`), and what is said beside a result (`Remark`)."""

from __future__ import annotations

import signal
from collections.abc import Iterable
from importlib.machinery import ExtensionFileLoader
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM)  # signals that stop a command and its worker processes
_LOADING = {each.__code__ for each in (ExtensionFileLoader.create_module, ExtensionFileLoader.exec_module)}
_AGAIN_S = 0.02  # a signal that cannot stop the work where it arrives does so this much later, s: nobody notices


class InputError(Exception):
    """Bad input that the user can correct; the message is one line with the file or field, the value found, and the
    remedy, which the command line prints and exits with code 2. Other exceptions are defects of endopilot itself."""


class Stopped(SystemExit):
    """Ctrl-C or SIGTERM, in a command and its workers; `code` is the exit code, 128 + the signal. No
    `KeyboardInterrupt`: one out of a user's own code was raised by that code. Only the command line catches it."""


def stop(number: int, frame: FrameType | None) -> None:
    """Raise `Stopped` once, as a signal's handler, but not while an extension module loads: VTK's would crash."""
    while frame is not None:
        if frame.f_code in _LOADING:
            return stop_soon(number)
        frame = frame.f_back
    for each in STOPPING:
        signal.signal(each, signal.SIG_IGN)  # nothing interrupts the tidying up
    raise Stopped(128 + number)


def stop_soon(number: int) -> None:
    """Raise `Stopped` in a moment, in the main thread."""
    signal.signal(signal.SIGALRM, lambda _, frame: stop(number, frame))
    signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)


class Remark(UserWarning):
    """A warning of endopilot about a result, in one line: the command line shows it, and no library's warnings."""


def box_text(points: Iterable[Iterable[float]]) -> str:
    """Return the box around positions in mm as messages and notes write it."""
    spans = (f"{min(along):.0f} to {max(along):.0f}" for along in zip(*points, strict=True))
    return ", ".join(f"{axis} {span}" for axis, span in zip("xyz", spans, strict=True)) + " mm"


def place_text(point: Iterable[float]) -> str:
    """Return a position in mm as messages and notes write it."""
    return "(" + ", ".join(f"{value:.1f}" for value in point) + ") mm"
