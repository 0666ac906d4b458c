"""Checks of NIfTI files that ITK does not make: truncated voxels, and voxels without a position in the world.

Offsets are those of the NIfTI-1 and NIfTI-2 headers (https://nifti.nimh.nih.gov).
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from endopilot.errors import InputError

_SPACING_TOLERANCE = 0.01
"""Voxel sizes that a header gives twice may differ by this share: they are written with few digits."""


@dataclass(frozen=True)
class _Layout:
    """Where a header of either version holds what: (format, offset)."""

    bits: tuple[str, int]
    dimensions: tuple[str, int]
    sizes: tuple[str, int]
    offset: tuple[str, int]
    codes: tuple[str, int]
    rows: tuple[str, int]


_NIFTI_1 = _Layout(("h", 72), ("8h", 40), ("8f", 76), ("f", 108), ("2h", 252), ("12f", 280))
_NIFTI_2 = _Layout(("h", 14), ("8q", 16), ("8d", 104), ("q", 168), ("2i", 344), ("12d", 400))


def check_nifti(path: Path) -> None:
    """Refuse a NIfTI file that ends before its voxels do, or that has no orientation.

    Of a truncated file, ITK would fill the rest with whatever is in memory; without sform and qform it would guess.

    Raises:
        InputError: the file is truncated or damaged, has no orientation, or two voxel sizes.
    """
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opener(path, "rb") as stream:
            header = stream.read(540)
            order = "<" if header[:4] in (b"\x5c\x01\0\0", b"\x1c\x02\0\0") else ">"
            layout = _NIFTI_2 if struct.unpack_from(f"{order}i", header)[0] == 540 else _NIFTI_1

            def values(field: tuple[str, int]) -> tuple:
                return struct.unpack_from(order + field[0], header, field[1])

            dimensions, (bits,), (offset,) = values(layout.dimensions), values(layout.bits), values(layout.offset)
            codes, sizes, rows = values(layout.codes), values(layout.sizes), values(layout.rows)
            missing = int(offset) + math.prod(dimensions[1 : 1 + dimensions[0]]) * bits // 8 - len(header)
            while missing > 0 and (chunk := stream.read(1 << 22)):
                missing -= len(chunk)
    except (EOFError, OSError, ValueError, zlib.error, struct.error):
        raise InputError(f"{path}: truncated or damaged; copy or export it again") from None
    if missing > 0:
        raise InputError(f"{path}: truncated or damaged (its voxels are incomplete); copy or export it again")
    if max(codes) <= 0:
        raise InputError(f"{path}: has no orientation (its sform and qform codes are 0); export it with its affine")
    lengths = np.linalg.norm(np.array(rows).reshape(3, 4)[:, :3], axis=0)
    if codes[1] > 0 and not np.allclose(lengths, np.abs(sizes[1:4]), rtol=_SPACING_TOLERANCE):
        raise InputError(
            f"{path}: its affine gives voxels of {_text(lengths)}, its pixdim {_text(np.abs(sizes[1:4]))}; "
            "one of them is wrong: export it again"
        )


def _text(lengths: np.ndarray) -> str:
    return "×".join(f"{length:.3g}" for length in lengths)
