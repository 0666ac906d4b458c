"""Atomic writes, JSON files, content hashes, and the manifest that says how a result was made."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from endopilot import __version__
from endopilot.errors import InputError


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` and rename it to `path` when the block ends without an error.

    The temporary name keeps the suffix of `path`, for writers that choose the format by it. A block that fails
    leaves neither `path` nor the temporary behind.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    partial = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise InputError(f"{path}: the disk is full; free some space and run the same command again") from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EEXIST):
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another output") from error
        raise
    finally:
        if partial.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
        elif partial.exists():
            partial.unlink()


def json_text(content: Any) -> str:
    """Return `content` as indented JSON. Dataclasses, paths and numpy values are understood."""
    return json.dumps(content, indent=2, default=_jsonable, ensure_ascii=False)


def write_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON, whole or not at all."""
    with writing(path) as partial:
        partial.write_text(json_text(content) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; run the command that makes it first") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); make it again") from error


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, as hexadecimal digits."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def input_hash(path: Path, read: Sequence[Path] = ()) -> dict[str, str]:
    """Return the SHA-256 of an input for the manifest.

    Args:
        path: a file, or a folder, all files of which count in order of name.
        read: the files that were read, where `path` is one of several (a header without voxels), or a folder of more.
    """
    path = Path(path)
    parts = sorted(read) or sorted(part for part in path.rglob("*") if part.is_file())
    if path.is_file() and (not read or parts == [path]):
        return {path.name: sha256(path)}
    return {path.name: hashlib.sha256("".join(sha256(part) for part in parts).encode()).hexdigest()}


def manifest(*, config: Any, seed: int | None = None, inputs: Mapping[str, str] | None = None, **facts: Any) -> dict:
    """Return the record that every run writes beside its result.

    Args:
        config: the configuration of the run, a dataclass or a mapping.
        seed: the seed of the run's random streams, if it has any.
        inputs: name of each input file and its SHA-256.
        facts: further entries, such as `wall_seconds` or what was rejected and why.
    """
    packages = ("numpy", "scipy", "SimpleITK", "torch", "pyarrow")
    return {
        "config": asdict(config) if is_dataclass(config) and not isinstance(config, type) else config,
        "seed": seed,
        "inputs": dict(inputs or {}),
        "versions": {"endopilot": __version__, "python": platform.python_version()}
        | {name: _version(name) for name in packages},
        "commit": _commit(),
        "machine": {"processor": processor_name(), "cores": os.cpu_count(), "system": platform.system()},
        **facts,
    }


def processor_name() -> str:
    """Return the processor's model name as the operating system gives it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of the source tree this package runs from, or None for an installed wheel."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        answer = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
