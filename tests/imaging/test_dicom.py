from __future__ import annotations

import json
import logging
import shutil
import warnings

import numpy as np
import pydicom
import pytest

from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume, write_mask, write_volume
from endopilot.types import LumenMask, Volume

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


def _oblique_ct() -> Volume:
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    direction = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    voxels = np.random.default_rng(3).integers(-1000, 2000, (6, 7, 8)).astype(np.int16)
    return Volume(voxels, np.array([0.4, 0.5, 0.75]), np.array([-20.0, -150.0, 80.5]), direction)


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
        np.testing.assert_allclose(volume.spacing_mm, expected.spacing_mm, atol=1e-4)
        np.testing.assert_allclose(volume.origin_mm, expected.origin_mm, atol=1e-3)
        np.testing.assert_allclose(volume.direction, expected.direction, atol=1e-5)


def test_the_order_of_the_files_does_not_matter(series):
    for number, file in enumerate(sorted(series.glob("*.dcm"), reverse=True)):
        file.rename(series / f"IM{number}")
    np.testing.assert_array_equal(read_volume(series).voxels, _oblique_ct().voxels)


def test_the_rescale_is_applied(series):
    _change(series, RescaleSlope="2", RescaleIntercept="-24")
    np.testing.assert_array_equal(read_volume(series).voxels, _oblique_ct().voxels * 2 - 24)
    _change(series, RescaleSlope="0.5", RescaleIntercept="0")
    np.testing.assert_allclose(read_volume(series).voxels, _oblique_ct().voxels * 0.5)


def test_several_series_are_listed_and_one_is_chosen(series):
    second = series.parent / "second"
    write_volume(_oblique_ct(), second)
    uid = pydicom.dcmread(next(second.glob("*.dcm"))).SeriesInstanceUID
    _change(second, SeriesNumber=7, RescaleIntercept="100", SeriesDescription="Doe Jane late")
    for file in second.glob("*.dcm"):
        file.rename(series / f"late-{file.name}")
    with pytest.raises(InputError, match=r"2 DICOM series \(1: CT, 6 slices of 8×7; 7: CT, .*choose one with series="):
        read_volume(series)
    for name in ("7", str(uid)):
        np.testing.assert_array_equal(read_volume(series, series=name).voxels, _oblique_ct().voxels + 100)
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
    magnet = copy("magnet")
    _change(magnet, Modality="MR")
    few = copy("few")
    for file in sorted(few.glob("*.dcm"))[2:]:
        file.unlink()
    mixed = copy("mixed")
    _change(mixed, every=2, PixelSpacing=["1", "1"])
    nowhere = copy("nowhere")
    _change(nowhere, ImagePositionPatient=None)
    colour = copy("colour")
    _change(colour, SamplesPerPixel=3)
    frames = copy("frames")
    _change(frames, NumberOfFrames=4)
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
        "tilted": "gantry tilt of 7",
        "twice": "several images at one slice position",
        "magnet": "modality MR",
        "few": "only 2 slices",
        "mixed": "PixelSpacing differs",
        "nowhere": "no ImagePositionPatient",
        "colour": "colour image",
        "frames": "multi-frame",
        "cut": "slice-0002.dcm: .*truncated",
        "header": "slice-0002.dcm|irregular",
        "compressed": "High-Throughput JPEG 2000.*not supported.*decompress",
        "damaged": "cannot be decoded",
    }.items():
        with pytest.raises(InputError, match=expected) as caught:
            read_volume(tmp_path / name)
        assert "\n" not in str(caught.value)
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


def test_no_identifier_reaches_an_output_or_a_log(series, tmp_path, caplog, capfd):
    _change(series, PatientAge="not an age: Doe^Jane")  # an invalid value, which pydicom quotes in its warnings
    caplog.clear(), capfd.readouterr()
    with warnings.catch_warnings(record=True) as told, caplog.at_level(logging.DEBUG):
        warnings.simplefilter("always")
        volume = read_volume(series)
    write_volume(volume, tmp_path / "ct.nrrd")
    write_volume(volume, tmp_path / "ct.nii")
    write_volume(volume, tmp_path / "again")
    inside = Volume(volume.voxels > 0, volume.spacing_mm, volume.origin_mm, volume.direction)
    write_mask(LumenMask(inside), tmp_path / "mask.mha", manifest={})
    written = [tmp_path / name for name in ("ct.nrrd", "ct.nii", "mask.mha", "mask.json")]
    contents = [file.read_bytes().decode("latin-1") for file in (*written, *(tmp_path / "again").iterdir())]
    _assert_no_identifier(
        " ".join(contents) + caplog.text + "".join(capfd.readouterr()) + str([str(w.message) for w in told])
    )
    assert json.loads((tmp_path / "mask.json").read_text())["ostium"] is None


def test_a_series_is_not_written_over(series):
    before = sorted(series.iterdir())
    with pytest.raises(InputError, match="there already"):
        write_volume(_oblique_ct(), series)
    assert sorted(series.iterdir()) == before
