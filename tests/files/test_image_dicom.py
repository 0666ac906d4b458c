"""DICOM series of several cardiac phases, and headers whose values are no plain HU."""

from __future__ import annotations

import shutil

import numpy as np
import pydicom
import pytest
from make_images import RAMP, dicom

from endopilot.errors import InputError
from endopilot.files import input_hash
from endopilot.imaging.volume import read_volume


def _phases(folder, tag, values, *, vary=0.0):
    """Write a series whose slices are there once for each value of a field, each time brighter by 100."""
    rng = np.random.default_rng(0)
    for phase, value in enumerate(values):

        def change(k, slice_, value=value):
            if tag is not None:
                whole = tag in ("TemporalPositionIndex", "TemporalPositionIdentifier", "AcquisitionNumber")
                number = value + vary * rng.uniform(-1, 1)
                setattr(slice_, tag, int(number) if whole else round(float(number), 2))
            slice_.SeriesInstanceUID = "1.2.3"

        part = dicom(folder / f"part{phase}", change, RAMP + np.int16(100 * phase))
        for file in part.glob("*.dcm"):
            file.rename(folder / f"{phase}-{file.name}")
        part.rmdir()
    return folder


@pytest.mark.parametrize(
    ("tag", "values", "listed"),
    [
        ("NominalPercentageOfCardiacPhase", (40.0, 75.0), r"2 phases by Nominal.* \(40%: 6 slices; 75%: 6 slices\)"),
        ("TriggerTime", (310.0, 580.0), r"TriggerTime \(310 ms: 6 slices; 580 ms"),
        ("NominalCardiacTriggerDelayTime", (310.0, 580.0), "NominalCardiacTriggerDelayTime"),
        ("TemporalPositionIndex", (1, 2), r"TemporalPositionIndex \(1: 6 slices"),
        ("TemporalPositionIdentifier", (1, 2), "TemporalPositionIdentifier"),
        ("AcquisitionNumber", (3, 4), "AcquisitionNumber"),
    ],
)
def test_phases_are_named_and_one_is_chosen(tmp_path, tag, values, listed):
    folder = _phases(tmp_path / "ct", tag, values)
    with pytest.raises(InputError, match=rf"{listed}.*choose one \(--phase {values[0]:g}\), or give one of its files"):
        read_volume(folder)
    for phase, value in enumerate(values):
        for wanted in (f"{value:g}", f"{value:.1f}"):
            volume = read_volume(folder, phase=wanted)
            np.testing.assert_array_equal(volume.voxels, RAMP + 100 * phase)
        assert {file.name[0] for file in volume.files} == {str(phase)}
    with pytest.raises(InputError, match=rf"no phase '60'.*{listed}"):
        read_volume(folder, phase="60")
    by_file = read_volume(folder / "1-slice-0003.dcm")
    np.testing.assert_array_equal(by_file.voxels, RAMP + 100)
    assert "the phase of the file given" in by_file.notes[0]


def test_trigger_times_may_vary_from_beat_to_beat(tmp_path):
    folder = _phases(tmp_path / "ct", "TriggerTime", (310.0, 580.0, 700.0), vary=8.0)
    with pytest.raises(InputError, match=r"3 phases by TriggerTime") as caught:
        read_volume(folder)
    value = str(caught.value).split("--phase ")[1].split(")")[0]
    np.testing.assert_array_equal(read_volume(folder, phase=value).voxels, RAMP)


def test_images_that_nothing_tells_apart_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"several images at one slice position.*nothing in their headers"):
        read_volume(_phases(tmp_path / "ct", None, (1, 2)))


def test_the_phase_of_a_series_that_holds_one_is_checked(tmp_path):
    folder = _phases(tmp_path / "ct", "NominalPercentageOfCardiacPhase", (75.0,))
    np.testing.assert_array_equal(read_volume(folder, phase="75").voxels, RAMP)
    np.testing.assert_array_equal(read_volume(folder, phase="75%").voxels, RAMP)
    with pytest.raises(InputError, match=r"no phase '40': .*NominalPercentageOfCardiacPhase 75; leave --phase out"):
        read_volume(folder, phase="40")
    with pytest.raises(InputError, match="no phase in its headers"):
        read_volume(_phases(tmp_path / "none", None, (1,)), phase="40")


def test_slices_of_several_phases_in_one_volume_are_noted(tmp_path):
    def change(k, slice_):
        slice_.NominalPercentageOfCardiacPhase = 40.0 if k < 3 else 75.0

    (note,) = read_volume(dicom(tmp_path / "ct", change)).notes
    assert "several cardiac phases (NominalPercentageOfCardiacPhase 40, 75)" in note


def test_the_hash_is_that_of_the_slices_read(tmp_path):
    folder = _phases(tmp_path / "ct", "NominalPercentageOfCardiacPhase", (40.0, 75.0))
    hashes = {phase: input_hash(folder, read_volume(folder, phase=phase).files) for phase in ("40", "75")}
    assert hashes["40"] != hashes["75"]
    for file in folder.glob("0-*"):
        file.unlink()
    assert input_hash(folder, read_volume(folder).files) == hashes["75"] == input_hash(folder)


def test_values_that_may_be_inverted_are_refused(tmp_path):
    def change(k, slice_):
        slice_.PhotometricInterpretation = "MONOCHROME1"

    with pytest.raises(InputError, match=r"slice-0000\.dcm: PhotometricInterpretation MONOCHROME1"):
        read_volume(dicom(tmp_path / "ct", change))


@pytest.mark.parametrize(("kind", "note"), [("HU", False), ("", False), ("US", True), ("HU_MOD", True)])
def test_a_rescale_to_hu(tmp_path, kind, note):
    def change(k, slice_):
        slice_.RescaleType = kind

    volume = read_volume(dicom(tmp_path / "ct", change))
    assert bool(volume.notes) == note and all(f"RescaleType {kind} was taken as HU" in n for n in volume.notes)


@pytest.mark.parametrize("kind", ["OD", "MGML", "Z_EFF", "Doe^Jane"])
def test_a_rescale_to_something_else_is_refused(tmp_path, kind):
    def change(k, slice_):
        slice_.RescaleType = kind

    with pytest.raises(InputError, match="RescaleType is not HU") as caught:
        read_volume(dicom(tmp_path / "ct", change))
    assert "Doe" not in str(caught.value)


def test_a_rescale_and_a_sign_of_each_slice(tmp_path):
    def change(k, slice_):
        stored = RAMP[k] + 60
        slice_.PixelRepresentation = k % 2
        slice_.RescaleSlope, slice_.RescaleIntercept = (1, -60) if k % 3 else (2, -160)
        slice_.PixelData = (stored if k % 3 else stored // 2 + 50).astype("<i2").tobytes()

    expected = np.array([plane if k % 3 else (plane + 60) // 2 * 2 - 60 for k, plane in enumerate(RAMP)])
    np.testing.assert_array_equal(read_volume(dicom(tmp_path / "ct", change)).voxels, expected)


@pytest.mark.parametrize("padding", [-2000, 3000, 63536])
def test_pixels_that_show_nothing_become_air_and_it_is_said(tmp_path, padding):
    """63536 is −2000 as some programs write it, unsigned although the pixels are signed."""
    stored = -2000 if padding == 63536 else padding
    voxels = RAMP.copy()
    voxels[:, 0, :2] = stored

    def change(k, slice_):
        slice_.add_new("PixelPaddingValue", "US" if padding == 63536 else "SS", padding)

    volume = read_volume(dicom(tmp_path / "ct", change, voxels))
    assert np.all(volume.voxels[:, 0, :2] == -1024)
    np.testing.assert_array_equal(volume.voxels[:, 1:], RAMP[:, 1:])
    assert volume.notes == ("ct: 12 pixels of PixelPaddingValue, which show nothing, were set to -1024 HU",)


def test_numbers_of_slices_agree_with_their_noun(tmp_path):
    folder = dicom(tmp_path / "ct")
    for number in (3, 2, 1):
        for file in sorted(folder.glob("*.dcm"))[number:]:
            file.unlink()
        noun = "1 slice;" if number == 1 else f"{number} slices;"
        with pytest.raises(InputError, match=f"only {noun}"):
            read_volume(folder)
    shutil.copytree(dicom(tmp_path / "other"), folder / "other")
    with pytest.raises(InputError, match=r"2 DICOM series .*1 slice of 4×5"):
        _renumber(folder)
        read_volume(folder)


def _renumber(folder):
    for file in (folder / "other").glob("*.dcm"):
        slice_ = pydicom.dcmread(file)
        slice_.SeriesNumber, slice_.SeriesInstanceUID = 2, "1.2.3.4"
        slice_.save_as(file)
