"""Which extra of the package brings a library that is not installed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from endopilot.errors import InputError

FOR_DEVELOPERS = ("dev", "docs")  # extras that no command needs


def requirements_of_extras() -> dict[str, tuple[str, ...]]:
    """Return the names of the libraries that each extra brings, as they are imported, from the package's metadata."""
    from importlib import metadata  # slow to import, and only needed here

    found: dict[str, tuple[str, ...]] = {}
    for line in metadata.requires("endopilot") or ():
        parts = re.match(r"([\w.-]+).*\bextra == ['\"]([\w-]+)['\"]", line)
        if parts and parts[1] != "endopilot":  # `all` only repeats the others
            found[parts[2]] = (*found.get(parts[2], ()), _normal(parts[1]))
    return found


def extras_present() -> dict[str, bool]:
    """Return whether every library of each extra is installed; none is imported."""
    from importlib.util import find_spec

    return {
        extra: all(find_spec(library.replace("-", "_")) is not None for library in libraries)
        for extra, libraries in requirements_of_extras().items()
        if extra not in FOR_DEVELOPERS
    }


def what_is_missing(error: ModuleNotFoundError) -> str | None:
    """Return what to install, in one line, where an extra brings the module; None if the error is a defect."""
    module = (error.name or "").partition(".")[0]
    for extra, libraries in requirements_of_extras().items():
        if extra not in FOR_DEVELOPERS and _normal(module) in libraries:
            return f"needs {module}; install it with: pip install 'endopilot[{extra}]'"
    return None


def require_extras(*extras: str) -> None:
    """Raise InputError, which names what is missing, unless some extras are installed: before long work."""
    present = extras_present()
    missing = [extra for extra in extras if not present.get(extra, True)]  # metadata may be older than the sources
    if missing:
        raise InputError(f"needs more libraries; install them with: pip install 'endopilot[{','.join(missing)}]'")


@contextmanager
def extra_named(what: str) -> Iterator[None]:
    """Let a ModuleNotFoundError inside say which extra to install for `what` needs the library."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = what_is_missing(error)
        if missing is None:
            raise
        raise ModuleNotFoundError(f"{what} {missing}", name=error.name) from None


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
