"""DICOM series, segments that overlap, and files beside others of like names: each is read itself."""

from __future__ import annotations

import numpy as np
import pytest
from make_images import ORIGIN, RAMP, SPACING, TURN, dicom, metaimage, nifti, nrrd

from endopilot.errors import InputError
from endopilot.files import sha256
from endopilot.imaging.volume import read_mask, read_volume, write_volume
from endopilot.types import Volume
from endopilot.vessels.sources import read_source


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
        ("TemporalPositionIndex", (1, 2), r"TemporalPositionIndex \(1: 6 slices"),
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


def test_a_series_that_holds_one_phase_has_none_to_choose(tmp_path):
    with pytest.raises(InputError, match=r"no phase '75': .*one image at each position; leave --phase out"):
        read_volume(_phases(tmp_path / "ct", "NominalPercentageOfCardiacPhase", (75.0,)), phase="75")


def test_slices_of_several_phases_in_one_volume_are_noted(tmp_path):
    def change(k, slice_):
        slice_.NominalPercentageOfCardiacPhase = 40.0 if k < 3 else 75.0

    (note,) = read_volume(dicom(tmp_path / "ct", change)).notes
    assert "several cardiac phases (NominalPercentageOfCardiacPhase 40, 75)" in note


@pytest.mark.parametrize("kind", ["", "HU_MOD", "Doe^Jane"])
def test_a_rescale_to_hu_is_read_and_one_to_something_else_is_refused(tmp_path, kind):
    def change(k, slice_):
        slice_.RescaleType = kind

    folder = dicom(tmp_path / "ct", change)
    if kind == "Doe^Jane":
        with pytest.raises(InputError, match="RescaleType is not HU") as caught:
            read_volume(folder)
        assert "Doe" not in str(caught.value)
        return
    notes = read_volume(folder).notes
    assert notes == ((f"ct: RescaleType {kind} was taken as HU",) if kind else ())


def test_a_rescale_and_a_sign_of_each_slice(tmp_path):
    def change(k, slice_):
        stored = RAMP[k] + 60
        slice_.PixelRepresentation = k % 2
        slice_.RescaleSlope, slice_.RescaleIntercept = (1, -60) if k % 3 else (2, -160)
        slice_.PixelData = (stored if k % 3 else stored // 2 + 50).astype("<i2").tobytes()

    expected = np.array([plane if k % 3 else (plane + 60) // 2 * 2 - 60 for k, plane in enumerate(RAMP)])
    np.testing.assert_array_equal(read_volume(dicom(tmp_path / "ct", change)).voxels, expected)


@pytest.mark.parametrize("padding", [3000, 63536])
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


_A = (RAMP > -20) & (RAMP < 20)
_B = RAMP > 0


def _slicer(path, layers, segments, **fields):
    keys = {}
    for number, (name, layer, value) in enumerate(segments):
        keys |= {f"Segment{number}_ID": f"id{number}", f"Segment{number}_Name": name}
        if layer is not None:
            keys |= {f"Segment{number}_Layer": layer, f"Segment{number}_LabelValue": value}
    return nrrd(path, voxels=np.asarray(layers, dtype=np.uint8), keys=keys, **fields)


@pytest.mark.parametrize("values", [(1, 2), (3, 3)], ids=str)
def test_overlapping_layers_are_chosen_by_name_or_number(tmp_path, values):
    segments = [("Right coronary artery", 0, values[0]), ("aorta", 1, values[1])]
    path = _slicer(tmp_path / "seg.seg.nrrd", [_A * values[0], _B * values[1]], segments)
    with pytest.raises(InputError, match=r"2 labels \(1 \(Right coronary artery\), 2 \(aorta\)\); .*--label"):
        read_mask(path)
    for label, inside in {"aorta": _B, "Right coronary artery": _A, "AORTA": _B, 1: _A, "2": _B}.items():
        np.testing.assert_array_equal(read_mask(path, label=label).volume.voxels, inside)
    with pytest.raises(InputError, match=r"no voxel has label vein; the file holds 1 \(Right coronary"):
        read_mask(path, label="vein")
    with pytest.raises(InputError, match="a segmentation of 2 layers; give the CT"):
        read_volume(path)


def test_a_segmentation_without_layers_has_a_segment_in_each(tmp_path):
    """Slicer before 4.11 wrote one component a segment, and neither layer nor value."""
    path = _slicer(tmp_path / "old.nrrd", [_A, _B], [("a", None, None), ("b", None, None)])
    volume = read_mask(path, label="b").volume
    np.testing.assert_array_equal(volume.voxels, _B)
    np.testing.assert_allclose(volume.index_to_world(np.zeros(3)), ORIGIN)
    alone = _slicer(tmp_path / "one.nrrd", [_A * 0, _B * 1], [("a", 0, 1), ("b", 1, 1)])
    np.testing.assert_array_equal(read_mask(alone).volume.voxels, _B)  # the only one that holds voxels


def test_two_segments_of_one_name_are_told_apart_by_number_and_odd_numbers_refused(tmp_path):
    with pytest.raises(InputError, match="2 segments are called v; choose one by number"):
        read_mask(_slicer(tmp_path / "seg.nrrd", [_A * 1, _B * 2], [("v", 0, 1), ("v", 1, 2)]), label="v")
    for layer, value in ((0, "x"), ("1.5", 1)):
        with pytest.raises(InputError, match="Segment0 has no whole numbers as LabelValue and Layer"):
            read_mask(_slicer(tmp_path / "odd.nrrd", [_A * 1], [("v", layer, value)]))


def _dicom_seg(path, layers, kind="BINARY", **options):
    hd = pytest.importorskip("highdicom", reason="writes DICOM-SEG")
    pydicom = pytest.importorskip("pydicom")
    write_volume(Volume(RAMP, SPACING, ORIGIN, TURN), path.parent / "ct")
    slices = [pydicom.dcmread(file) for file in sorted((path.parent / "ct").glob("*.dcm"))]
    code = hd.sr.CodedConcept("51114001", "SCT", "Artery")
    count = layers.shape[-1] if layers.ndim == 4 else int(layers.max())
    segments = [hd.seg.SegmentDescription(n + 1, f"Artery {'ab'[n]}", code, code, "MANUAL") for n in range(count)]
    made = hd.seg.Segmentation(slices, layers, kind, segments, hd.UID(), 1, hd.UID(), 1, "x", "x", "1", "1", **options)
    made.save_as(path)
    return path


def _same_places(volume, inside):
    expected = Volume(inside, SPACING, ORIGIN, TURN)
    got, wanted = (
        {tuple(p) for p in v.index_to_world(np.argwhere(v.voxels)[:, ::-1].astype(float)).round(3)}
        for v in (volume, expected)
    )
    return got == wanted


def test_overlapping_segments_of_a_dicom_seg_are_read_whole(tmp_path):
    a, b = _A & (np.indices(RAMP.shape)[0] != 2), _B
    path = _dicom_seg(tmp_path / "two.dcm", np.stack([a, b], axis=-1).astype(np.uint8), omit_empty_frames=True)
    for label, inside in {1: a, "2": b, "Artery a": a, "artery B": b}.items():
        assert _same_places(read_mask(path, label=label).volume, inside)
    with pytest.raises(InputError, match=r"2 labels \(1, 2\)"):
        read_mask(path)


def test_a_fractional_segment_is_cut_at_half_and_it_is_said(tmp_path):
    shares = np.stack([_A * 0.4, _B * 0.6], axis=-1)
    path = _dicom_seg(tmp_path / "part.dcm", shares, "FRACTIONAL", fractional_type="PROBABILITY")
    mask = read_mask(path)  # nothing of the first segment is filled by half
    assert _same_places(mask.volume, _B)
    assert any("fractional" in warning for warning in mask.warnings)


def test_a_label_map_of_dicom(tmp_path):
    path = _dicom_seg(tmp_path / "map.dcm", (_A * 1 + (~_A & _B) * 2).astype(np.uint8), "LABELMAP")
    assert _same_places(read_mask(path, label="Artery b").volume, ~_A & _B)


def test_a_nifti_is_read_itself_beside_its_twin(tmp_path):
    for packed, plain in ((1, 2), (3, 4)):
        nifti(tmp_path / "v.nii.gz", voxels=RAMP + np.int16(packed))
        nifti(tmp_path / "v.nii", voxels=RAMP + np.int16(plain))
        (tmp_path / "v.hdr").write_bytes(b"something else")
        (tmp_path / "v.img").write_bytes(RAMP.tobytes())
        for name, added in (("v.nii.gz", packed), ("v.nii", plain)):
            np.testing.assert_array_equal(read_volume(tmp_path / name).voxels, RAMP + added)
            assert read_volume(tmp_path / name).files == (tmp_path / name,)


@pytest.mark.parametrize("suffix", [".mhd", ".nhdr"])
def test_the_hash_of_a_detached_header_covers_its_voxels(tmp_path, suffix):
    voxels = (RAMP > 0).astype("<i2").tobytes()
    if suffix == ".mhd":
        header = metaimage(tmp_path / "v.mhd", ElementDataFile="v.raw")
    else:
        header = nrrd(tmp_path / "v.nhdr", data_file="v.raw")
        header.write_bytes(header.read_bytes().replace(RAMP.tobytes(), b""))
    (tmp_path / "v.raw").write_bytes(voxels)
    assert read_mask(header).volume.files == (header, tmp_path / "v.raw")
    before = read_source(header).sha256
    (tmp_path / "v.raw").write_bytes((RAMP > 1).astype("<i2").tobytes())
    assert read_source(header).sha256 != before != sha256(header)
