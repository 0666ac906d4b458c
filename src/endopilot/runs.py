"""What a command may write: folders that it claims (`claim`), new files (`check_new`), and what is still missing. It
replaces what the same command wrote from the same inputs and settings, as `run.json` tells, and a file only where
`--overwrite` says so; it never writes over its own input, or into a folder of other things."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.files import PARTIAL, RECORD_FILE, is_empty, json_text, read_json, regular, write_json
from endopilot.parallel import Workers, each

_LONGEST_VALUE = 60


@dataclass(frozen=True)
class Place:
    """What lies at a path that a command takes: an "input", which must be there when the command begins, or a "folder"
    or "file" that is written. A file's name ends in one of `suffixes`, if there are any; those `beside` it are written
    too."""

    of: Literal["input", "folder", "file"]
    suffixes: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def files(self, path: Path) -> list[Path]:
        """Return the files that are written; InputError for a name without the suffix."""
        if self.suffixes and not path.name.lower().endswith(self.suffixes):
            raise InputError(f"{path}: is written as {' or '.join(self.suffixes)}; end the name so")
        return [path, *map(path.with_suffix, self.beside)] if self.of == "file" else []


Existing = Annotated[Path, Place("input")]
OutputFolder = Annotated[Path, Place("folder")]
OutputFile = Annotated[Path, Place("file")]
PNG, CSV = Place("file", (".png",)), Place("file", (".csv",))
Picture, Table = Annotated[Path, PNG], Annotated[Path, CSV]
Page = Annotated[Path, Place("file", (".html",))]


def existing(path: Path) -> Path:
    """Return `path` if a file or a folder is there; InputError if not, or if it may not be looked at."""
    try:
        path.stat()
    except OSError as error:
        raise InputError(f"{path}: {(error.strerror or str(error)).lower()}; check the path") from error
    return regular(path)


def claim(folder: Path, command: str, **identity: Any) -> None:
    """Claim a folder for a run, or check that the run that began in it is the same one; InputError if it is not.

    The first run writes `run.json`: the command, everything that its results follow from, and the version of the
    package unless `identity` has one; a later one may go on only where all that is equal. What a killed run left
    half-written is removed; a folder of `run.json` alone goes to the new run. `identity` is by name: dataclasses, paths
    and numpy values are understood.
    """
    folder = Path(folder)
    now = {"command": command, **identity, "version": identity.get("version", __version__)}
    now = json.loads(json_text(now))  # as a file gives it back, so that it compares equal
    record = folder / RECORD_FILE
    if record.exists():
        before = read_json(record)
        change = next(_changes(before, now), None)
        if change is None:
            remove_partial_files(folder)
            return
        if not is_empty(folder):
            name, then, value = change
            raise InputError(
                f"{folder}: was begun with {name} = {_short(then)}, now it is {_short(value)}; "
                "choose another folder, or remove this one"
            )
    elif folder.is_dir() and not is_empty(folder):
        raise InputError(f"{folder}: is not empty and holds no {RECORD_FILE}; choose another folder")
    write_json(record, now)
    remove_partial_files(folder)


@contextmanager
def claiming(folder: Path, command: str, **identity: Any) -> Iterator[None]:
    """Claim a folder for the block that makes its results; one that fails with none leaves no folder that it made."""
    folder, new = Path(folder), not Path(folder).exists()
    claim(folder, command, **identity)
    try:
        yield
    except BaseException:
        if is_empty(folder):
            (folder / RECORD_FILE).unlink(missing_ok=True)
            if new:
                folder.rmdir()
        raise


def check_new(path: Path, inputs: Sequence[Path] = (), *, overwrite: bool = False) -> None:
    """Raise InputError, before the work, where a file would go over an input, or over another without `overwrite`."""
    if path.is_dir() or not os.path.lexists(path):
        return
    if not overwrite:
        raise InputError(f"{path}: is there already; choose another name, or --overwrite to replace it")
    for source in inputs:
        if path.resolve().is_relative_to(source.resolve()):
            raise InputError(f"{path}: is of the input, {source}; choose another name")


def check_outside(folder: Path, inputs: Sequence[Path]) -> None:
    """Raise InputError where an input lies in, or is, an output folder."""
    for source in inputs:
        if source.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{source}: lies in the output, {folder}; choose another output folder")


def make_missing(title: str, paths: Sequence[Path], make: Callable[[Path], None], pool: Workers | None = None) -> None:
    """Make those result files of a run that are not there yet, on all cores, each by `make`, importable. Raises
    InputError, which names the first, if some could not be made; the others are there."""
    bad = each(title, [path for path in paths if not path.exists()], make, pool)
    if bad:
        path, error = next(iter(bad.items()))
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}")


def _changes(before: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (field, value before, value now) for every value that differs between two nested mappings."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in [*now, *(key for key in before if key not in now)]:
            yield from _changes(before.get(key, "absent"), now.get(key, "absent"), f"{name}.{key}".lstrip("."))
    elif before != now:
        yield name or "its record", before, now


def remove_partial_files(folder: Path) -> None:
    """Remove the half-written files that a process which was killed left in a folder."""
    for path in list(folder.rglob(f"{PARTIAL}[0-9]*-*")):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}…"
