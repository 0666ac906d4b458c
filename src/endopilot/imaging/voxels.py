"""The voxels of image files: from bytes, packed or plain, to an array, by no library that looks for files of other
names beside the one given. A file holds exactly the bytes that its header describes, or it is damaged."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Sequence
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from endopilot.errors import InputError

_GZIP = b"\x1f\x8b"


def opened(path: Path) -> BufferedIOBase:
    """Open a file that may be packed by gzip, whatever its name says."""
    with path.open("rb") as stream:
        packed = stream.read(2) == _GZIP
    return gzip.open(path, "rb") if packed else path.open("rb")


def read_voxels(
    stream: BufferedIOBase, dtype: np.dtype, shape: Sequence[int], *, packed: bool = False, path: Path
) -> Shaped[np.ndarray, "..."]:
    """Return the array of a shape, the last axis the fastest, that a stream holds from here to its end, raw or `packed`
    by gzip or zlib; `path` is for messages. Raises InputError for fewer or more bytes, or damaged ones."""
    size = math.prod(int(extent) for extent in shape) * dtype.itemsize
    try:
        content = _unpacked(stream, size + 1) if packed else _read(stream, size + 1)
    except (EOFError, OSError, ValueError, OverflowError, MemoryError, zlib.error):
        raise InputError(f"{path}: truncated or damaged (its voxels); copy or export it again") from None
    if len(content) < size:
        raise InputError(f"{path}: truncated or damaged (its voxels are incomplete); copy or export it again")
    if len(content) > size:
        raise InputError(
            f"{path}: holds more than the {size} bytes of voxels that its header describes; export it again"
        )
    return np.frombuffer(content, dtype=dtype).reshape(tuple(shape)).astype(dtype.newbyteorder("="))


def _read(stream: BufferedIOBase, most: int) -> bytearray:
    """Return the rest of a stream, or its first `most` bytes: a header's size alone allocates nothing."""
    content = bytearray()
    while len(content) < most and (part := stream.read(1 << 24)):
        content += part
    return content[:most]


def _unpacked(stream: BufferedIOBase, most: int) -> bytearray:
    packed, content = stream.read(), bytearray()
    while packed and len(content) < most:  # gzip's members follow one another
        unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)  # 32: a header of gzip or of zlib
        content += unpacker.decompress(packed, most - len(content))
        if not unpacker.eof and len(content) < most:
            raise EOFError("cut short")
        packed = unpacker.unused_data.lstrip(b"\0")
    return content


def read_voxels_beside(
    spec: str | None, stream: BufferedIOBase, dtype: np.dtype, shape: Sequence[int], *, packed: bool, header: Path
) -> tuple[Shaped[np.ndarray, "..."], tuple[Path, ...]]:
    """Return the array (last axis fastest) of a text header, at its stream's end (`spec` None) or in the file beside
    it that `spec` names, and all files. Raises InputError where that is missing or damaged."""
    if spec is None:
        return read_voxels(stream, dtype, shape, packed=packed, path=header), (header,)
    if "%" in spec or spec.split()[:1] == ["LIST"]:
        raise InputError(f"{header}: its voxels are in several files; export it as one file")
    file = header.parent / spec
    if not file.is_file():
        raise InputError(f"{header}: the file of voxels that it names is missing ({file.name}); put it beside it")
    with file.open("rb") as content:
        return read_voxels(content, dtype, shape, packed=packed, path=file), (header, file)


def rescaled(values: Shaped[np.ndarray, "..."], slope: float, intercept: float) -> Shaped[np.ndarray, "..."]:
    """Return slope × values + intercept: whole numbers stay whole where both factors are."""
    if slope == 1.0 and intercept == 0.0:
        return values
    whole = values.dtype.kind in "iu" and values.dtype.itemsize <= 2
    if whole and slope.is_integer() and intercept.is_integer() and max(abs(slope), abs(intercept)) < 2**14:
        return values.astype(np.int32) * np.int32(slope) + np.int32(intercept)
    kind = np.float32 if values.dtype.itemsize <= 2 or values.dtype == np.float32 else np.float64
    return values.astype(kind) * kind(slope) + kind(intercept)


def compact(values: Shaped[np.ndarray, "nz ny nx"]) -> Shaped[np.ndarray, "nz ny nx"]:
    """Return whole numbers that fit as int16, all others as float32."""
    if values.dtype == np.int16:
        return values
    limits = np.iinfo(np.int16)
    whole = values.dtype.kind in "iu" and values.min() >= limits.min and values.max() <= limits.max
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite, and is refused as such
        return values.astype(np.int16 if whole else np.float32)
