from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.uid import DeflatedExplicitVRLittleEndian, JPEGLSLossless, JPEGLSNearLossless, RLELossless
from scipy.spatial.transform import Rotation

from dicom_by_itk import write_dicom
from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume, write_volume
from endopilot.types import Volume

_IDENTIFIERS = {
    "PatientName": "Doe^Jane",
    "PatientID": "ID-4711",
    "PatientBirthDate": "19610203",
    "InstitutionName": "Saint Nowhere",
    "ReferringPhysicianName": "Who^Doctor",
    "AccessionNumber": "ACC-0815",
    "StudyDate": "20240229",
    "SeriesDescription": "Doe Jane CTA",
    "StudyDescription": "Doe Jane heart",
    "PatientAddress": "Elm Street 1",
    "OtherPatientIDs": "OTHER-99",
}


def _oblique_ct(seed: int = 3) -> Volume:
    """Return an anisotropic volume turned about two axes, its numbers of more digits than a header used to hold."""
    direction = Rotation.from_euler("xz", [15, -8], degrees=True).as_matrix()
    voxels = np.random.default_rng(seed).integers(-1000, 2000, (6, 7, 8)).astype(np.int16)
    return Volume(voxels, np.array([0.390625, 0.5, 0.75]), np.array([-120.123456, -150.0, 1080.54321]), direction)


@pytest.fixture
def series(tmp_path):
    """Return a folder with one series whose header is full of identifiers and has a rescale."""
    folder = tmp_path / "series"
    write_volume(_oblique_ct(), folder)
    _change(folder, **_IDENTIFIERS)
    return folder


def _change(folder, *, every=1, **values):
    for file in sorted(folder.glob("*.dcm"))[::every]:
        slice_ = pydicom.dcmread(file)
        for name, value in values.items():
            setattr(slice_, name, value)
        slice_.save_as(file)


def test_a_series_keeps_its_geometry_and_hu(series):
    expected = _oblique_ct()
    shutil.copy(next(series.glob("*.dcm")), series.parent / "spare.dcm")
    (series / "readme.txt").write_text("not a slice")
    for path in (series, next(series.glob("*.dcm"))):
        volume = read_volume(path)
        assert volume.voxels.dtype == np.int16
        np.testing.assert_array_equal(volume.voxels, expected.voxels)
        corners = np.array([[0.0, 0.0, 0.0], [7.0, 0.0, 5.0], [0.0, 6.0, 5.0], [7.0, 6.0, 0.0]])
        np.testing.assert_allclose(volume.index_to_world(corners), expected.index_to_world(corners), atol=1e-6)


def test_a_left_handed_volume_keeps_its_places(tmp_path):
    right = _oblique_ct()
    left = Volume(right.voxels, right.spacing_mm, right.origin_mm, right.direction * [1.0, 1.0, -1.0])
    write_volume(left, tmp_path / "left")
    again = read_volume(tmp_path / "left")
    k, j, i = np.indices(left.voxels.shape).reshape(3, -1)
    there = np.stack([i, j, k], axis=-1).astype(float)
    back = np.round(again.world_to_index(left.index_to_world(there))).astype(int)
    np.testing.assert_allclose(again.index_to_world(back), left.index_to_world(there), atol=1e-6)
    np.testing.assert_array_equal(again.voxels[back[:, 2], back[:, 1], back[:, 0]], left.voxels[k, j, i])


def test_the_same_volume_gives_the_same_bytes(tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        write_volume(_oblique_ct(seed), tmp_path / name)
    first, same, other = ((tmp_path / name / "slice-0002.dcm").read_bytes() for name in "abc")
    assert first == same != other


def test_series_are_found_in_subfolders(series, tmp_path):
    nested = tmp_path / "disc" / "DICOM" / "S1"
    nested.parent.mkdir(parents=True)
    series.rename(nested)
    for number, file in enumerate(sorted(nested.glob("*.dcm"))[::2]):
        file.rename(nested.parent / f"IM{number}")
    np.testing.assert_array_equal(read_volume(tmp_path / "disc").voxels, _oblique_ct().voxels)


@pytest.mark.parametrize("compression", ["RLE", "deflated", "JPEG-LS", "JPEG", "JPEG2000"])
def test_compressed_series_are_read_and_truncated_ones_refused(tmp_path, compression):
    ct = Volume(np.tile(_oblique_ct().voxels, (1, 8, 8)), np.array([0.4, 0.4, 0.5]), np.zeros(3), np.eye(3))
    folder = tmp_path / "series"
    write_volume(ct, folder)
    for file in folder.glob("*.dcm"):
        slice_ = pydicom.dcmread(file)
        if compression == "deflated":
            slice_.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
            slice_.save_as(file)
            continue
        if compression in ("RLE", "JPEG-LS"):
            if compression == "JPEG-LS":
                pytest.importorskip("jpeg_ls", reason="pyjpegls, which highdicom brings, writes JPEG-LS")
            slice_.compress(RLELossless if compression == "RLE" else JPEGLSLossless)
            slice_.save_as(file)
            continue
        write_dicom(sitk.ReadImage(str(file)), file, compressor=compression)  # ITK writes both without loss
    syntax = pydicom.dcmread(file).file_meta.TransferSyntaxUID
    assert syntax.is_compressed or syntax.is_deflated
    _change(folder, RescaleSlope="2", RescaleIntercept="-24")
    np.testing.assert_array_equal(read_volume(folder).voxels, ct.voxels * 2 - 24)
    file = sorted(folder.glob("*.dcm"))[2]
    content = file.read_bytes()
    for missing in (4, 90, len(content) // 4):
        file.write_bytes(content[:-missing])
        with pytest.raises(
            InputError, match=rf"{file.name}: its (pixels cannot be decoded .truncated|DICOM header is damaged)"
        ):
            read_volume(folder)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"Modality": "MR"}, "modality MR"),
        ({"SamplesPerPixel": 3}, "colour image"),
        ({"NumberOfFrames": 4}, "multi-frame"),
        ({"ImagePositionPatient": None}, "no ImagePositionPatient"),
        ({"RescaleSlope": None}, "no RescaleSlope"),
        ({"RescaleSlope": "0"}, "RescaleSlope is 0"),
        ({"PhotometricInterpretation": "MONOCHROME1"}, "PhotometricInterpretation MONOCHROME1"),
        ({"PixelSpacing": ["0", "1"]}, "PixelSpacing gives voxels of 1×0"),
        ({"ImageOrientationPatient": ["1", "0", "0", "1", "0", "0"]}, "ImageOrientationPatient: .*not at right angles"),
        ({"ImageOrientationPatient": ["1", "0", "0"]}, "no ImageOrientationPatient"),
        ({"SamplesPerPixel": None, "NumberOfFrames": None}, None),
    ],
)
def test_empty_and_impossible_values_in_the_header(series, values, expected):
    _change(series, **values)
    if expected is None:
        assert read_volume(series).voxels.shape == (6, 7, 8)
        return
    with pytest.raises(InputError, match=rf"(slice-000\d.dcm|series): .*{expected}") as caught:
        read_volume(series)
    _assert_no_identifier(str(caught.value))


def test_several_series_are_listed_and_one_is_chosen(series):
    second = series.parent / "second"
    write_volume(_oblique_ct(seed=5), second)
    uid = pydicom.dcmread(next(second.glob("*.dcm"))).SeriesInstanceUID
    _change(second, SeriesNumber=7, RescaleIntercept="100", SeriesDescription="Doe Jane late")
    for file in second.glob("*.dcm"):
        file.rename(series / f"late-{file.name}")
    with pytest.raises(InputError, match=r"2 DICOM series \(1: CT, 6 slices of 8×7; 7: CT, .*choose one with --series"):
        read_volume(series)
    for name in ("7", str(uid)):
        np.testing.assert_array_equal(read_volume(series, series=name).voxels, _oblique_ct(seed=5).voxels + 100)
    np.testing.assert_array_equal(read_volume(series / "slice-0002.dcm").voxels, _oblique_ct().voxels)
    with pytest.raises(InputError, match="no series '9'"):
        read_volume(series, series="9")


def test_bad_series_are_refused_in_one_line(series, tmp_path, caplog):
    def copy(name):
        return shutil.copytree(series, tmp_path / name)

    (copy("gap") / "slice-0003.dcm").unlink()
    tilted = copy("tilted")
    for k, file in enumerate(sorted(tilted.glob("*.dcm"))):
        _move(file, [0.0, 0.1 * k, 0.0])
    twice = copy("twice")
    shutil.copy(twice / "slice-0001.dcm", twice / "again.dcm")
    few = copy("few")
    for file in sorted(few.glob("*.dcm"))[2:]:
        file.unlink()
    _change(copy("mixed"), every=2, PixelSpacing=["1", "1"])
    cut = copy("cut")
    content = (cut / "slice-0002.dcm").read_bytes()
    (cut / "slice-0002.dcm").write_bytes(content[:-60])
    header = copy("header")
    (header / "slice-0002.dcm").write_bytes(content[:200])
    compressed = copy("compressed")
    for file in compressed.glob("*.dcm"):
        _pretend_compressed(file, "1.2.840.10008.1.2.4.201")
    damaged = copy("damaged")
    for file in damaged.glob("*.dcm"):
        _pretend_compressed(file, "1.2.840.10008.1.2.4.90")
    for name, expected in {
        "gap": "1 irregular slice distance.*1.50 mm instead of 0.75 mm.*slices are missing",
        "tilted": "off by 7.*gantry tilt",
        "twice": "several images at one slice position",
        "few": "only 2 slices",
        "mixed": "PixelSpacing differ",
        "cut": "slice-0002.dcm: .*truncated",
        "header": "slice-0002.dcm|irregular",
        "compressed": "High-Throughput JPEG 2000.*not supported.*decompress",
        "damaged": "cannot be decoded",
    }.items():
        with pytest.raises(InputError, match=expected) as caught:
            read_volume(tmp_path / name)
        _assert_no_identifier(str(caught.value) + caplog.text)


def _move(file, by):
    slice_ = pydicom.dcmread(file)
    slice_.ImagePositionPatient = [float(a) + b for a, b in zip(slice_.ImagePositionPatient, by, strict=True)]
    slice_.save_as(file)


def _pretend_compressed(file, syntax):
    """Store nonsense as the pixel data of a compressed transfer syntax."""
    slice_ = pydicom.dcmread(file)
    slice_.file_meta.TransferSyntaxUID = syntax
    slice_.PixelData = pydicom.encaps.encapsulate([b"nonsense"])
    slice_["PixelData"].is_undefined_length = True
    slice_.save_as(file)


def _assert_no_identifier(text):
    for value in _IDENTIFIERS.values():
        assert value not in text


def test_a_series_is_not_written_over(series):
    before = sorted(series.iterdir())
    with pytest.raises(InputError, match="there already"):
        write_volume(_oblique_ct(), series)
    assert sorted(series.iterdir()) == before


@pytest.mark.parametrize(("names", "which"), [("slice-{:04d}.dcm", 0), ("IM{:03d}", -1), ("1.2.840.{}", -1)])
def test_a_slice_at_an_end_that_is_lost_is_refused_by_name(series, names, which):
    """Neither a gap nor a step shows that an outermost slice is missing."""
    for number, file in enumerate(sorted(series.iterdir())):
        file.rename(series / names.format(number))
    file = sorted(series.iterdir())[which]
    whole = file.read_bytes()
    pixels = len(whole) - 7 * 8 * 2
    for content in (b"", whole[:100], whole[132:], *(whole[:length] for length in range(132, pixels + 50, 97))):
        file.write_bytes(content)
        with pytest.raises(InputError, match=rf"{file.name}: ") as caught:
            read_volume(series)
        _assert_no_identifier(str(caught.value))
    file.unlink()
    file.symlink_to(series / "gone")
    with pytest.raises(InputError, match=rf"{file.name}: is named as the slices beside it are, but is no DICOM file"):
        read_volume(series)


def test_files_that_are_no_slices_are_noted_by_name(series):
    (series / "readme").write_text("not a slice")
    (series / "viewer.exe").write_bytes(bytes(300))
    (series / ".DS_Store").write_bytes(bytes(300))
    (series / "DICOMDIR").write_bytes(_without_pixels(series, "1.2.840.10008.1.3.10"))
    (series / "elsewhere").symlink_to(series.parent)
    (note,) = read_volume(series).notes
    assert note == "series: without an image and left out: .DS_Store, DICOMDIR, elsewhere, readme, viewer.exe"


def _without_pixels(folder, kind):
    slice_ = pydicom.dcmread(next(folder.glob("*.dcm")))
    for tag in ("Rows", "Columns", "PixelData"):
        delattr(slice_, tag)
    slice_.SOPClassUID = slice_.file_meta.MediaStorageSOPClassUID = kind
    slice_.save_as(folder / "other", enforce_file_format=True)
    content = (folder / "other").read_bytes()
    (folder / "other").unlink()
    return content


def test_a_subfolder_that_may_not_be_read_is_refused(series, monkeypatch):
    (series / "end").mkdir()
    max(series.glob("*.dcm")).rename(series / "end" / "last.dcm")
    scan = os.scandir

    def closed(path):
        if str(path).endswith("end"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", closed)
    with pytest.raises(InputError, match=r"end: may not be read \(Permission denied\); ask for access"):
        read_volume(series)


@pytest.mark.parametrize(("drift", "sideways"), [(0.03, 0.0), (0.0, 0.3)])
def test_the_place_of_a_slice_is_bounded_and_not_the_step_to_it(tmp_path, drift, sideways):
    """Steps that grow by 3 % after the middle put it 0.3 mm, two fifths of a step, off; each step is within 5 %."""
    ct = Volume(np.zeros((60, 5, 5), np.int16), np.array([1.0, 1.0, 0.75]), np.zeros(3), np.eye(3))
    write_volume(ct, tmp_path / "ct")
    assert read_volume(tmp_path / "ct").voxels.shape == (60, 5, 5)
    for k, file in enumerate(sorted((tmp_path / "ct").iterdir())):
        _move(file, [sideways if k == 20 else 0.0, 0.0, 0.75 * drift * max(k - 30, 0)])
    with pytest.raises(InputError, match=r"not evenly spaced: slice \d+ lies 0\.\d+ mm from where even steps of 0\.7"):
        read_volume(tmp_path / "ct")


def test_pixels_compressed_with_loss_are_read_and_noted(tmp_path):
    jpeg_ls = pytest.importorskip("jpeg_ls", reason="pyjpegls, which highdicom brings, writes JPEG-LS")
    ct = Volume(np.tile(_oblique_ct().voxels, (1, 4, 4)), np.array([0.4, 0.4, 0.5]), np.zeros(3), np.eye(3))
    write_volume(ct, tmp_path / "ct")
    for file in (tmp_path / "ct").iterdir():
        slice_ = pydicom.dcmread(file)
        rows, columns = slice_.pixel_array.shape
        stored = (slice_.pixel_array + 1024).astype(np.uint16).tobytes()
        packed = jpeg_ls.encode_buffer(stored, rows, columns, 1, 12, lossy_error=3)
        slice_.file_meta.TransferSyntaxUID = JPEGLSNearLossless
        slice_.PixelRepresentation, slice_.BitsStored, slice_.HighBit, slice_.RescaleIntercept = 0, 12, 11, -1024
        slice_.PixelData = pydicom.encaps.encapsulate([bytes(packed)])
        slice_["PixelData"].is_undefined_length = True
        slice_.save_as(file)
    volume = read_volume(tmp_path / "ct")
    assert 0 < np.abs(volume.voxels.astype(int) - ct.voxels).max() <= 3
    assert volume.notes == (
        "ct: compressed with loss (JPEG-LS Lossy (Near-Lossless) Image Compression): HU are not those of the scanner",
    )


def test_a_slice_that_does_not_arrive_whole_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    write = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda path, content: write(path, content[:-20]))
    with pytest.raises(InputError, match="was not written whole"):
        write_volume(_oblique_ct(), tmp_path / "ct")
    assert not list(tmp_path.iterdir())
