"""NIfTI-1 files (https://nifti.nimh.nih.gov), read as their standard says, placed by anatomical coordinates."""

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
from endopilot.imaging.geometry import farthest_apart_mm, lengths_text, parted, placed, require
from endopilot.imaging.segments import ImageFile, Segment
from endopilot.imaging.voxels import array_of, rescaled, unpacked
from endopilot.types import Volume

_SPACING_TOLERANCE = 0.01  # voxel sizes given twice may differ by this share: they have few digits
_RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])
_SCANNER = 1  # code of a transform to the scanner's anatomical coordinates
_LONGEST_EXTENSION = 1 << 24
_XML_EXTENSION = 30  # code of an extension of Caret, whose XML may name labels (NIFTI_ECODE_CARET in nifti1_io.h)
_MILLIMETRES = (0, 2)  # units of length in xyzt_units: unknown, mm
_INTENTS = (0, 1001, 1002, 1003)  # a grey-level image or a mask: nothing, an estimate, labels, names of regions

_FIELDS = {
    "dim": ("8i2", 40),
    "intent_code": ("i2", 68),
    "datatype": ("i2", 70),
    "bitpix": ("i2", 72),
    "pixdim": ("8f4", 76),
    "vox_offset": ("f4", 108),
    "scl": ("2f4", 112),
    "xyzt_units": ("u1", 123),
    "codes": ("2i2", 252),
    "quatern": ("6f4", 256),
    "srow": ("(3,4)f4", 280),
    "magic": ("S4", 344),
}
"""Field: (format, offset)."""
_HEADER = np.dtype(
    {
        "names": list(_FIELDS),
        "formats": [kind for kind, _ in _FIELDS.values()],
        "offsets": [at for _, at in _FIELDS.values()],
        "itemsize": 348,
    }
)
_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
"""Grey levels, by their code `datatype`."""
_COLOURS = (128, 2304)


def read_nifti(path: Path) -> ImageFile:
    """Read a NIfTI file (.nii, .nii.gz), its voxels rescaled, and its labels' names. Raises InputError for a damaged
    file, one without three-dimensional grey levels, or one that does not say where they are."""
    content = unpacked(path.read_bytes(), path)
    length = _HEADER.itemsize
    order, sizes = ">" if content[:1] == b"\0" else "<", (struct.pack("<i", length), struct.pack(">i", length))
    other = "its content does not match its suffix, or its header is damaged; export it again"
    require(content[:4] in sizes, path, other)
    require(len(content) >= length, path, "truncated or damaged (its header is incomplete); copy or export it again")
    header = np.frombuffer(content[:length], _HEADER.newbyteorder(order))[0]
    count, *extents = header["dim"].tolist()
    slope, intercept = header["scl"].tolist()
    offset, code, bits = (header[name].item() for name in ("vox_offset", "datatype", "bitpix"))
    dtype = np.dtype(order + _TYPES.get(code, "i2"))
    size = [*extents[: max(count, 0)], 1, 1][: max(count, 3)]
    described = " ".join(map(str, header["dim"].tolist()))
    for good, said in (
        (
            header["magic"] == b"n+1",
            f"magic {header['magic']!r} is not that of a NIfTI file of its own; save it as .nii.gz",
        ),
        (1 <= count <= len(extents) and min(size) >= 1, f"dim {described} describes no image; export it again"),
        (
            max(size[3:], default=1) == 1,
            f"{count}-D ({'×'.join(map(str, size))}); give a single 3-D volume, such as one cardiac phase",
        ),
        (
            header["intent_code"] in _INTENTS,
            f"intent_code {header['intent_code']} is neither that of grey levels nor of labels; export it again",
        ),
        (code not in _COLOURS, "several values in every voxel (colour); give a grey-level volume"),
        (code in _TYPES, f"datatype {code} holds no grey levels; export it as int16 or float32"),
        (bits == 8 * dtype.itemsize, f"datatype {code} and bitpix {bits} contradict each other; export it again"),
        (
            length + 4 <= offset < len(content) and offset == int(offset),
            f"vox_offset {offset:g}: voxels begin behind the header, at {length + 4} or later; export it again",
        ),
        (
            np.isfinite([slope, intercept]).all(),
            f"scl_slope {slope:g} and scl_inter {intercept:g} are not finite; export it again",
        ),
    ):
        require(good, path, said)
    stored = array_of(content[int(offset) :], dtype, size[2::-1], path)
    values = rescaled(stored, slope, intercept) if slope else stored  # a slope of 0 means none
    segments = _named_labels(content[length : min(int(offset), _LONGEST_EXTENSION)], order)
    return ImageFile(replace(_placed(values, header, path), files=(path,)), values[None], segments)


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


@np.errstate(invalid="ignore")  # of a signalling NaN, which is refused as any other
def _placed(voxels: np.ndarray, header: Any, path: Path) -> Volume:
    """Return voxels where sform and qform put them: where both are given they agree, or one is the scanner's."""
    qform_code, sform_code = header["codes"].tolist()
    nowhere = "has no orientation (its sform and qform codes are 0); export it with its affine"
    require(max(qform_code, sform_code) > 0, path, nowhere)
    units, sizes = header["xyzt_units"].item(), header["pixdim"][1:4].astype(float)
    require(np.isfinite(sizes).all(), path, f"pixdim holds {sizes}, which is not finite; export it again")
    require(units & 7 in _MILLIMETRES, path, f"xyzt_units {units}: lengths are not in mm; export it in mm")
    codes, forms = [qform_code, sform_code], (_by_qform, _by_sform)
    said, one_is_scanner = "qform_code {} and sform_code {}".format(*codes), codes.count(_SCANNER) == 1
    first = 0 if sform_code <= 0 or qform_code == _SCANNER != sform_code else 1
    chosen, other, form = forms[first](voxels, header, path), None, ("qform", "sform")[first]
    if min(codes) <= 0:
        beside = f"{path.name}: pixdim is negative; its sign was ignored, and the voxels lie where sform puts them"
        return replace(chosen, notes=(beside, *chosen.notes)) if sizes.min() < 0 else chosen  # a qform refuses it
    with suppress(*[InputError] * one_is_scanner):  # the other one leads to an atlas, and may be any affine map
        other = forms[1 - first](voxels, header, path)
    apart = np.inf if other is None else farthest_apart_mm(chosen, other)
    if apart < chosen.spacing_mm.min() / 2.0:
        return chosen
    differ = (
        "the other form is no rigid placement"
        if other is None
        else f"sform and qform place voxels up to {apart:.3g} mm apart"
    )
    which = f"{differ}, and {said} do not tell which of them is the scanner's (1); set the other code to 0"
    require(one_is_scanner, path, which)
    note = f"{path.name}: {differ}; {form} was taken, which {said} say is in the scanner's coordinates"
    return replace(chosen, notes=(note, *chosen.notes))


def _by_sform(voxels: np.ndarray, header: Any, path: Path) -> Volume:
    rows = header["srow"].astype(float) * _RAS_TO_LPS[:, None]
    name = "srow_x, srow_y and srow_z"
    volume = placed(voxels, *parted(rows[:, :3]), rows[:, 3], path=path, fields=(name, name, name))
    pixdim = np.abs(header["pixdim"][1:4])
    two = f"its affine gives voxels of {lengths_text(volume.spacing_mm)}, its pixdim {lengths_text(pixdim)}"
    same = np.allclose(volume.spacing_mm, pixdim, rtol=_SPACING_TOLERANCE)
    require(same, path, f"{two}; one of them is wrong: export it again")
    return volume


def _by_qform(voxels: np.ndarray, header: Any, path: Path) -> Volume:
    quatern, sizes = header["quatern"].astype(float), header["pixdim"].astype(float)
    b, c, d = quatern[:3].tolist()
    none = f"quatern_b, _c and _d ({b:g}, {c:g}, {d:g}) are no unit quaternion; export it again"
    require(b * b + c * c + d * d <= 1.01, path, none)  # nor where one is not finite
    a = np.sqrt(max(1.0 - (b * b + c * c + d * d), 0.0))
    turn = Rotation.from_quat([b, c, d, a]).as_matrix()
    turn[:, 2] *= -1.0 if sizes[0] < 0 else 1.0
    fields = "quatern_b, quatern_c and quatern_d", "pixdim", "qoffset"
    return placed(voxels, turn * _RAS_TO_LPS[:, None], sizes[1:4], quatern[3:] * _RAS_TO_LPS, path=path, fields=fields)
