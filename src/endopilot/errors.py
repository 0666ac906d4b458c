"""The one exception that a user is meant to read."""

from __future__ import annotations


class InputError(Exception):
    """Bad input, told in one line that names the file or field, the value found, and the mend.

    The command line prints it without a traceback and leaves with exit code 2. Raise it for anything the
    user can mend; leave other exceptions for defects of endopilot itself.
    """
