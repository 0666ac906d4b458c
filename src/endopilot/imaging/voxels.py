"""The voxels of image files: from bytes, packed or plain, to an array, by no library that looks for files of other
names beside the one given. A file holds exactly the bytes that its header describes, or it is damaged."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from endopilot.errors import InputError
from endopilot.imaging.geometry import require

_GZIP = b"\x1f\x8b"


def unpacked(content: bytes, path: Path, *, packed: bool | None = None) -> bytes:
    """Return bytes that were packed by gzip or zlib, or by default those that look as if gzip had packed them."""
    if packed is None:
        packed = content.startswith(_GZIP)
    result, left = bytearray(), content
    try:
        while packed and left:  # gzip's members follow one another
            unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)  # 32: a header of gzip or of zlib
            result += unpacker.decompress(left)
            require(unpacker.eof, path, "truncated or damaged (its end is missing); copy or export it again")
            left = unpacker.unused_data.lstrip(b"\0")
    except zlib.error:
        raise InputError(f"{path}: truncated or damaged; copy or export it again") from None
    return bytes(result) if packed else content


def array_of(content: bytes, dtype: np.dtype, shape: Sequence[int], path: Path) -> Shaped[np.ndarray, "..."]:
    """Return the array of a shape, the last axis the fastest, that bytes are; `path` is for messages. Raises InputError
    for fewer or more bytes: a header's size alone allocates nothing."""
    size = math.prod(int(extent) for extent in shape) * dtype.itemsize
    missing = "truncated or damaged (its voxels are incomplete); copy or export it again"
    require(len(content) >= size, path, missing)
    more = f"holds more than the {size} bytes of voxels that its header describes; export it again"
    require(len(content) == size, path, more)
    return np.frombuffer(content, dtype=dtype).reshape(tuple(shape)).astype(dtype.newbyteorder("="))


def read_voxels_beside(
    spec: str | None, rest: bytes, dtype: np.dtype, shape: Sequence[int], *, packed: bool, header: Path
) -> tuple[Shaped[np.ndarray, "..."], tuple[Path, ...]]:
    """Return the array (last axis fastest) of a text header, of the bytes behind it (`spec` None) or of the file beside
    it that `spec` names, and all files. Raises InputError where that is missing or damaged."""
    files = (header,)
    if spec is not None:
        several = "%" in spec or spec.split()[:1] == ["LIST"]
        require(not several, header, "its voxels are in several files; export it as one file")
        file = header.parent / spec
        missing = f"the file of voxels that it names is missing ({file.name}); put it beside it"
        require(file.is_file(), header, missing)
        files, rest = (header, file), file.read_bytes()
    return array_of(unpacked(rest, files[-1], packed=packed), dtype, shape, files[-1]), files


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


def dilated(mask: Bool[np.ndarray, "nz ny nx"], reach: int | Sequence[int]) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the voxels whose box of `reach` voxels to either side (along k, j, i, or one for all) holds any of a mask:
    a box grown to one size is shifted by that size, in a fourth of the time of SciPy's maximum filter."""
    grown = mask
    for axis, least in enumerate(np.broadcast_to(reach, 3).tolist()):
        held, done = np.moveaxis(grown, axis, 0), 0
        while done < least:
            step = min(2 * done + 1, least - done)
            wider = held.copy(order="K")
            wider[step:] |= held[:-step]
            wider[:-step] |= held[step:]
            wider[:step] |= held[0]
            wider[-step:] |= held[-1]
            held, done = wider, done + step
        grown = np.moveaxis(held, 0, axis)
    return grown
