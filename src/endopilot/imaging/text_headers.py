"""Images with a text header: NRRD (.nrrd, .nhdr; https://teem.sourceforge.net/nrrd/format.html), Slicer's segmentations
(.seg.nrrd), whose header names each segment's layer and value, and MetaImage (.mha, .mhd;
https://itk.org/Wiki/MetaIO/Documentation), where RAI are axes from right, anterior and inferior, which is LPS."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from endopilot.errors import InputError
from endopilot.imaging.geometry import Fields, Geometry, geometry, parted, require
from endopilot.imaging.segments import ImageFile, Segment
from endopilot.imaging.voxels import read_voxels_beside

_LONGEST_HEADER = 1 << 20
_NOT_SUCH = "its content does not match its suffix, or its header is damaged; export it again"
_NO_END = "truncated or damaged (its header does not end); copy or export it again"
_SPACES = {
    **dict.fromkeys(("right-anterior-superior", "ras"), (-1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (1.0, 1.0, 1.0)),
}
"""The patient's axes that NRRD defines, and the signs that turn them to LPS."""

_NRRD_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(
        ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"), "i8"
    ),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
_PACKED = {"raw": False, "gzip": True, "gz": True}
_NRRD_SYNONYMS = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"}
_NRRD_FIELDS = Fields("space directions", "space directions", "space origin")

_LONGEST_LINE = 1 << 16
_MOST_LINES = 1000
_META_TYPES = {
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
_META_SYNONYMS = {
    **dict.fromkeys(("Orientation", "Rotation"), "TransformMatrix"),
    **dict.fromkeys(("Origin", "Position"), "Offset"),
    "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
}
_META_FIELDS = Fields("TransformMatrix", "ElementSpacing", "Offset")


def read_nrrd(path: Path) -> ImageFile:
    """Read an NRRD file. Raises InputError if it is damaged, holds no grey levels or labels, or tells no place."""
    with path.open("rb") as stream:
        fields, keys = _nrrd_header(stream, path)
        sizes, vectors = _axes(fields, path)
        domain = [axis for axis, vector in enumerate(vectors) if vector is not None]
        place = _nrrd_geometry(fields, vectors, tuple(sizes[axis] for axis in domain), path)
        segments = _segments(keys, path)
        extra = [axis for axis in range(len(sizes)) if axis not in domain]
        count = int(np.prod([sizes[axis] for axis in extra], dtype=float))
        kinds = dict(enumerate(fields.get("kinds", "").lower().split()))
        lasting = len(extra) > 1 or any(kinds.get(axis) in ("list", "time") for axis in extra)
        what = f"{len(sizes)}-D ({'×'.join(map(str, sizes))}); give one 3-D volume, such as one cardiac phase"
        what = what if lasting else f"{count} values in every voxel (colour or vectors); give a grey-level volume"
        require(count <= 1 or segments, path, what)
        values, files = _values(fields, sizes, stream.read(), path)
    # The first axis of the file is the fastest, and so the last of the array.
    order = [len(sizes) - 1 - axis for axis in (*extra, *reversed(domain))]
    layers = values.transpose(order).reshape(count, *(sizes[axis] for axis in reversed(domain)))
    return ImageFile(place.volume(layers[0], files), layers, segments)


def _nrrd_header(stream: BufferedIOBase, path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return fields and keys of a header, and leave the stream at the byte after its empty line."""
    require(re.fullmatch(rb"NRRD000[1-5]\r?\n", stream.readline(12)), path, _NOT_SUCH)
    fields: dict[str, str] = {}
    keys: dict[str, str] = {}
    while line := stream.readline(_LONGEST_HEADER):
        text = line.decode("utf-8", errors="replace").rstrip("\r\n")
        if not text:
            return fields, keys
        if text.startswith("#"):
            continue
        key, sign, value = text.partition(":=")
        field, colon, description = text.partition(": ")
        if sign and len(key) < len(field):
            keys[key] = value
            continue
        name = field.strip().lower()
        name = _NRRD_SYNONYMS.get(name, name)
        damaged = f"its header is damaged ({text[:60]!r} is no field of its own); export it again"
        require(colon and name and name not in fields, path, damaged)
        fields[name] = description.strip()
        if name == "data file" and fields[name].split()[:1] == ["LIST"]:
            return fields, keys
    require("data file" in fields, path, _NO_END)
    return fields, keys


def _axes(fields: dict[str, str], path: Path) -> tuple[list[int], list[Float[np.ndarray, "3"] | None]]:
    """Return the size of every axis and the step along each, None but for three that run through space."""
    try:
        sizes = [int(word) for word in fields.get("sizes", "").split()]
        dimension = int(fields.get("dimension", ""))
    except ValueError:
        sizes, dimension = [], 0
    whole = dimension == len(sizes) and min(sizes, default=0) >= 1
    require(whole, path, "its dimension and sizes describe no image; export it again")
    nowhere = "has no orientation (no space in its header); export it with its space directions"
    require("space" in fields, path, nowhere)
    text = fields.get("space directions", "")
    words = re.findall(r"none|\([^()]*\)", text)
    vectors = [None if word == "none" else _vector(word, "space directions", path) for word in words]
    one_each = len(words) == len(sizes) and not re.sub(r"none|\([^()]*\)", "", text).strip()
    require(one_each, path, f"space directions {text[:80]!r} are not one vector an axis; export it again")
    count = sum(vector is not None for vector in vectors)
    flat = f"{'×'.join(map(str, sizes))} voxels with {count} axes in space are no volume; give a 3-D volume"
    require(count == 3, path, flat)
    return sizes, vectors


def _nrrd_geometry(
    fields: dict[str, str], vectors: list[Float[np.ndarray, "3"] | None], size: tuple[int, ...], path: Path
) -> Geometry:
    space = fields["space"]
    where = f"space {space[:40]!r} does not say where the patient's left, back and head are"
    require(space.lower() in _SPACES, path, f"{where}; export it in left-posterior-superior")
    to_lps = np.array(_SPACES[space.lower()])
    nowhere = "has no place (no space origin in its header); export it with its space origin"
    require("space origin" in fields, path, nowhere)
    origin = _vector(fields["space origin"], "space origin", path)
    steps = np.array([vector for vector in vectors if vector is not None]).T
    units = fields.get("space units", "").lower()
    in_mm = set(re.findall(r'"([^"]*)"', units)) <= {"", "mm"} and ("space units" not in fields or '"' in units)
    require(in_mm, path, f"space units {units[:60]!r} are not mm; export it in mm")
    lengths = np.linalg.norm(steps, axis=0)
    along = zip(fields.get("spacings", "").split(), vectors, strict=False)
    given = [word for word, vector in along if vector is not None and word.lower() != "nan"]
    same = not given or np.allclose(_numbers(given, 3, "spacings", path), lengths, rtol=1e-2)
    require(same, path, f"spacings {' '.join(given)} contradict space directions; export it again")
    steps, origin = to_lps[:, None] * steps, to_lps * origin
    return geometry(*parted(steps), origin, (size[0], size[1], size[2]), path=path, fields=_NRRD_FIELDS)


def _values(
    fields: dict[str, str], sizes: list[int], rest: bytes, path: Path
) -> tuple[Shaped[np.ndarray, "..."], tuple[Path, ...]]:
    kind, encoding, endian = (fields.get(name, "") for name in ("type", "encoding", "endian"))
    dtype, packed = _NRRD_TYPES.get(kind.lower(), ""), _PACKED.get(encoding.lower())
    require(dtype, path, f"type {kind.lower()!r} holds no grey levels; export it as short or float")
    require(packed is not None, path, f"encoding {encoding!r} is not read; export it as raw or gzip")
    for name in ("line skip", "byte skip"):
        skipped = fields.get(name, "0")
        require(skipped == "0", path, f"{name} {skipped[:20]!r} is not read; export it again")
    odd = f"endian {endian.lower()!r} is neither little nor big; export it again"
    require(endian.lower() in ("little", "big") or dtype[1] == "1", path, odd)
    order = ">" if endian.lower() == "big" else "<"
    return read_voxels_beside(
        fields.get("data file"), rest, np.dtype(order + dtype), sizes[::-1], packed=bool(packed), header=path
    )


def _segments(keys: dict[str, str], path: Path) -> tuple[Segment, ...]:
    """Return the segments that 3D Slicer names in a header; before layers, each had a layer of its own."""
    numbers = sorted({int(found[1]) for key in keys if (found := re.match(r"Segment(\d{1,6})_(?:ID|Name)$", key))})
    segments = []
    for place, number in enumerate(numbers):
        value, layer = (keys.get(f"Segment{number}_{part}", "") for part in ("LabelValue", "Layer"))
        whole = re.fullmatch(r"\d{0,9} \d{0,9}", f"{value} {layer}")
        require(whole, path, f"Segment{number} has no whole numbers as LabelValue and Layer; export it again")
        name = keys.get(f"Segment{number}_Name") or keys.get(f"Segment{number}_ID", "")
        plain = not value and not layer
        segments.append(Segment(name, place if plain else int(layer or 0), int(value or 1)))
    return tuple(segments)


def read_metaimage(path: Path) -> ImageFile:
    """Read a MetaImage file. Raises InputError if it is damaged, holds no grey levels or labels, or tells no place."""
    with path.open("rb") as stream:
        fields = _meta_header(stream, path)
        size = _meta_size(fields, path)
        place = _meta_geometry(fields, size, path)
        dtype, packed = _meta_encoding(fields, path)
        source = fields["ElementDataFile"]
        beside = None if source.upper() == "LOCAL" else source
        voxels, files = read_voxels_beside(beside, stream.read(), dtype, size[::-1], packed=packed, header=path)
    return ImageFile(place.volume(voxels, files), voxels[None])


def _meta_header(stream: BufferedIOBase, path: Path) -> dict[str, str]:
    """Return the fields of a header, and leave the stream at the byte after it."""
    fields: dict[str, str] = {}
    for _ in range(_MOST_LINES):
        line = stream.readline(_LONGEST_LINE)
        name, sign, value = line.decode("utf-8", errors="replace").partition("=")
        name = _META_SYNONYMS.get(name.strip(), name.strip())
        if line and not line.strip():
            continue
        require(fields or (sign and name.isidentifier()), path, _NOT_SUCH)
        damaged = f"its header is damaged ({name[:40]!r} is no field of its own); export it again"
        require(sign and name and name not in fields, path, damaged)
        fields[name] = value.strip()
        if name == "ElementDataFile":
            return fields
    raise InputError(f"{path}: {_NO_END}")


def _meta_size(fields: dict[str, str], path: Path) -> tuple[int, int, int]:
    try:
        extents = [int(word) for word in fields.get("DimSize", "").split()]
        count, channels = int(fields.get("NDims", "")), int(fields.get("ElementNumberOfChannels", "1"))
    except ValueError:
        extents, count, channels = [], 0, 1
    whole = count == len(extents) and min(extents, default=0) >= 1
    require(whole, path, "its NDims and DimSize describe no image; export it again")
    colour = f"{channels} values in every voxel (colour or vectors); give a grey-level volume"
    require(channels == 1, path, colour)
    shape = "×".join(map(str, extents))
    several = f"{count}-D ({shape}); give a single 3-D volume, such as one cardiac phase"
    require(max(extents[3:], default=1) == 1, path, several)
    require(count >= 3, path, f"{shape} voxels are no volume; give a 3-D volume")
    return extents[0], extents[1], extents[2]


def _meta_encoding(fields: dict[str, str], path: Path) -> tuple[np.dtype, bool]:
    """Return the voxels' type, and whether they are packed."""
    kind = fields.get("ElementType", "")
    none = f"ElementType {kind[:40]!r} holds no grey levels; export it as MET_SHORT or MET_FLOAT"
    require(kind in _META_TYPES, path, none)
    plain = fields.get("HeaderSize", "0") == "0" and _truth(fields, "BinaryData", True, path)
    require(plain, path, "HeaderSize, or text in place of BinaryData, is not read; export it again")
    big = _truth(fields, "BinaryDataByteOrderMSB", False, path)
    return np.dtype((">" if big else "<") + _META_TYPES[kind]), _truth(fields, "CompressedData", False, path)


def _truth(fields: dict[str, str], name: str, default: bool, path: Path) -> bool:
    text = fields.get(name, str(default))
    require(
        re.match("[TF10]", text, re.IGNORECASE),
        path,
        f"{name} {text[:20]!r} is neither True nor False; export it again",
    )
    return text[:1].upper() in ("T", "1")


def _meta_geometry(fields: dict[str, str], size: tuple[int, int, int], path: Path) -> Geometry:
    count = int(fields["NDims"])
    sizeless = "has no ElementSpacing, so that its voxels have no size; export it again"
    require("ElementSpacing" in fields, path, sizeless)
    spacing = _numbers(fields["ElementSpacing"].split(), count, "ElementSpacing", path)[:3]
    unit, notes, origin = fields.get("DistanceUnits", "mm"), tuple[str, ...](), np.zeros(3)
    require(unit.lower() == "mm", path, f"DistanceUnits {unit[:20]!r} is not mm; export it in mm")
    if "Offset" in fields:
        origin = _numbers(fields["Offset"].split(), count, "Offset", path)[:3]
    else:
        notes += (f"{path.name}: has no Offset; its first voxel was put at 0 0 0",)
    words = fields.get("AnatomicalOrientation", "RAI").strip().upper()
    if "TransformMatrix" in fields:
        # Its rows are the directions of i, j and k.
        rows = _numbers(fields["TransformMatrix"].split(), count * count, "TransformMatrix", path)
        direction = rows.reshape(count, count)[:3, :3].T
    else:
        turned = f"AnatomicalOrientation {words[:20]} without a TransformMatrix; export it again"
        require(words in ("RAI", "???"), path, turned)
        direction = np.eye(3)
        notes += (f"{path.name}: has no TransformMatrix; its axes were taken as left, posterior and superior",)
    place = geometry(direction, spacing, origin, size, path=path, fields=_META_FIELDS)
    return replace(place, notes=(*notes, *place.notes))


def _numbers(words: Sequence[str], count: int, field: str, path: Path) -> Float[np.ndarray, "_"]:
    try:
        numbers = np.array(words, dtype=float)
    except ValueError:
        numbers = np.array([])
    said = f"{field} {' '.join(words)[:80]!r} is not {count} numbers; export it again"
    require(len(numbers) == count, path, said)
    return numbers


def _vector(text: str, field: str, path: Path) -> Float[np.ndarray, "3"]:
    return _numbers(text.strip().removeprefix("(").removesuffix(")").split(","), 3, field, path)
