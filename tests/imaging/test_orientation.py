"""Orientation, anisotropy, units and rescale as other programs write them: headers made by hand."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume

_TURN = Rotation.from_euler("xyz", [10, 20, -30], degrees=True).as_matrix()
_SPACING = np.array([0.4, 0.5, 1.25])
_OFFSET = np.array([10.0, 20.0, 30.0])
_RAMP = np.arange(120, dtype="<i2").reshape(6, 5, 4)  # k, j, i
_INDEX = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [1.0, 2.0, 5.0]])
_RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])


def _nifti(path: Path, affine=None, *, sizes=_SPACING, unit: int = 2, slope=(1.0, 0.0)) -> Path:
    """Write a NIfTI-1 file; the affine (3, 4) is RAS, in the unit of the code (1 m, 2 mm, 3 µm)."""
    header = bytearray(352)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, 4, 5, 6, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, 4, 16)
    struct.pack_into("<4f", header, 76, 1, *sizes)
    struct.pack_into("<3f", header, 108, 352, *slope)
    header[123] = unit
    if affine is not None:
        struct.pack_into("<h", header, 254, 1)
        struct.pack_into("<12f", header, 280, *np.asarray(affine).ravel())
    header[344:348] = b"n+1\0"
    path.write_bytes(bytes(header) + _RAMP.tobytes())
    return path


def _nrrd(path: Path, *fields: str) -> Path:
    head = ("NRRD0004", "type: short", "dimension: 3", "sizes: 4 5 6", "encoding: raw", "endian: little", *fields)
    path.write_bytes(("\n".join(head) + "\n\n").encode() + _RAMP.tobytes())
    return path


def _expected(axes: np.ndarray) -> np.ndarray:
    """Return where the voxels of `_INDEX` lie, if the columns of `axes` are the steps along i, j and k."""
    return _OFFSET + _INDEX @ axes.T


@pytest.mark.parametrize("flip", [1.0, -1.0], ids=["right-handed", "left-handed"])
def test_an_oblique_anisotropic_nifti(tmp_path, flip):
    axes = _TURN * _SPACING * [1.0, flip, 1.0]
    volume = read_volume(_nifti(tmp_path / "ct.nii", np.c_[axes, _OFFSET], slope=(2.0, -1024.0)))
    np.testing.assert_allclose(volume.index_to_world(_INDEX), _expected(axes) * _RAS_TO_LPS, atol=1e-5)
    np.testing.assert_allclose(volume.spacing_mm, _SPACING, atol=1e-6)
    np.testing.assert_array_equal(volume.voxels, _RAMP * 2.0 - 1024.0)


@pytest.mark.parametrize(("unit", "factor"), [(1, 1e-3), (3, 1e3)], ids=["metres", "micrometres"])
def test_a_nifti_in_another_unit_becomes_mm(tmp_path, unit, factor):
    axes = _TURN * _SPACING
    path = _nifti(tmp_path / "ct.nii", np.c_[axes, _OFFSET] * factor, sizes=_SPACING * factor, unit=unit)
    np.testing.assert_allclose(read_volume(path).index_to_world(_INDEX), _expected(axes) * _RAS_TO_LPS, atol=1e-4)


@pytest.mark.parametrize(
    ("space", "signs"),
    [("left-posterior-superior", (1, 1, 1)), ("right-anterior-superior", (-1, -1, 1)), ("LAS", (1, -1, 1))],
)
def test_an_oblique_nrrd_in_each_space(tmp_path, space, signs):
    axes = _TURN * _SPACING
    steps = " ".join("({:.9g},{:.9g},{:.9g})".format(*column) for column in axes.T)
    fields = (f"space: {space}", f"space directions: {steps}", "space origin: (10,20,30)")
    volume = read_volume(_nrrd(tmp_path / "ct.nrrd", *fields))
    np.testing.assert_allclose(volume.index_to_world(_INDEX), _expected(axes) * signs, atol=1e-6)
    np.testing.assert_array_equal(volume.voxels, _RAMP)


def test_an_oblique_mha(tmp_path):
    """A MetaImage's TransformMatrix holds the LPS direction of i, then of j, then of k."""
    head = (
        *("ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False"),
        *("CompressedData = False", "TransformMatrix = " + " ".join(f"{x:.12g}" for x in _TURN.T.ravel())),
        *("Offset = 10 20 30", "ElementSpacing = 0.4 0.5 1.25", "DimSize = 4 5 6", "ElementType = MET_SHORT"),
        "ElementDataFile = LOCAL",
    )
    (tmp_path / "ct.mha").write_bytes(("\n".join(head) + "\n").encode() + _RAMP.tobytes())
    volume = read_volume(tmp_path / "ct.mha")
    np.testing.assert_allclose(volume.index_to_world(_INDEX), _expected(_TURN * _SPACING), atol=1e-6)
    np.testing.assert_array_equal(volume.voxels, _RAMP)


def test_files_that_do_not_say_where_their_voxels_are(tmp_path, capfd):
    upright = np.c_[np.diag(_SPACING), _OFFSET]
    sheared = upright.copy()
    sheared[0, 1] = 0.3
    steps = "space directions: (0.4,0,0) (0,0.5,0) (0,0,1.25)"
    whole = _nrrd(tmp_path / "whole.nrrd", "space: LPS", steps, "space origin: (0,0,0)").read_bytes()
    (tmp_path / "cut.nrrd").write_bytes(whole[:-60])
    (tmp_path / "lost.nhdr").write_bytes(whole[: whole.index(b"\n\n")] + b"\ndata file: lost.raw\n\n")
    meta = b"ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 4 5 6\nElementType = MET_SHORT\n"
    meta += b"ElementSpacing = 1 1 1\nElementDataFile = "
    (tmp_path / "lost.mhd").write_bytes(meta + b"lost.raw\n")
    (tmp_path / "cut.mha").write_bytes(meta + b"LOCAL\n" + _RAMP.tobytes()[:-60])
    for path, expected in {
        _nifti(tmp_path / "nowhere.nii"): "has no orientation .its sform and qform codes are 0",
        _nifti(tmp_path / "two.nii", upright, sizes=(1, 1, 1)): r"voxels of 0.4×0.5×1.25, its pixdim 1×1×1",
        _nifti(tmp_path / "sheared.nii", sheared): "not at right angles",
        _nrrd(tmp_path / "nowhere.nrrd", "spacings: 0.4 0.5 1.25"): "has no orientation .no space",
        tmp_path / "cut.nrrd": "truncated or damaged",
        tmp_path / "cut.mha": "truncated or damaged",
        tmp_path / "lost.nhdr": "the file of voxels that it names is missing",
        tmp_path / "lost.mhd": "the file of voxels that it names is missing",
    }.items():
        with pytest.raises(InputError, match=rf"{path.name}: .*{expected}") as caught:
            read_volume(path)
        assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""  # nor do ITK and MetaIO add lines of their own
