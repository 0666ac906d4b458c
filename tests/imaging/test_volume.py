from __future__ import annotations

import gzip
import json

import numpy as np
import pytest
import SimpleITK as sitk

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask, read_volume, write_mask, write_volume
from endopilot.types import Insertion, LumenMask, Volume


def _oblique_volume(dtype=np.int16) -> Volume:
    """Return an anisotropic volume turned by 20° about z, with the values of a linear ramp in LPS mm."""
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    direction = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    volume = Volume(np.zeros((5, 6, 7)), np.array([0.4, 0.5, 1.25]), np.array([-30.0, 12.0, 700.0]), direction)
    k, j, i = np.indices((5, 6, 7))
    world = volume.index_to_world(np.stack([i, j, k], axis=-1).astype(float))
    ramp = np.round(world @ [10.0, -7.0, 1.0])
    return Volume(ramp.astype(dtype), volume.spacing_mm, volume.origin_mm, direction)


def _image(voxels: np.ndarray, **keywords) -> sitk.Image:
    return sitk.GetImageFromArray(voxels, **keywords)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".nrrd", ".mha"])
def test_a_volume_survives_writing_and_reading(tmp_path, suffix):
    volume = _oblique_volume()
    write_volume(volume, tmp_path / f"ct{suffix}")
    again = read_volume(tmp_path / f"ct{suffix}")
    assert again.voxels.dtype == np.int16
    np.testing.assert_array_equal(again.voxels, volume.voxels)
    np.testing.assert_allclose(again.spacing_mm, volume.spacing_mm, atol=1e-5)
    np.testing.assert_allclose(again.origin_mm, volume.origin_mm, atol=1e-3)
    np.testing.assert_allclose(again.direction, volume.direction, atol=1e-5)


def test_ras_becomes_lps(tmp_path):
    """A NIfTI affine of diag(2, 2, 2) with offset (10, 20, 30) is RAS: its x and y change sign in LPS."""
    voxels = np.zeros((4, 4, 4), dtype="<i2")
    header = np.zeros(352, dtype=np.uint8)
    header[0:4] = np.frombuffer(np.int32(348).tobytes(), np.uint8)
    header[40:56] = np.frombuffer(np.array([3, 4, 4, 4, 1, 1, 1, 1], "<i2").tobytes(), np.uint8)
    header[70:74] = np.frombuffer(np.array([4, 16], "<i2").tobytes(), np.uint8)
    header[76:108] = np.frombuffer(np.array([1, 2, 2, 2, 1, 1, 1, 1], "<f4").tobytes(), np.uint8)
    header[108:120] = np.frombuffer(np.array([352, 3, -1024], "<f4").tobytes(), np.uint8)
    header[123] = 2
    header[254:256] = np.frombuffer(np.int16(1).tobytes(), np.uint8)
    affine = np.array([[2, 0, 0, 10], [0, 2, 0, 20], [0, 0, 2, 30]], "<f4")
    header[280:328] = np.frombuffer(affine.tobytes(), np.uint8)
    header[344:348] = np.frombuffer(b"n+1\0", np.uint8)
    (tmp_path / "ras.nii").write_bytes(header.tobytes() + voxels.tobytes())
    volume = read_volume(tmp_path / "ras.nii")
    np.testing.assert_allclose(volume.index_to_world(np.array([1.0, 2.0, 3.0])), [-12.0, -24.0, 36.0])
    assert np.all(volume.voxels == -1024)  # slope 3 and intercept −1024 are applied


def test_a_fraction_of_a_hu_is_kept(tmp_path):
    write_volume(_oblique_volume(np.float32), tmp_path / "ct.nrrd")
    assert read_volume(tmp_path / "ct.nrrd").voxels.dtype == np.float32


def test_a_four_dimensional_file_with_one_phase_is_read(tmp_path):
    sitk.WriteImage(_image(np.zeros((1, 4, 5, 6), np.int16), isVector=False), tmp_path / "one.nii.gz")
    assert read_volume(tmp_path / "one.nii.gz").voxels.shape == (4, 5, 6)


def test_bad_volumes_are_refused_in_one_line(tmp_path):
    sitk.WriteImage(_image(np.zeros((3, 4, 5, 6), np.int16), isVector=False), tmp_path / "four.nii.gz")
    sitk.WriteImage(_image(np.zeros((4, 5, 6, 3), np.uint8), isVector=True), tmp_path / "rgb.nrrd")
    sitk.WriteImage(_image(np.zeros((6, 6), np.int16)), tmp_path / "slice.mha")
    write_volume(_oblique_volume(), tmp_path / "whole.nii.gz")
    write_volume(_oblique_volume(), tmp_path / "whole.nii")
    write_volume(_oblique_volume(), tmp_path / "whole.mha")
    write_volume(_oblique_volume(), tmp_path / "whole.nrrd")
    for suffix in ("nii.gz", "nii", "mha", "nrrd"):
        content = (tmp_path / f"whole.{suffix}").read_bytes()
        (tmp_path / f"cut.{suffix}").write_bytes(content[: len(content) - len(content) // 3])
    (tmp_path / "text.nii.gz").write_bytes(gzip.compress(b"not an image"))
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    nan = _oblique_volume(np.float32)
    nan.voxels[1, 2, 3] = np.nan
    write_volume(nan, tmp_path / "nan.nrrd")
    (tmp_path / "empty").mkdir()
    for name, expected in {
        "nowhere.nii.gz": "no such file",
        "four.nii.gz": "4-D .6×5×4×3.*3-D volume",
        "rgb.nrrd": "3 values in every voxel",
        "slice.mha": "no volume",
        "cut.nii.gz": "truncated or damaged",
        "cut.nii": "truncated or damaged",
        "cut.mha": "truncated or damaged",
        "cut.nrrd": "truncated or damaged",
        "text.nii.gz": "does not match its suffix",
        "photo.jpg": "unknown format",
        "nan.nrrd": "not finite",
        "empty": "no DICOM image",
    }.items():
        with pytest.raises(InputError, match=expected) as caught:
            read_volume(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert name in str(caught.value)


def test_series_is_only_for_dicom(tmp_path):
    write_volume(_oblique_volume(), tmp_path / "ct.nrrd")
    with pytest.raises(InputError, match="only DICOM has series"):
        read_volume(tmp_path / "ct.nrrd", series="3")


def test_an_unknown_output_suffix_writes_nothing(tmp_path):
    for write in (
        lambda path: write_volume(_oblique_volume(), path),
        lambda path: write_mask(_mask(), path, manifest={}),
    ):
        with pytest.raises(InputError, match="unknown format"):
            write(tmp_path / "ct.png")
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(image, path, **_):
        path.write_bytes(b"half")
        raise RuntimeError("disk full")

    monkeypatch.setattr(sitk, "WriteImage", fail)
    with pytest.raises(InputError, match="disk is not full"):
        write_volume(_oblique_volume(), tmp_path / "ct.nii.gz")
    assert not list(tmp_path.iterdir())


def _mask() -> LumenMask:
    ramp = _oblique_volume()
    inside = Volume(ramp.voxels > np.median(ramp.voxels), ramp.spacing_mm, ramp.origin_mm, ramp.direction)
    ostium = Insertion(np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.8]))
    return LumenMask(inside, ostium, "coronary")


def test_a_mask_keeps_its_ostium_and_method(tmp_path):
    mask = _mask()
    write_mask(mask, tmp_path / "rca.nii.gz", manifest={"seed": 7})
    again = read_mask(tmp_path / "rca.nii.gz")
    assert again.volume.voxels.dtype == bool
    np.testing.assert_array_equal(again.volume.voxels, mask.volume.voxels)
    assert again.ostium is not None and mask.ostium is not None
    np.testing.assert_allclose(again.ostium.position, mask.ostium.position)
    np.testing.assert_allclose(again.ostium.direction, mask.ostium.direction)
    assert again.method == "coronary"
    assert json.loads((tmp_path / "rca.json").read_text())["manifest"] == {"seed": 7}


def test_a_mask_without_sidecar_or_with_a_stranger_beside_it_has_no_ostium(tmp_path):
    write_volume(_mask().volume, tmp_path / "rca.nrrd")
    assert read_mask(tmp_path / "rca.nrrd").ostium is None
    (tmp_path / "rca.json").write_text('{"Modality": "CT"}')
    assert read_mask(tmp_path / "rca.nrrd").method == "given"


def test_a_broken_sidecar_is_refused(tmp_path):
    write_volume(_mask().volume, tmp_path / "rca.nrrd")
    for ostium in ('{"position_mm": [1, 2]}', '{"position_mm": [1, 2, 3], "direction": [0, 0, 0]}', "5"):
        (tmp_path / "rca.json").write_text(f'{{"ostium": {ostium}}}')
        with pytest.raises(InputError, match=r"rca\.json: ostium needs position_mm and direction"):
            read_mask(tmp_path / "rca.nrrd")


def test_one_label_of_several_is_chosen(tmp_path):
    labels = np.zeros((5, 6, 7), np.uint8)
    labels[1:3], labels[3:] = 2, 5
    sitk.WriteImage(_image(labels), tmp_path / "labels.nii.gz")
    with pytest.raises(InputError, match=r"2 labels \(2, 5\); choose one: label=N \(--label N\)"):
        read_mask(tmp_path / "labels.nii.gz")
    np.testing.assert_array_equal(read_mask(tmp_path / "labels.nii.gz", label=5).volume.voxels, labels == 5)
    with pytest.raises(InputError, match="no voxel has label 3"):
        read_mask(tmp_path / "labels.nii.gz", label=3)


def test_what_is_no_mask_is_refused(tmp_path):
    sitk.WriteImage(_image(np.zeros((5, 6, 7), np.uint8)), tmp_path / "empty.nii.gz")
    sitk.WriteImage(_image(np.full((5, 6, 7), -90, np.int16)), tmp_path / "ct.nii.gz")
    sitk.WriteImage(_image(np.full((5, 6, 7), 0.5, np.float32)), tmp_path / "probability.nii.gz")
    for name, expected in {"empty": "mask is empty", "ct": "are no mask", "probability": "are no mask"}.items():
        with pytest.raises(InputError, match=expected):
            read_mask(tmp_path / f"{name}.nii.gz")
    with pytest.raises(InputError, match="no such file"):
        read_mask(tmp_path / "nowhere.nii.gz")
