"""Atomic writes, readers of text, JSON and YAML, content hashes, and the manifest that says how a result was made."""

from __future__ import annotations

import codecs
import errno
import hashlib
import io
import json
import os
import platform
import re
import resource
import shutil
import stat
import subprocess
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from endopilot import __version__
from endopilot.errors import InputError

_MIB = 2**20
RECORD_FILE = "run.json"  # says which run a folder belongs to
_LARGEST_JSON, _LARGEST_YAML = 512 * _MIB, _MIB // 4  # of files read whole: long recordings have MiB, settings KiB
_MOST_NODES = 100_000  # values that a YAML file may hold once its aliases are written out
_ENCODINGS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""What a file that begins with these bytes is written in: spreadsheets and shells of Windows begin theirs so."""


_OF_THE_PATH = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST),
    *(errno.ENOTEMPTY, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.EIO, errno.EBUSY),
)
"""Errors that another path mends."""
_FULL = re.compile("no space left|disk quota exceeded|disk is full|file too large", re.IGNORECASE)
"""How libraries say it in exceptions of their own."""
_LEAST_FREE = 64 * 1024  # a disk with fewer free bytes than some file systems' page is full, whatever a library says
PARTIAL = ".part-"  # what the names of files begin with that are not whole yet


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of the same suffix, and rename it when the block ends without an error;
    else nothing is left. Raises InputError where the folder cannot be written, or the disk is full."""
    with _temporary(Path(path)) as partial:
        yield partial
        partial.replace(path)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file whole or not at all; InputError as `writing` has it."""
    with writing(Path(path)) as partial:
        partial.write_bytes(content if isinstance(content, bytes) else content.encode())


@contextmanager
def writing_folder(folder: Path, record: str) -> Iterator[Path]:
    """Yield a temporary folder whose files go into `folder` when the block ends without an error, `record` last, by
    which readers know that it is whole; what else lies there stays. Raises InputError where it cannot be written, or
    holds other things and no run's record."""
    folder = Path(folder).resolve()  # a link stays
    with _temporary(folder) as partial:
        partial.mkdir()
        yield partial
        if not folder.exists():
            partial.replace(folder)
            return
        missing = sorted(path.name for path in partial.iterdir() if not (folder / path.name).exists())
        if missing and not is_empty(folder) and not (folder / RECORD_FILE).exists():
            raise InputError(f"{folder}: is not empty and holds no {missing[0]}; choose another folder")
        (folder / record).unlink(missing_ok=True)
        for path in sorted(partial.iterdir(), key=lambda path: path.name == record):
            path.replace(folder / path.name)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which is gone when the block ends, and say why it cannot be written."""
    if path.name in ("", ".."):
        raise InputError(f"{path}: is no name of a file; choose another output")
    partial = path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
    except InputError as error:
        raise InputError(str(error).replace(str(partial), str(path))) from error
    except Exception as error:
        if (problem := _problem(partial, error)) is None:
            raise
        raise InputError(f"{path}: {problem}") from error
    finally:
        with suppress(OSError):
            if partial.is_dir():
                shutil.rmtree(partial, ignore_errors=True)
            else:
                partial.unlink(missing_ok=True)


def is_empty(folder: Path) -> bool:
    """Return whether a folder holds nothing but the record of the run that it belongs to, and half-written files."""
    return all(path.name == RECORD_FILE or path.name.startswith(PARTIAL) for path in folder.iterdir())


def _problem(partial: Path, error: Exception) -> str | None:
    """Return why a file could not be written and what mends it; None where the error has another reason."""
    number = error.errno if isinstance(error, OSError) else None
    if number in _OF_THE_PATH:
        return f"cannot be written ({os.strerror(number)}); choose another output"
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    sizes = [path.stat().st_size for path in (partial, *partial.rglob("*")) if path.is_file()]
    if number == errno.EFBIG or (0 <= limit <= max(sizes, default=-1)):
        return "is larger than files may be here (ulimit -f); raise the limit, or ask for less"
    try:
        free = shutil.disk_usage(next(parent for parent in partial.parents if parent.is_dir())).free
    except OSError:
        free = _LEAST_FREE
    if number in (errno.ENOSPC, errno.EDQUOT) or free < _LEAST_FREE or _FULL.search(str(error)):
        return "the disk is full; free some space and run the same command again"
    if isinstance(error, UnicodeEncodeError):
        return "its name holds bytes that are no UTF-8; choose another output"
    return f"cannot be written ({error}); choose another output" if isinstance(error, OSError) else None


def regular(path: str | Path) -> Path:
    """Return a path; InputError for a FIFO, a socket or a device, which may have no end."""
    with suppress(OSError, ValueError):  # missing, or no path at all
        if stat.S_IFMT(Path(path).stat().st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
            raise InputError(f"{path}: is a FIFO, a socket or a device; give a file or a folder")
    return Path(path)


def json_text(content: Any, *, indented: bool = True) -> str:
    """Return `content` as JSON, indented or in one line. Dataclasses, paths and numpy values are understood."""
    return json.dumps(content, indent=2 if indented else None, default=_jsonable, ensure_ascii=False)


def write_json(path: Path, content: Any, *, indented: bool = True) -> None:
    """Write `content` as JSON, whole or not at all; indented, or in one line where there is much of it."""
    write_whole(path, json_text(content, indented=indented) + "\n")


def write_yaml(path: Path, content: Any) -> None:
    """Write `content` as YAML in its order, whole or not at all; tuples become lists."""
    write_whole(path, yaml.safe_dump(_lists(content), sort_keys=False, allow_unicode=True))


def _lists(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _lists(each) for name, each in content.items()}
    return [_lists(each) for each in content] if isinstance(content, (list, tuple)) else content


def png_image(image: np.ndarray) -> bytes:
    """Return an image as a PNG file's content: rows and columns of bytes, grey, or red, green and blue. Of a noisy
    image, looking for nothing but runs of equal bytes takes less time and leaves a smaller file."""
    from PIL import Image  # slow to import

    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG", compress_type=zlib.Z_RLE)
    return file.getvalue()


def read_text(path: Path, *, what: str = "text file", largest: int = _LARGEST_YAML) -> str:
    """Return a text file of at most `largest` bytes in UTF-8, or UTF-16 by its mark. Raises InputError, which calls it
    `what`, such as "CSV file", where it is missing, too large, or no text."""
    try:
        with regular(path).open("rb") as stream:
            content = stream.read(largest + 1)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:  # a path with a zero in it is a ValueError
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); give a {what}") from error
    if len(content) > largest:
        raise InputError(f"{path}: is larger than {largest / _MIB:g} MiB, too large for a {what}; check the path")
    encoding = next((name for mark, name in _ENCODINGS if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text in UTF-8; give a {what}, saved as UTF-8") from error
    if "\0" in text:
        raise InputError(f"{path}: is no text (it holds zero bytes); give a {what}")
    return text


def read_json(path: Path, *, keys: Iterable[str] | None = None, mend: str = "make it again") -> Any:
    """Read a JSON file, an object with `keys` if these are given. Raises InputError, which ends with the mend, where it
    is missing, is not JSON, names a key twice, or lacks one."""
    if not Path(path).exists():
        raise InputError(f"{path}: no such file; run the command that makes it first")
    text = read_text(path, what="JSON file", largest=_LARGEST_JSON)
    try:
        content = json.loads(text, object_pairs_hook=_without_doubles)
    except RecursionError as error:
        raise InputError(f"{path}: not valid JSON (it is nested too deeply); {mend}") from error
    except ValueError as error:  # not JSON, a key twice, or a number of thousands of digits
        raise InputError(f"{path}: not valid JSON ({error}); {mend}") from error
    if keys is None:
        return content
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds {_kind(content)} where an object with names belongs; {mend}")
    for key in keys:
        if key not in content:
            raise InputError(f"{path}: {key}: missing; {mend}")
    return content


def read_yaml(path: Path) -> Any:
    """Read a YAML file, whose plain scalars mean what YAML 1.2 has them mean: `3e-1` is a number, `no` and `2024-05-01`
    are text, as are numbers that two versions read differently (`017`, `0o17`, `1_000`, `1:30`). Raises InputError
    where it is missing, not YAML, names a field twice, nests too deeply, or holds over 100 000 values."""
    text = read_text(path, what="YAML file")
    try:
        return yaml.load(text, _YamlLoader)
    except RecursionError as error:
        raise InputError(f"{path}: not valid YAML (it is nested too deeply); correct the file") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{path}: {line}not valid YAML ({problem}); correct the file") from error
    except (ValueError, LookupError) as error:  # a number of thousands of digits, or `!!bool 3`
        raise InputError(f"{path}: not valid YAML ({error}); correct the file") from error


@contextmanager
def reading(path: Path, mend: str) -> Iterator[None]:
    """Answer what the odd content of a damaged file or folder raises in the block with an InputError that names it and
    ends with the mend. It stands around the lines that take a record of ours apart, and around nothing else."""
    try:
        yield
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0] if error.args else 'an entry'}: missing; {mend}") from error
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}; {mend}") from None
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise InputError(
            f"{path}: damaged ({str(error).splitlines()[0] if str(error) else error!r}); {mend}"
        ) from error


@contextmanager
def stored_arrays(path: Path | str, what: str, mend: str) -> Iterator[Any]:
    """Open an .npz file; InputError if it is missing or damaged, or `what` the block takes out of it is not there."""
    damaged = (OSError, ValueError, EOFError, NotImplementedError, BadZipFile, zlib.error)
    try:
        with np.load(regular(path), allow_pickle=False) as stored:
            yield stored
    except (*damaged, KeyError, AttributeError, TypeError) as error:
        raise InputError(f"{path}: no {what} ({error}); {mend}") from None


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, as hexadecimal digits."""
    with regular(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def input_hash(path: Path, read: Sequence[Path] = ()) -> dict[str, str]:
    """Return the SHA-256 of a file, or of a folder's files in order of name; `read` are those that were read."""
    path = Path(path)
    parts = sorted(read) or sorted(part for part in path.rglob("*") if part.is_file())
    if path.is_file() and (not read or parts == [path]):
        return {path.name: sha256(path)}
    return {path.name: hashlib.sha256("".join(sha256(part) for part in parts).encode()).hexdigest()}


def manifest(*, config: Any, seed: int | None = None, inputs: Mapping[str, str] | None = None, **facts: Any) -> dict:
    """Return the record that every run writes beside its result: its configuration, seed, inputs (name and SHA-256),
    and further facts such as `wall_seconds` or what was rejected and why."""
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


class _YamlLoader(yaml.SafeLoader):
    """A safe loader of plain scalars by YAML 1.2, without fields named twice and without endless aliases."""

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None and _written_out(node, {}) > _MOST_NODES:
            raise ComposerError(
                problem=f"its aliases stand for more than {_MOST_NODES} values", problem_mark=node.start_mark
            )
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise ConstructorError(problem=f"{key.value} is given twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_YamlLoader.yaml_implicit_resolvers = {}
_YamlLoader.yaml_constructors = {
    tag: constructor
    for tag, constructor in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag.rpartition(":")[2] in ("null", "bool", "int", "float", "str", "seq", "map")
}
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
    ("merge", r"<<", ["<"]),
):
    _YamlLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"^({_pattern})$"), _first)


def _written_out(node: Any, known: dict[int, int]) -> int:
    """Return how many values a node of YAML stands for; aliases of a node share it."""
    if id(node) not in known:
        known[id(node)] = -1
        inner = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 if isinstance(node, yaml.ScalarNode) else 1 + sum(_written_out(n, known) for n in inner)
    if known[id(node)] < 0:
        raise ComposerError(problem="an alias stands in its own anchor", problem_mark=node.start_mark)
    return known[id(node)]


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{Counter(names).most_common(1)[0][0]} is given twice")
    return content


def _kind(value: Any) -> str:
    kinds = {list: "a list", str: "text", bool: "true or false", type(None): "null", dict: "an object"}
    return kinds.get(type(value), "a number")


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
