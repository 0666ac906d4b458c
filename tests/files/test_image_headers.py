"""Image headers and damaged files: read right, read with a note, or refused by name, without a word besides."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from make_fuzz import bounded, damaged, outcome
from make_images import CORNERS, ORIGIN, RAMP, SPACING, TURN, dicom, metaimage, nifti, nrrd, places, quaternion, skewed

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.types import Volume

_MIRROR = TURN * [1.0, 1.0, -1.0]


def _read(path, note: str = ""):
    """Return a volume, after making sure that it holds the ramp and that its notes are the one expected."""
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.voxels, RAMP)
    assert len(volume.notes) == bool(note) and all(note in text for text in volume.notes), volume.notes
    return volume


def _refused(path, reason: str) -> None:
    with pytest.raises(InputError, match=rf"{path.name}: .*{reason}"):
        read_volume(path)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_a_nifti_of_either_byte_order_packed_or_not_whatever_its_suffix(tmp_path, order, suffix):
    _read(nifti(tmp_path / f"ct{suffix}", order=order))
    _read((tmp_path / f"ct{suffix}").rename(tmp_path / {".nii": "other.nii.gz", ".nii.gz": "other.nii"}[suffix]))


_BAD_FIELDS = {
    "ct.nii": [
        ({"magic": (b"ni1\0",)}, "magic .*not that of a NIfTI file of its own"),
        ({"magic": (b"\0\0\0\0",)}, "magic .*not that of a NIfTI"),
        ({"vox_offset": (0,)}, "vox_offset 0"),
        ({"vox_offset": (np.nan,)}, "vox_offset"),
        ({"vox_offset": (360,)}, "incomplete"),
        ({"dim": (0, 4, 5, 6, 1, 1, 1, 1)}, "dim 0 4 5 6"),
        ({"dim": (3, 4, 5, 4, 1, 1, 1, 1)}, "more than the 160 bytes"),
        ({"dim": (3, 32767, 32767, 32767, 1, 1, 1, 1)}, "incomplete"),
        ({"datatype": (4,), "bitpix": (32,)}, "bitpix 32 contradict"),
        ({"datatype": (32,), "bitpix": (64,)}, "datatype 32"),
        ({"datatype": (128,), "bitpix": (24,)}, "colour"),
        ({"intent_code": (1007,)}, "intent_code 1007"),
        ({"xyzt_units": (1,)}, "xyzt_units 1: lengths are not in mm"),
        ({"scl": (np.nan, 0)}, "scl_slope nan"),
        ({"scl": (1, np.inf)}, "scl_inter inf"),
        ({"pixdim": (1, 4, 5, 12.5, 1, 1, 1, 1)}, "pixdim 4×5×12.5"),
        ({"sform_code": (0,), "qform_code": (1,), "quatern": (2, 0, 0, 0, 0, 0)}, "quatern_b"),
        ({"sform_code": (0,), "qform_code": (1,), "pixdim": (1, -0.4, 0.5, 1.25, 1, 1, 1, 1)}, "pixdim .*-0.4"),
        ({"sform_code": (0,)}, "no orientation"),
        ({"sform_code": (0,), "qform_code": (1,), "quatern": (np.nan, 0, 0, 0, 0, 0)}, "quatern_b"),
        ({"srow": (np.nan, 0, 0, 10, 0, 0.5, 0, 20, 0, 0, 1.25, 30)}, "srow_x"),
    ],
    "ct.nrrd": [
        ({"space": None}, "no space, which says an orientation in the patient"),
        ({"space": "scanner-xyz"}, "space 'scanner-xyz'"),
        ({"space_origin": None}, "no space origin"),
        ({"space_origin": "(1,2)"}, "space origin"),
        ({"space_origin": "(inf,0,0)"}, "space origin holds inf"),
        ({"space_directions": "(0,0,0) (0,1,0) (0,0,1)"}, "space directions"),
        ({"space_directions": "(1,0,0) (0,1,0)"}, "space directions"),
        ({"space_directions": "(1,0,0) (0,1,0) none"}, "2 axes in space"),
        ({"space_units": '"mm" "mm" "cm"'}, "space units .*is not mm"),
        ({"sizes": "4 5"}, "dimension, sizes and space directions"),
        ({"sizes": "4 5 5"}, "more than the 200 bytes"),
        ({"sizes": "4 5 7"}, "incomplete"),
        ({"sizes": "40000 50000 60000"}, "incomplete"),
        ({"type": "block"}, "type 'block'"),
        ({"endian": None}, "endian"),
        ({"encoding": "zrl"}, "encoding 'zrl'"),
        ({"byte_skip": "-1"}, "byte skip"),
        ({"line_skip": "1"}, "line skip"),
    ],
    "ct.mha": [
        ({"ElementSpacing": None}, "no ElementSpacing"),
        ({"ElementSpacing": "1 1"}, "ElementSpacing '1 1' is not 3 numbers"),
        ({"ElementSpacing": "a b c"}, "ElementSpacing"),
        ({"ElementSpacing": "-0.5 1 1"}, "ElementSpacing gives voxels of -0.5"),
        ({"TransformMatrix": "nan 0 0 0 1 0 0 0 1"}, "TransformMatrix holds nan"),
        ({"TransformMatrix": "1 0 0 1"}, "TransformMatrix .* is not 9 numbers"),
        ({"NDims": 2}, "NDims and DimSize"),
        ({"DimSize": "4 5 7"}, "incomplete"),
        ({"DimSize": "4 5 5"}, "more than the 200 bytes"),
        ({"ElementNumberOfChannels": 3}, "ElementNumberOfChannels '3' .*grey-level"),
        ({"ElementType": "MET_ASCII_CHAR"}, "ElementType"),
        ({"CompressedData": "maybe"}, "CompressedData 'maybe'"),
        ({"HeaderSize": "-1"}, "HeaderSize"),
        ({"BinaryData": "False"}, "BinaryData"),
        ({"AnatomicalOrientation": "LPI", "TransformMatrix": None}, "AnatomicalOrientation LPI"),
        ({"DistanceUnits": "cm"}, "DistanceUnits 'cm' is not mm"),
    ],
}


@pytest.mark.parametrize(
    ("name", "fields", "reason"), [(name, *bad) for name, some in _BAD_FIELDS.items() for bad in some]
)
def test_a_header_that_cannot_be_meant_is_refused(tmp_path, name, fields, reason):
    write = {".nii": nifti, ".nrrd": nrrd, ".mha": metaimage}[name[2:]]
    _refused(write(tmp_path / name, **fields), reason)


def test_a_negative_pixdim_beside_an_sform_is_noted(tmp_path):
    volume = _read(nifti(tmp_path / "ct.nii", pixdim=(1, -0.4, 0.5, 1.25, 1, 1, 1, 1)), "pixdim is negative")
    np.testing.assert_allclose(volume.index_to_world(CORNERS), places(TURN), atol=1e-5)


@pytest.mark.parametrize("axes", [TURN, _MIRROR], ids=["right-handed", "left-handed"])
def test_a_qform_alone(tmp_path, axes):
    factor = -1 if axes is _MIRROR else 1
    fields = {"sform_code": (0,), "qform_code": (1,), "pixdim": (factor, *SPACING, 1, 1, 1, 1)}
    volume = _read(nifti(tmp_path / "ct.nii", quatern=quaternion(axes * [1, 1, factor]), **fields))
    np.testing.assert_allclose(volume.index_to_world(CORNERS), places(axes), atol=1e-5)


def test_sform_and_qform_that_contradict_each_other(tmp_path):
    """The one in the scanner's coordinates (code 1) is taken and said; two of them, or none, are refused."""
    upright = quaternion(np.eye(3))
    _read(nifti(tmp_path / "agree.nii", qform_code=(1,), sform_code=(2,), quatern=quaternion(TURN)))
    for qform, sform, expected in ((2, 1, TURN), (1, 2, np.eye(3)), (1, 4, np.eye(3))):
        path = nifti(tmp_path / f"{qform}{sform}.nii", qform_code=(qform,), sform_code=(sform,), quatern=upright)
        volume = _read(path, "sform and qform place voxels")
        np.testing.assert_allclose(volume.index_to_world(CORNERS), places(expected), atol=1e-5)
    for code in (1, 2):
        path = nifti(tmp_path / f"{code}.nii", qform_code=(code,), sform_code=(code,), quatern=upright)
        _refused(path, f"qform_code {code} and sform_code {code} do not tell")
    atlas = nifti(tmp_path / "atlas.nii", axes=skewed(0.2), qform_code=(1,), sform_code=(4,), quatern=upright)
    _read(atlas, "the other form is no rigid placement")


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_names_of_labels_in_a_nifti_extension_are_read(tmp_path, order):
    def labels(*extensions):
        parts = [struct.pack(f"{order}2i", len(content) + 8, kind) + content for kind, content in extensions]
        voxels = np.where(RAMP > 0, 51, 7).astype("u1")
        fields = {"extension": b"".join(parts), "datatype": (2,), "bitpix": (8,)}
        return nifti(tmp_path / "a.nii", order=order, voxels=voxels, **fields)

    names = b'<CaretExtension><VolumeInformation><LabelTable><Label Red="1" Key="7">left &amp; right</Label>'
    names += b'<Label Key="51"><![CDATA[heart]]></Label><Label Key="9">absent</Label></LabelTable></VolumeInformation>'
    path = labels((4, b"x" * 24), (30, names + b"</CaretExtension>\0\0\0\0"))
    with pytest.raises(InputError, match=r"2 labels \(7 \(left & right\), 51 \(heart\)\)"):
        read_mask(path)
    np.testing.assert_array_equal(read_mask(path, label="Heart").volume.voxels, RAMP > 0)
    for content in (b"<Label Key='7'>no end", b"<a><Label Key='x'>seven</Label></a>", b"\xff" * 16):
        np.testing.assert_array_equal(read_mask(labels((30, content)), label=51).volume.voxels, RAMP > 0)


@pytest.mark.parametrize(("slope", "intercept"), [(2, -1024), (-1, 3), (0.5, 0), (0, 7)])
def test_the_rescale_of_a_nifti(tmp_path, slope, intercept):
    volume = read_volume(nifti(tmp_path / "ct.nii", scl=(slope, intercept)))
    np.testing.assert_allclose(volume.voxels, RAMP * float(slope) + intercept if slope else RAMP)  # 0: no rescale
    assert volume.voxels.dtype == (np.float32 if slope == 0.5 else np.int16)


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("RAS", (-1, -1, 1)),
        ("LPS", (1, 1, 1)),
        ("left-anterior-superior", (1, -1, 1)),
        ("Right-Anterior-Superior", (-1, -1, 1)),
    ],
)
def test_the_space_of_an_nrrd(tmp_path, space, signs):
    volume = _read(nrrd(tmp_path / "ct.nrrd", space=space))
    np.testing.assert_allclose(volume.index_to_world(CORNERS), places(TURN) * signs, atol=1e-6)


def test_the_encodings_of_an_nrrd(tmp_path):
    whole = nrrd(tmp_path / "raw.nrrd", space_units='"mm" "mm" "mm"', measurement_frame="(0,1,0) (1,0,0) (0,0,1)")
    _read(whole)
    raw = RAMP.tobytes()
    path = nrrd(tmp_path / "packed.nrrd", encoding="gzip")
    path.write_bytes(path.read_bytes().replace(raw, gzip.compress(raw)))
    _read(path)
    path.write_bytes(path.read_bytes()[:-20])
    _refused(path, "truncated|incomplete")
    beside = nrrd(tmp_path / "ct.nhdr", data_file="ct.raw")
    beside.write_bytes(beside.read_bytes().replace(raw, b""))
    (tmp_path / "ct.raw").write_bytes(raw)
    _read(beside)


def test_voxels_in_several_files_or_in_none_are_refused(tmp_path):
    _refused(metaimage(tmp_path / "ct.mhd", ElementDataFile="p%02d.raw 0 5 1"), "in several files")
    _refused(metaimage(tmp_path / "ct.mhd", ElementDataFile="other.raw"), "missing .other.raw")
    (tmp_path / "folder.raw").mkdir()
    _refused(metaimage(tmp_path / "ct.mhd", ElementDataFile="folder.raw"), "missing .folder.raw")


def test_what_a_metaimage_leaves_open_is_noted(tmp_path):
    assert np.allclose(
        _read(metaimage(tmp_path / "a.mha", TransformMatrix=None), "no TransformMatrix").direction, np.eye(3)
    )
    assert np.allclose(_read(metaimage(tmp_path / "b.mha", Offset=None), "no Offset").origin_mm, 0.0)


def test_the_encodings_of_a_metaimage(tmp_path):
    _read(metaimage(tmp_path / "packed.mha", data=zlib.compress(RAMP.tobytes()), CompressedData=True))
    big = RAMP.astype(">i2").tobytes()
    _read(metaimage(tmp_path / "big.mha", data=big, BinaryDataByteOrderMSB=True))
    cut = metaimage(tmp_path / "cut.mha", data=zlib.compress(RAMP.tobytes())[:-9], CompressedData=True)
    _refused(cut, "truncated or damaged|incomplete")


def test_a_mask_keeps_the_notes_of_its_file(tmp_path):
    (note,) = read_mask(nrrd(tmp_path / "mask.nrrd", axes=skewed(1e-3), voxels=(RAMP > 0).astype(np.uint8))).warnings
    assert "straightened" in note


def _dicom_skewed(folder, axes):
    def change(k, slice_):
        slice_.ImageOrientationPatient = [f"{x:.12f}" for x in axes[:, :2].T.ravel()]
        slice_.ImagePositionPatient = [f"{x:.9f}" for x in ORIGIN + axes[:, 2] * SPACING[2] * k]

    return dicom(folder, change)


_FORMATS = {
    "nifti": (lambda tmp, axes: nifti(tmp / "ct.nii.gz", axes=axes), "srow_x"),
    "nrrd": (lambda tmp, axes: nrrd(tmp / "ct.nrrd", axes=axes), "space directions"),
    "metaimage": (lambda tmp, axes: metaimage(tmp / "ct.mha", axes=axes), "TransformMatrix"),
    "dicom": (lambda tmp, axes: _dicom_skewed(tmp / "ct", axes), "ImageOrientationPatient"),
}


@pytest.fixture(params=_FORMATS)
def made(request):
    """Return what writes a file of the format, and the field of its axes."""
    return _FORMATS[request.param]


def test_axes_at_right_angles_are_left_as_they_are(tmp_path, made):
    volume = read_volume(made[0](tmp_path, TURN))
    assert volume.notes == ()
    np.testing.assert_allclose(volume.direction, TURN, atol=1e-6)
    np.testing.assert_allclose(volume.index_to_world(CORNERS), places(TURN), atol=1e-5)
    np.testing.assert_array_equal(volume.voxels, RAMP)


@pytest.mark.parametrize("amount", [2e-4, 2e-3, 9.5e-3])
def test_axes_off_by_little_are_straightened_and_it_is_said(tmp_path, made, amount):
    make, field = made
    volume = read_volume(make(tmp_path, skewed(amount)))
    np.testing.assert_allclose(volume.direction.T @ volume.direction, np.eye(3), atol=1e-12)
    moved = np.linalg.norm(volume.index_to_world(CORNERS) - places(skewed(amount)), axis=1).max()
    # Each axis turns by half the angle, and the volume's centre stays.
    diagonal = np.linalg.norm((np.array([4, 5, 6]) - 1) * SPACING)
    assert 1e-5 * diagonal < moved <= 0.25 * 1.01 * amount * diagonal
    np.testing.assert_allclose(volume.index_to_world(CORNERS).mean(axis=0), places(skewed(amount)).mean(axis=0))
    (note,) = volume.notes
    assert field in note and f"off unit vectors at right angles by {amount:.2g}" in note
    assert f"moved voxels by up to {moved:.2g} mm" in note


_TILTED = np.array([[1, 0, 0], [0, 1, np.sin(np.radians(20.0))], [0, 0, np.cos(np.radians(20.0))]])


@pytest.mark.parametrize(
    ("axes", "off"),
    [(skewed(1.1e-2), "0.63"), (_TILTED, "20"), (TURN[:, [0, 0, 2]], "90")],
    ids=["skewed", "tilted", "flat"],
)
def test_axes_off_right_angles_are_refused_by_the_name_of_the_field(tmp_path, made, axes, off):
    make, field = made
    with pytest.raises(InputError, match=rf"{field}.*not at right angles .off by {off}°.*gantry tilt.*resample"):
        read_volume(make(tmp_path, axes))


def test_axes_that_are_no_unit_vectors_are_refused(tmp_path):
    with pytest.raises(InputError, match="TransformMatrix holds axes of length 2×2×2"):
        read_volume(metaimage(tmp_path / "two.mha", axes=2.0 * TURN))
    with pytest.raises(InputError, match="ImageOrientationPatient holds axes of length 2×2"):
        read_volume(_dicom_skewed(tmp_path / "two", 2.0 * np.eye(3)))
    (note,) = read_volume(metaimage(tmp_path / "nearly.mha", axes=1.002 * TURN)).notes
    assert "TransformMatrix" in note


_BYTES = st.one_of(st.sampled_from([0x00, 0xFF, 0x7F, 0x80, 0x20, 0x0A]), st.integers(0, 255))
_FLIPS = st.lists(st.tuples(st.integers(0, 1 << 16), _BYTES), min_size=1, max_size=4)


def _outcome(read: Callable[[], Volume], capfd: pytest.CaptureFixture[str]) -> Volume | None:
    """Return what a reader returns, None where it refuses in one line; it says nothing on standard error."""
    volume = outcome(read, capfd)
    if volume is not None:
        assert np.isfinite(volume.spacing_mm).all() and volume.spacing_mm.min() > 0
        assert np.isfinite(volume.origin_mm).all()
        np.testing.assert_allclose(volume.direction.T @ volume.direction, np.eye(3), atol=1e-4)
        assert np.isfinite(volume.voxels).all()
    return volume


_FILES: dict[str, tuple[Callable[[Path], Path], int]] = {
    "ct.nii": (nifti, 352),
    "ct.nrrd": (lambda path: nrrd(path, space_units='"mm" "mm" "mm"'), 300),
    "ct.mha": (metaimage, 350),
}


@pytest.mark.parametrize("name", _FILES)
@bounded(60)
@example(flips=[(675, 255)], cut=None)  # a signalling NaN in a NIfTI file's affine
@given(flips=_FLIPS, cut=st.one_of(st.none(), st.integers(0, 600)))
def test_bytes_of_a_header(tmp_path, capfd, name, flips, cut):
    make, header = _FILES[name]
    path = make(tmp_path / name)
    content = path.read_bytes()
    path.write_bytes((damaged(content[:header], flips) + content[header:])[:cut])
    _outcome(lambda: read_volume(path), capfd)
    _outcome(lambda: read_mask(path).volume, capfd)


@pytest.mark.parametrize("packing", ["nii.gz", "nrrd", "mha"])
@bounded(60)
@given(flips=_FLIPS)
def test_bytes_of_packed_voxels(tmp_path, capfd, packing, flips):
    """A checksum shows every damage but one that changes nothing."""
    path = tmp_path / f"ct.{packing}"
    if packing == "nii.gz":
        content = nifti(path).read_bytes()
    elif packing == "nrrd":
        content = nrrd(path, encoding="gzip").read_bytes().replace(RAMP.tobytes(), gzip.compress(RAMP.tobytes()))
    else:
        content = metaimage(path, CompressedData=True, data=zlib.compress(RAMP.tobytes())).read_bytes()
    # The ten bytes of gzip's own header are left alone: its time stamp means nothing.
    begin = {"nii.gz": 10, "nrrd": content.find(b"\n\n") + 12, "mha": content.find(b"LOCAL\n") + 6}[packing]
    path.write_bytes(content[:begin] + damaged(content[begin:], flips))
    volume = _outcome(lambda: read_volume(path), capfd)
    if volume is not None:
        np.testing.assert_array_equal(volume.voxels, RAMP)
        np.testing.assert_allclose(volume.index_to_world(CORNERS), places(TURN), atol=1e-5)


@pytest.fixture(scope="module")
def series(tmp_path_factory) -> Path:
    return dicom(tmp_path_factory.mktemp("dicom") / "ct")


def _slices(series: Path) -> list[bytes]:
    return [file.read_bytes() for file in sorted(series.glob("*.dcm"))]


@bounded(30)
@given(flips=_FLIPS, number=st.integers(0, 5))
def test_bytes_of_a_dicom_header(tmp_path, capfd, series, flips, number):
    for k, content in enumerate(_slices(series)):
        (tmp_path / f"{k}.dcm").write_bytes(damaged(content[:-40], flips) + content[-40:] if k == number else content)
    _outcome(lambda: read_volume(tmp_path), capfd)
