"""How work ends that does not end well (`InputError`, `Stopped`), and what is said beside a result (`Remark`)."""

from __future__ import annotations

from collections.abc import Iterable


class InputError(Exception):
    """Bad input; the message is one line that names the file or field, the value found, and the remedy.

    The command line prints the message without a traceback and exits with code 2. Raise it for anything that the
    user can correct. Other exceptions are defects of endopilot itself.
    """


class Stopped(SystemExit):
    """Ctrl-C or SIGTERM, in a command and in its worker processes; `code` is the exit code, 128 + the signal.

    It is no `KeyboardInterrupt`: one of those that comes out of a user's own code was raised by that code. Nothing but
    the command line catches it.
    """


class Remark(UserWarning):
    """A warning of endopilot about a result, in one line: the command line shows it, and no library's warnings."""


def place_text(point: Iterable[float]) -> str:
    """Return a position in mm as messages and notes write it."""
    return "(" + ", ".join(f"{value:.1f}" for value in point) + ") mm"
