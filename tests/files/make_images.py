"""Small image files whose every header field can be set: NIfTI-1, NRRD, MetaImage and DICOM series."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset
from scipy.spatial.transform import Rotation

from endopilot.imaging.volume import write_volume
from endopilot.types import Volume

RAMP = np.arange(-60, 60, dtype="<i2").reshape(6, 5, 4)
"""The voxels of every file, [k, j, i]."""
SPACING = np.array([0.4, 0.5, 1.25])
ORIGIN = np.array([10.0, 20.0, 30.0])
TURN = Rotation.from_euler("xyz", [10, 20, -30], degrees=True).as_matrix()
CORNERS = np.array([[i, j, k] for i in (0.0, 3.0) for j in (0.0, 4.0) for k in (0.0, 5.0)])
_RAS = np.array([-1.0, -1.0, 1.0])[:, None]

_NIFTI = {
    "sizeof_hdr": ("i", 0),
    "dim": ("8h", 40),
    "intent_code": ("h", 68),
    "datatype": ("h", 70),
    "bitpix": ("h", 72),
    "pixdim": ("8f", 76),
    "vox_offset": ("f", 108),
    "scl": ("2f", 112),
    "xyzt_units": ("B", 123),
    "qform_code": ("h", 252),
    "sform_code": ("h", 254),
    "quatern": ("6f", 256),
    "srow": ("12f", 280),
    "magic": ("4s", 344),
}


def skewed(amount: float) -> np.ndarray:
    """Return axes (columns) turned away from LPS, the second leaning towards the first by that cosine."""
    axes = TURN.copy()
    axes[:, 1] = amount * axes[:, 0] + np.sqrt(1.0 - amount**2) * axes[:, 1]
    return axes


def nifti(
    path: Path,
    *,
    axes: np.ndarray = TURN,
    order: str = "<",
    voxels: np.ndarray = RAMP,
    extension: bytes = b"",
    **fields,
) -> Path:
    """Write a NIfTI-1 file whose sform has these LPS axes; `fields` replaces what the header holds."""
    affine = np.c_[axes * SPACING, ORIGIN] * _RAS
    content = {
        "sizeof_hdr": (348,),
        "dim": (3, *voxels.shape[::-1], 1, 1, 1, 1),
        "datatype": (4,),
        "bitpix": (16,),
        "pixdim": (1, *SPACING, 1, 1, 1, 1),
        "vox_offset": (352 + len(extension),),
        "scl": (1, 0),
        "xyzt_units": (2,),
        "sform_code": (1,),
        "srow": tuple(affine.ravel()),
        "magic": (b"n+1\0",),
        **fields,
    }
    header = bytearray(352)
    for name, values in content.items():
        kind, offset = _NIFTI[name]
        struct.pack_into(order + kind, header, offset, *values)
    header[348] = bool(extension)
    data = bytes(header) + extension + voxels.astype(voxels.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def quaternion(axes: np.ndarray) -> tuple[float, ...]:
    """Return b, c and d of a qform with these LPS axes, and its offset."""
    x, y, z, w = Rotation.from_matrix(_RAS * axes).as_quat()
    b, c, d = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
    return (b, c, d, *(ORIGIN * _RAS[:, 0]))


def nrrd(
    path: Path, *, axes: np.ndarray = TURN, voxels: np.ndarray = RAMP, keys: dict[str, object] | None = None, **fields
) -> Path:
    """Write an NRRD file in LPS with these axes; `fields` (blanks as _) replaces what the header holds, None drops."""
    vectors = " ".join("({:.17g},{:.17g},{:.17g})".format(*step) for step in (axes * SPACING).T)
    layers = "none " if voxels.ndim == 4 else ""
    sizes = (*voxels.shape[:-3], *voxels.shape[:-4:-1])
    stored = np.moveaxis(voxels, 0, -1) if voxels.ndim == 4 else voxels
    content: dict[str, object] = {
        "type": {"i": "int16", "u": "uint8", "f": "float"}[voxels.dtype.kind],
        "dimension": voxels.ndim,
        "space": "left-posterior-superior",
        "sizes": " ".join(map(str, sizes)),
        "space directions": layers + vectors,
        "kinds": ("list " if layers else "") + "domain domain domain",
        "endian": "little",
        "encoding": "raw",
        "space origin": "(10,20,30)",
        **{name.replace("_", " "): value for name, value in fields.items()},
    }
    lines = [f"{name}: {value}" for name, value in content.items() if value is not None]
    lines += [f"{name}:={value}" for name, value in (keys or {}).items()]
    path.write_bytes(("\n".join(["NRRD0005", *lines]) + "\n\n").encode() + stored.tobytes())
    return path


def metaimage(path: Path, *, axes: np.ndarray = TURN, data: bytes | None = None, **fields) -> Path:
    """Write a MetaImage file with these LPS axes; `fields` replaces what the header holds, None drops."""
    content: dict[str, object] = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": True,
        "BinaryDataByteOrderMSB": False,
        "CompressedData": False,
        "TransformMatrix": " ".join(f"{x:.17g}" for x in axes.T.ravel()),
        "Offset": "10 20 30",
        "ElementSpacing": "0.4 0.5 1.25",
        "DimSize": "4 5 6",
        "ElementType": "MET_SHORT",
        **fields,
    }
    content["ElementDataFile"] = fields.get("ElementDataFile", "LOCAL")
    lines = [f"{name} = {value}" for name, value in content.items() if value is not None and name != "ElementDataFile"]
    lines.append(f"ElementDataFile = {content['ElementDataFile']}")
    voxels = RAMP.tobytes() if data is None else data
    path.write_bytes(("\n".join(lines) + "\n").encode() + (voxels if content["ElementDataFile"] == "LOCAL" else b""))
    return path


def dicom(folder: Path, change: Callable[[int, Dataset], None] = lambda k, slice_: None, voxels=RAMP) -> Path:
    """Write a series of the ramp, upright; `change` is given the number and the header of every slice."""
    write_volume(Volume(voxels, SPACING, ORIGIN, np.eye(3)), folder)
    for k, file in enumerate(sorted(folder.glob("*.dcm"))):
        slice_ = pydicom.dcmread(file)
        change(k, slice_)
        slice_.save_as(file)
    return folder


def places(axes: np.ndarray) -> np.ndarray:
    """Return where the corners of the ramp lie by a header with these axes, LPS mm."""
    return ORIGIN + CORNERS @ (axes * SPACING).T
