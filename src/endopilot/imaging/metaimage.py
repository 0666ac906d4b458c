"""MetaImage files with their voxels attached (.mha) or beside them (.mhd).

The format: https://itk.org/Wiki/MetaIO/Documentation. `AnatomicalOrientation` repeats in words what `TransformMatrix`
says in numbers, in ITK's way: RAI are axes that run from right, anterior and inferior, which is LPS.
"""

from __future__ import annotations

from dataclasses import replace
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.imaging.geometry import Fields, Geometry, converted, geometry
from endopilot.imaging.segments import ImageFile
from endopilot.imaging.voxels import Encoding, read_voxels_beside

_LONGEST_LINE = 1 << 16
_MOST_LINES = 1000
_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
_SYNONYMS = {
    **dict.fromkeys(("Orientation", "Rotation"), "TransformMatrix"),
    **dict.fromkeys(("Origin", "Position"), "Offset"),
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}
_FIELDS = Fields("TransformMatrix", "ElementSpacing", "Offset")
_FROM = ("RL", "AP", "IS")
"""Letters of `AnatomicalOrientation` along x, y and z of LPS: where an axis along it begins, and one against it."""


def read_metaimage(path: Path) -> ImageFile:
    """Read a MetaImage file.

    Raises:
        InputError: the file is damaged, holds no grey levels or labels, or does not say where they are.
    """
    with path.open("rb") as stream:
        fields = _header(stream, path)
        size = _size(fields, path)
        place = _geometry(fields, size, path)
        encoding = _encoding(fields, path)
        source = fields["ElementDataFile"]
        beside = None if source.upper() == "LOCAL" else source
        voxels, files = read_voxels_beside(beside, stream, encoding, size[::-1], header=path)
    return ImageFile(place.volume(voxels, files), voxels[None])


def _header(stream: BufferedIOBase, path: Path) -> dict[str, str]:
    """Return the fields of a header, and leave the stream at the byte after it."""
    fields: dict[str, str] = {}
    for _ in range(_MOST_LINES):
        line = stream.readline(_LONGEST_LINE)
        name, sign, value = line.decode("utf-8", errors="replace").partition("=")
        name = _SYNONYMS.get(name.strip(), name.strip())
        if line and not line.strip():
            continue
        if not fields and not (sign and name.isidentifier()):
            raise InputError(
                f"{path}: its content does not match its suffix, or its header is damaged; export it again"
            )
        if not sign or not name or name in fields:
            raise InputError(f"{path}: its header is damaged ({name[:40]!r} is no field of its own); export it again")
        fields[name] = value.strip()
        if name == "ElementDataFile":
            if fields[name].split()[:1] == ["LIST"]:
                rest = stream.read().decode("utf-8", errors="replace").split("\n")
                fields[name] = "LIST\n" + "\n".join(part.strip() for part in rest if part.strip())
            return fields
    raise InputError(f"{path}: truncated or damaged (its header does not end); copy or export it again")


def _size(fields: dict[str, str], path: Path) -> tuple[int, int, int]:
    """Return the numbers of voxels along i, j and k."""
    try:
        extents = [int(word) for word in fields.get("DimSize", "").split()]
        count, channels = int(fields.get("NDims", "")), int(fields.get("ElementNumberOfChannels", "1"))
    except ValueError:
        extents, count, channels = [], 0, 1
    if not extents or count != len(extents) or min(extents) < 1:
        raise InputError(f"{path}: its NDims and DimSize describe no image; export it again")
    if channels != 1:
        raise InputError(f"{path}: {channels} values in every voxel (colour or vectors); give a grey-level volume")
    shape = "×".join(map(str, extents))
    if any(extent > 1 for extent in extents[3:]):
        raise InputError(f"{path}: {count}-D ({shape}); give a single 3-D volume, such as one cardiac phase")
    if count < 3:
        raise InputError(f"{path}: {shape} voxels are no volume; give a 3-D volume")
    return extents[0], extents[1], extents[2]


def _encoding(fields: dict[str, str], path: Path) -> Encoding:
    kind = fields.get("ElementType", "")
    if kind not in _TYPES:
        raise InputError(f"{path}: ElementType {kind[:40]!r} holds no grey levels; export it as MET_SHORT or MET_FLOAT")
    binary, packed = _truth(fields, "BinaryData", True, path), _truth(fields, "CompressedData", False, path)
    big = _truth(fields, "BinaryDataByteOrderMSB", False, path)
    skipped = fields.get("HeaderSize", "0")
    if not skipped.removeprefix("-").isdecimal() or int(skipped) < -1:
        raise InputError(f"{path}: HeaderSize {skipped[:20]!r} is no number of bytes; export it again")
    packing = "ascii" if not binary else "zlib" if packed else "raw"
    return Encoding(np.dtype((">" if big else "<") + _TYPES[kind]), packing, skipped_bytes=int(skipped))


def _truth(fields: dict[str, str], name: str, default: bool, path: Path) -> bool:
    text = fields.get(name, str(default))
    if text[:1].upper() not in ("T", "F", "1", "0"):
        raise InputError(f"{path}: {name} {text[:20]!r} is neither True nor False; export it again")
    return text[:1].upper() in ("T", "1")


def _numbers(fields: dict[str, str], name: str, count: int, path: Path) -> Float[np.ndarray, "_"]:
    try:
        numbers = np.array(fields[name].split(), dtype=float)
    except ValueError:
        numbers = np.array([])
    if len(numbers) != count:
        raise InputError(f"{path}: {name} {fields[name][:80]!r} is not {count} numbers; export it again")
    return numbers


def _geometry(fields: dict[str, str], size: tuple[int, int, int], path: Path) -> Geometry:
    count = int(fields["NDims"])
    if "ElementSpacing" not in fields:
        raise InputError(f"{path}: has no ElementSpacing, so that its voxels have no size; export it again")
    spacing = _numbers(fields, "ElementSpacing", count, path)[:3]
    factor, notes = converted(fields.get("DistanceUnits", "mm"), spacing, path=path, field="DistanceUnits")
    sizes = _numbers(fields, "ElementSize", count, path)[:3] if "ElementSize" in fields else spacing
    if not np.allclose(sizes, spacing, rtol=1e-2):
        notes += (f"{path.name}: ElementSize differs from ElementSpacing; voxels lie where ElementSpacing puts them",)
    origin = np.zeros(3)
    if "Offset" in fields:
        origin = _numbers(fields, "Offset", count, path)[:3]
    else:
        notes += (f"{path.name}: has no Offset; its first voxel was put at 0 0 0",)
    words = fields.get("AnatomicalOrientation", "").strip().upper()
    named = _named_axes(words)
    if "TransformMatrix" in fields:
        # Its rows are the directions of i, j and k.
        direction = _numbers(fields, "TransformMatrix", count * count, path).reshape(count, count)[:3, :3].T
    elif named is not None:
        direction = named
        notes += (f"{path.name}: has no TransformMatrix; its axes are those of AnatomicalOrientation {words}",)
    else:
        direction = np.eye(3)
        notes += (f"{path.name}: has no TransformMatrix; its axes were taken as left, posterior and superior",)
    place = geometry(direction, spacing * factor, origin * factor, size, path=path, fields=_FIELDS)
    if named is not None and np.any(np.sum(named * place.direction, axis=0) < 0.5):
        notes += (
            f"{path.name}: AnatomicalOrientation {words} contradicts TransformMatrix; voxels lie where TransformMatrix "
            "puts them",
        )
    return replace(place, notes=(*notes, *place.notes))


def _named_axes(words: str) -> Float[np.ndarray, "3 3"] | None:
    """Return the axes that three letters name, as columns; None where they name none."""
    axes = np.zeros((3, 3))
    for column, letter in enumerate(words[:3]):
        for row, pair in enumerate(_FROM):
            if letter in pair:
                axes[row, column] = 1.0 if letter == pair[0] else -1.0
    return axes if len(words) == 3 and abs(np.linalg.det(axes)) > 0.5 else None
