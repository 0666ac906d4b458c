"""An environment of its own for each judge: a virtual environment that is made once and kept."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from endopilot.progress import progress


class CannotInstall(Exception):
    """A judge's environment cannot be made here; the message says why, in one line."""


def environment(name: str, packages: tuple[str, ...], folder: Path, *, newest: bool = False) -> Path:
    """Return the Python of an environment that holds some packages, made if it is not there yet.

    Args:
        name: of the judge.
        packages: what pip installs.
        folder: where environments are kept.
        newest: take the newest Python that is here, for wheels that are not made for this one.

    Raises:
        CannotInstall: pip says no.
    """
    root = folder / name
    python = root / "bin" / "python"
    if (root / "complete").exists():
        return python
    shutil.rmtree(root, ignore_errors=True)
    base = next(filter(None, map(_found, ("3.14", "3.13", "3.12"))), sys.executable) if newest else sys.executable
    with progress(f"Installing {name}", 1) as advance:
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q"]
        for command in ([base, "-m", "venv", "--without-pip", str(root)], [*pip, *packages]):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or ["pip failed"]
                raise CannotInstall(f"{' '.join(packages)} for {base}: {lines[-1]}")
        advance()
    (root / "complete").touch()
    return python


def _found(version: str) -> str | None:
    """Return a Python of some version that runs, on the path or among pyenv's."""
    kept = sorted((Path.home() / ".pyenv" / "versions").glob(f"{version}.*/bin/python"))
    for python in filter(None, (shutil.which(f"python{version}"), *map(str, kept))):
        if subprocess.run([python, "-c", "import venv"], capture_output=True, check=False).returncode == 0:
            return python
    return None
