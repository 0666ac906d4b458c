"""Images with a text header: NRRD (.nrrd, .nhdr; https://teem.sourceforge.net/nrrd/format.html), Slicer's segmentations
(.seg.nrrd), whose header names each segment's layer and value, and MetaImage (.mha, .mhd;
https://itk.org/Wiki/MetaIO/Documentation), where RAI are axes from right, anterior and inferior, which is LPS."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.imaging.geometry import parted, placed, require
from endopilot.imaging.segments import ImageFile, Segment
from endopilot.imaging.voxels import read_voxels_beside

_LONGEST_LINE = 1 << 20
_NOT_SUCH = "its content does not match its suffix, or its header is damaged; export it again"
_NO_END = "truncated or damaged (its header does not end); copy or export it again"
_SPACES = {
    **dict.fromkeys(("right-anterior-superior", "ras"), (-1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (1.0, 1.0, 1.0)),
}
"""The patient's axes that NRRD defines, and the signs that turn them to LPS."""
_BYTES = {"char": 1, "short": 2, "int": 4, "long": 4, "longlong": 8, "int8": 1, "int16": 2, "int32": 4, "int64": 8}
"""Of whole numbers, without what says that they have no sign; MetaImage's `long` has four."""
_SIZES, _TRUTH = r"[1-9]\d{0,11}( +[1-9]\d{0,11})*", "[tf10].*"


@dataclass(frozen=True)
class _Format:
    """How a header is written: what parts a field's name from its value, other names of fields, and of each field that
    is checked a regular expression, its value where it is missing (None: it must be there), and what it should say."""

    sign: str
    synonyms: Mapping[str, str]
    rules: Mapping[str, tuple[str, str | None, str]]


_NRRD = _Format(
    ": |:=",
    {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip"},
    {
        "dimension": (r"\d{1,9}", None, "the number of axes"),
        "sizes": (_SIZES, None, "the number of voxels along each axis"),
        "type": ("[a-z].*", None, "a type of numbers"),
        "encoding": ("raw|gzip|gz", None, "raw or gzip"),
        "endian": ("little|big|", "", "little or big"),
        "space": ("|".join(_SPACES), None, "an orientation in the patient, such as left-posterior-superior"),
        "space directions": (r"((none|\([^()]*\))\s*)+", None, "one vector an axis"),
        "space origin": (r"\(.*\)", None, "the place of the first voxel"),
        "space units": (r'("(mm)?"\s*)+', '"mm"', "mm"),
        "line skip": ("0", "0", "0"),
        "byte skip": ("0", "0", "0"),
    },
)
_META = _Format(
    "=",
    {
        **dict.fromkeys(("Orientation", "Rotation"), "TransformMatrix"),
        **dict.fromkeys(("Origin", "Position"), "Offset"),
        "ElementByteOrderMSB": "BinaryDataByteOrderMSB",
    },
    {
        "NDims": (r"\d{1,9}", None, "the number of axes"),
        "DimSize": (_SIZES, None, "the number of voxels along each axis"),
        "ElementSpacing": (".+", None, "the size of a voxel"),
        "ElementNumberOfChannels": ("1", "1", "1: give a grey-level volume, not colour or vectors"),
        "ElementType": ("MET_.*", None, "a type of numbers"),
        "HeaderSize": ("0", "0", "0"),
        "BinaryData": ("t.*|1.*", "True", "True"),
        "BinaryDataByteOrderMSB": (_TRUTH, "False", "True or False"),
        "CompressedData": (_TRUTH, "False", "True or False"),
        "DistanceUnits": ("mm", "mm", "mm"),
    },
)


def _header(stream: BufferedIOBase, form: _Format, end: str, path: Path) -> dict[str, str]:
    """Return the fields of a header, checked, and leave the stream behind the one that is its `end`, or behind an empty
    line where that has no name. NRRD's keys (name:=value) stand among the fields as ":name"."""
    fields: dict[str, str] = {}
    for line in iter(lambda: stream.readline(_LONGEST_LINE), b""):
        text = line.decode("utf-8", errors="replace").strip()
        if not text and not end:
            break
        if not text or text.startswith("#"):
            continue
        name, sign, value = (*re.split(f"({form.sign})", f"{text} ", maxsplit=1), "", "")[:3]
        name = f":{name}" if sign == ":=" else name.strip().lower() if not end else name.strip()
        name = form.synonyms.get(name, name)
        require(fields or not end or (sign and name.isidentifier()), path, _NOT_SUCH)
        damaged = f"its header is damaged ({text[:60]!r} is no field of its own); export it again"
        require(sign and name and name not in fields, path, damaged)
        fields[name] = value.strip()
        if name == end:
            break
    else:
        require(not end and "data file" in fields, path, _NO_END)
    for name, (pattern, absent, meant) in form.rules.items():
        value = fields.setdefault(name, absent or "") if absent is not None else fields.get(name)
        require(value is not None, path, f"has no {name}, which says {meant}; export it again")
        good = re.fullmatch(pattern, value or "", re.IGNORECASE | re.DOTALL)
        require(good, path, f"{name} {(value or '')[:60]!r} is not {meant}; export it again")
    return fields


def read_nrrd(path: Path) -> ImageFile:
    """Read an NRRD file. Raises InputError if it is damaged, holds no grey levels or labels, or tells no place."""
    with path.open("rb") as stream:
        require(re.fullmatch(rb"NRRD000[1-5]\r?\n", stream.readline(12)), path, _NOT_SUCH)
        fields = _header(stream, _NRRD, "", path)
        rest = stream.read()
    sizes = [int(word) for word in fields["sizes"].split()]
    words = re.findall(r"none|\([^()]*\)", fields["space directions"].lower())
    unlike = "its dimension, sizes and space directions are not of as many axes; export it again"
    require(int(fields["dimension"]) == len(sizes) == len(words), path, unlike)
    domain = [axis for axis, word in enumerate(words) if word != "none"]
    extra = [axis for axis in range(len(sizes)) if axis not in domain]
    shape = "×".join(map(str, sizes))
    flat = f"{shape} voxels with {len(domain)} axes in space are no volume; give a 3-D volume"
    require(len(domain) == 3, path, flat)
    segments = _segments(fields, path)
    count = int(np.prod([sizes[axis] for axis in extra], dtype=float))
    kinds = dict(enumerate(fields.get("kinds", "").lower().split()))
    lasting = len(extra) > 1 or any(kinds.get(axis) in ("list", "time") for axis in extra)
    what = f"{count} values in every voxel (colour or vectors); give a grey-level volume"
    what = f"{len(sizes)}-D ({shape}); give one 3-D volume, such as one cardiac phase" if lasting else what
    require(count <= 1 or segments, path, what)
    order, packed = fields["endian"], fields["encoding"].lower() != "raw"
    dtype = _type(fields, "type", order.lower() == "big", path)
    require(order or dtype.itemsize == 1, path, "has no endian, which says little or big; export it again")
    beside = fields.get("data file")
    values, files = read_voxels_beside(beside, rest, dtype, sizes[::-1], packed=packed, header=path)
    # The first axis of the file is the fastest, and so the last of the array.
    axes = [len(sizes) - 1 - axis for axis in (*extra, *reversed(domain))]
    layers = values.transpose(axes).reshape(count, *(sizes[axis] for axis in reversed(domain)))
    to_lps = np.array(_SPACES[fields["space"].lower()])
    steps = np.array([_vector(words[axis], "space directions", path) for axis in domain]).T
    origin = to_lps * _vector(fields["space origin"], "space origin", path)
    named = "space directions", "space directions", "space origin"
    place = placed(layers[0], *parted(to_lps[:, None] * steps), origin, path=path, fields=named, files=files)
    return ImageFile(place, layers, segments)


def _segments(fields: Mapping[str, str], path: Path) -> tuple[Segment, ...]:
    """Return the segments that 3D Slicer names in a header; before layers, each had a layer of its own."""
    numbers = sorted({int(found[1]) for key in fields if (found := re.match(r":Segment(\d{1,6})_(?:ID|Name)$", key))})
    segments = []
    for place, number in enumerate(numbers):
        value, layer, name, own = (
            fields.get(f":Segment{number}_{part}", "") for part in ("LabelValue", "Layer", "Name", "ID")
        )
        whole = re.fullmatch(r"\d{0,9} \d{0,9}", f"{value} {layer}")
        require(whole, path, f"Segment{number} has no whole numbers as LabelValue and Layer; export it again")
        plain = not value and not layer
        segments.append(Segment(name or own, place if plain else int(layer or 0), int(value or 1)))
    return tuple(segments)


def read_metaimage(path: Path) -> ImageFile:
    """Read a MetaImage file. Raises InputError if it is damaged, holds no grey levels or labels, or tells no place."""
    with path.open("rb") as stream:
        fields = _header(stream, _META, "ElementDataFile", path)
        rest = stream.read()
    extents, count = [int(word) for word in fields["DimSize"].split()], int(fields["NDims"])
    require(count == len(extents), path, "its NDims and DimSize describe no image; export it again")
    shape = "×".join(map(str, extents))
    several = f"{count}-D ({shape}); give a single 3-D volume, such as one cardiac phase"
    require(max(extents[3:], default=1) == 1, path, several)
    require(count >= 3, path, f"{shape} voxels are no volume; give a 3-D volume")
    big, packed = (fields[name][:1].lower() in "t1" for name in ("BinaryDataByteOrderMSB", "CompressedData"))
    dtype, source = _type(fields, "ElementType", big, path), fields["ElementDataFile"]
    beside = None if source.upper() == "LOCAL" else source
    voxels, files = read_voxels_beside(beside, rest, dtype, extents[2::-1], packed=packed, header=path)
    spacing = _numbers(fields["ElementSpacing"].split(), count, "ElementSpacing", path)[:3]
    origin, direction, notes = np.zeros(3), np.eye(3), tuple[str, ...]()
    if "Offset" in fields:
        origin = _numbers(fields["Offset"].split(), count, "Offset", path)[:3]
    else:
        notes += (f"{path.name}: has no Offset; its first voxel was put at 0 0 0",)
    if "TransformMatrix" in fields:
        # Its rows are the directions of i, j and k.
        rows = _numbers(fields["TransformMatrix"].split(), count * count, "TransformMatrix", path)
        direction = rows.reshape(count, count)[:3, :3].T
    else:
        words = fields.get("AnatomicalOrientation", "RAI").upper()
        turned = f"AnatomicalOrientation {words[:20]} without a TransformMatrix; export it again"
        require(words in ("RAI", "???"), path, turned)
        notes += (f"{path.name}: has no TransformMatrix; its axes were taken as left, posterior and superior",)
    named = "TransformMatrix", "ElementSpacing", "Offset"
    place = placed(voxels, direction, spacing, origin, path=path, fields=named, notes=notes, files=files)
    return ImageFile(place, voxels[None])


def _type(fields: Mapping[str, str], field: str, big: bool, path: Path) -> np.dtype:
    """Return the type of a header's numbers, such as "unsigned short", "uint16_t" or MET_USHORT."""
    plain = re.sub(r"^met_|_t$|^signed |[ _]", "", fields[field].lower().replace("unsigned ", "u"))
    name = re.sub("(?<=[tg])int$", "", plain)
    width, sign = _BYTES.get(name.removeprefix("u")), "u" if name.startswith("u") else "i"
    kind = {"float": "f4", "double": "f8"}.get(name) or (f"{sign}{width}" if width else "")
    said = f"{field} {fields[field][:40]!r} holds no grey levels; export it as short or float"
    require(kind, path, said)
    return np.dtype((">" if big else "<") + kind)


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
