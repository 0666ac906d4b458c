"""`InputError`, the exception for what a user can correct."""

from __future__ import annotations


class InputError(Exception):
    """Bad input; the message is one line that names the file or field, the value found, and the remedy.

    The command line prints the message without a traceback and exits with code 2. Raise it for anything that the
    user can correct. Other exceptions are defects of endopilot itself.
    """


class Remark(UserWarning):
    """A warning of endopilot about a result, in one line: the command line shows it, and no library's warnings."""
