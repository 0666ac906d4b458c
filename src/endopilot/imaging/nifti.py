"""NIfTI-1 files (https://nifti.nimh.nih.gov), read as their standard says, placed by anatomical
coordinates."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from endopilot.errors import InputError
from endopilot.imaging.geometry import (
    Fields,
    Geometry,
    farthest_apart_mm,
    geometry,
    lengths_text,
    parted,
    require,
)
from endopilot.imaging.segments import ImageFile, Segment
from endopilot.imaging.voxels import array_of, rescaled, unpacked

_SPACING_TOLERANCE = 0.01  # voxel sizes given twice may differ by this share: they have few digits
_RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])
_SCANNER = 1  # code of a transform to the scanner's anatomical coordinates
_LARGEST_OFFSET = 1 << 40
_LONGEST_EXTENSION = 1 << 24
_XML_EXTENSION = 30  # code of an extension of Caret, whose XML may name labels (NIFTI_ECODE_CARET in nifti1_io.h)
_MILLIMETRES = (0, 2)  # units of length in xyzt_units: unknown, mm
_INTENTS = (0, 1001, 1002, 1003)  # a grey-level image or a mask: nothing, an estimate, labels, names of regions

_HEADER_BYTES = 348
_FIELDS = {
    "dim": ("8h", 40),
    "intent_code": ("h", 68),
    "datatype": ("h", 70),
    "bitpix": ("h", 72),
    "pixdim": ("8f", 76),
    "vox_offset": ("f", 108),
    "scl": ("2f", 112),
    "xyzt_units": ("B", 123),
    "codes": ("2h", 252),
    "quatern": ("6f", 256),
    "srow": ("12f", 280),
    "magic": ("4s", 344),
}
"""Field: (format, offset)."""

_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
"""Grey levels, by their code `datatype`."""
_COLOURS = (128, 2304)


def read_nifti(path: Path) -> ImageFile:
    """Read a NIfTI file (.nii, .nii.gz), its voxels rescaled, and its labels' names. Raises InputError for a damaged
    file, one without three-dimensional grey levels, or one that does not say where they are."""
    content = unpacked(path.read_bytes(), path)
    header = _header(content, path)
    size, dtype, offset = _size(header, path), _type(header, path), _offset(header, path)
    segments = _named_labels(content[_HEADER_BYTES : min(offset, _LONGEST_EXTENSION)], header["order"])
    stored = array_of(content[offset:], dtype, size[::-1], path)
    place = _geometry(header, size, path)
    slope, intercept = header["scl"]
    scale = f"scl_slope {slope:g} and scl_inter {intercept:g} are not finite; export it again"
    require(np.isfinite([slope, intercept]).all(), path, scale)
    values = rescaled(stored, float(slope), float(intercept)) if slope else stored  # a slope of 0 means none
    return ImageFile(place.volume(values, (path,)), values[None], segments)


def _header(content: bytes, path: Path) -> dict[str, Any]:
    order = next((order for order in "<>" if content[:4] == struct.pack(f"{order}i", _HEADER_BYTES)), "")
    require(order, path, "its content does not match its suffix, or its header is damaged; export it again")
    cut = "truncated or damaged (its header is incomplete); copy or export it again"
    require(len(content) >= _HEADER_BYTES, path, cut)
    fields: dict[str, Any] = {"order": order}
    for name, (kind, at) in _FIELDS.items():
        values = struct.unpack_from(order + kind, content, at)
        fields[name] = values if values[1:] else next(iter(values))
    magic = fields["magic"]
    apart = f"magic {magic!r}: its voxels are in a file of their own (.img); save it as .nii.gz"
    require(magic[:3] != b"ni1", path, apart)
    other = f"magic {magic!r} is not that of NIfTI (Analyze has no orientation); export it again"
    require(magic == b"n+1\0", path, other)
    return fields


def _size(header: dict[str, Any], path: Path) -> tuple[int, int, int]:
    count, *extents = header["dim"]
    none = f"dim {' '.join(map(str, header['dim']))} describes no image; export it again"
    require(1 <= count <= 7 and min(extents[:count]) >= 1, path, none)
    extents = [*extents[:count], 1, 1][: max(count, 3)]
    several = f"{count}-D ({'×'.join(map(str, extents))}); give a single 3-D volume, such as one cardiac phase"
    require(max(extents[3:], default=1) == 1, path, several)
    intent = f"intent_code {header['intent_code']} is neither that of grey levels nor of labels; export it again"
    require(header["intent_code"] in _INTENTS, path, intent)
    return extents[0], extents[1], extents[2]


def _type(header: dict[str, Any], path: Path) -> np.dtype:
    code, bits = header["datatype"], header["bitpix"]
    require(code not in _COLOURS, path, "several values in every voxel (colour); give a grey-level volume")
    require(code in _TYPES, path, f"datatype {code} holds no grey levels; export it as int16 or float32")
    dtype = np.dtype(header["order"] + _TYPES[code])
    require(
        bits == 8 * dtype.itemsize, path, f"datatype {code} and bitpix {bits} contradict each other; export it again"
    )
    return dtype


def _offset(header: dict[str, Any], path: Path) -> int:
    """Return where the voxels begin: behind the header and the four bytes that say whether it is extended."""
    offset, least = header["vox_offset"], _HEADER_BYTES + 4
    begin = f"vox_offset {offset:g}: voxels begin behind the header, at {least} or later; export it again"
    require(least <= offset < _LARGEST_OFFSET and offset == int(offset), path, begin)
    return int(offset)


def _named_labels(content: bytes, order: str) -> tuple[Segment, ...]:
    """Return names in a header's extensions, in XML as TotalSegmentator and Connectome Workbench write them."""
    at = 4 if content[:1] not in (b"", b"\0") else len(content)
    while at + 8 <= len(content):
        size, kind = struct.unpack_from(f"{order}2i", content, at)
        if kind == _XML_EXTENSION:
            with suppress(ElementTree.ParseError, ValueError):
                labels = ElementTree.fromstring(content[at + 8 : at + size].strip(b"\0 \r\n")).iter("Label")
                return tuple(Segment(label.text or "", 0, int(label.get("Key", ""))) for label in labels)
        at += max(size, 8)
    return ()


def _geometry(header: dict[str, Any], size: tuple[int, int, int], path: Path) -> Geometry:
    qform_code, sform_code = header["codes"]
    nowhere = "has no orientation (its sform and qform codes are 0); export it with its affine"
    require(max(qform_code, sform_code) > 0, path, nowhere)
    sizes = np.array(header["pixdim"][1:4], dtype=float)
    require(np.isfinite(sizes).all(), path, f"pixdim holds {sizes}, which is not finite; export it again")
    in_mm, notes = header["xyzt_units"] & 7 in _MILLIMETRES, tuple[str, ...]()
    require(in_mm, path, f"xyzt_units {header['xyzt_units']}: lengths are not in mm; export it in mm")
    first, other = ("qform", "sform") if sform_code <= 0 or qform_code == _SCANNER != sform_code else ("sform", "qform")
    forms = {"sform": _sform, "qform": _qform}
    chosen = forms[first](header, size, path)
    if min(qform_code, sform_code) > 0:
        try:
            notes += _agreement(chosen, forms[other](header, size, path), size, header, path)
        except InputError:
            if header["codes"].count(_SCANNER) != 1:
                raise
            # The other one leads to an atlas, and may be any affine map.
            notes += (f"{path.name}: {other} is no rigid placement; {first}, the scanner's, was taken",)
    elif first == "sform" and sizes.min() < 0:
        notes += (f"{path.name}: pixdim is negative; its sign was ignored, and the voxels lie where sform puts them",)
    return replace(chosen, notes=(*notes, *chosen.notes))


def _sform(header: dict[str, Any], size: tuple[int, int, int], path: Path) -> Geometry:
    rows = np.array(header["srow"], dtype=float).reshape(3, 4) * _RAS_TO_LPS[:, None]
    fields = Fields(*["srow_x, srow_y and srow_z"] * 3)
    place = geometry(*parted(rows[:, :3]), rows[:, 3], size, path=path, fields=fields)
    pixdim = np.abs(header["pixdim"][1:4])
    two = f"its affine gives voxels of {lengths_text(place.spacing_mm)}, its pixdim {lengths_text(pixdim)}"
    same = np.allclose(place.spacing_mm, pixdim, rtol=_SPACING_TOLERANCE)
    require(same, path, f"{two}; one of them is wrong: export it again")
    return place


def _qform(header: dict[str, Any], size: tuple[int, int, int], path: Path) -> Geometry:
    b, c, d = (float(value) for value in header["quatern"][:3])
    offset = np.array(header["quatern"][3:], dtype=float)
    none = f"quatern_b, _c and _d ({b:g}, {c:g}, {d:g}) are no unit quaternion; export it again"
    require(b * b + c * c + d * d <= 1.01, path, none)  # nor where one is not finite
    a = np.sqrt(max(1.0 - (b * b + c * c + d * d), 0.0))
    turn = Rotation.from_quat([b, c, d, a]).as_matrix()
    turn[:, 2] *= -1.0 if header["pixdim"][0] < 0 else 1.0
    sizes = np.array(header["pixdim"][1:4], dtype=float)
    fields = Fields("quatern_b, quatern_c and quatern_d", "pixdim", "qoffset")
    return geometry(turn * _RAS_TO_LPS[:, None], sizes, offset * _RAS_TO_LPS, size, path=path, fields=fields)


def _agreement(
    chosen: Geometry, other: Geometry, size: tuple[int, int, int], header: dict[str, Any], path: Path
) -> tuple[str, ...]:
    """Say so where sform and qform put a corner of the volume half a voxel apart or more."""
    apart = farthest_apart_mm(chosen, other, size)
    if apart < chosen.spacing_mm.min() / 2.0:
        return ()
    codes = "qform_code {} and sform_code {}".format(*header["codes"])
    differ = f"sform and qform place voxels up to {apart:.3g} mm apart"
    which = f"{differ}, and {codes} do not tell which of them is the scanner's (1); set the other code to 0"
    require(header["codes"].count(_SCANNER) == 1, path, which)
    form = "qform" if header["codes"][0] == _SCANNER else "sform"
    return (f"{path.name}: {differ}; {form} was taken, which {codes} say is in the scanner's coordinates",)
