"""One rule for the axes of images in every format: straightened and noted below 1e-2, refused beyond."""

from __future__ import annotations

import numpy as np
import pytest
from make_images import CORNERS, ORIGIN, RAMP, SPACING, TURN, dicom, metaimage, nifti, nrrd, places, skewed

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask, read_volume, write_mask
from endopilot.types import LumenMask, Volume


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


@pytest.mark.parametrize("amount", [1.1e-2, 0.3, np.sin(np.radians(20.0))])
def test_sheared_axes_are_refused_by_the_name_of_the_field(tmp_path, made, amount):
    make, field = made
    with pytest.raises(InputError, match=rf"{field}.*not at right angles.*resample") as caught:
        read_volume(make(tmp_path, skewed(amount)))
    assert "\n" not in str(caught.value)


def test_a_gantry_tilt_is_refused_in_every_format(tmp_path, made):
    tilted = np.eye(3)
    tilted[:, 2] = [0.0, np.sin(np.radians(20.0)), np.cos(np.radians(20.0))]
    with pytest.raises(InputError, match=r"off by 20°.*gantry tilt"):
        read_volume(made[0](tmp_path, tilted))


def test_axes_that_are_no_unit_vectors_are_refused(tmp_path):
    with pytest.raises(InputError, match="TransformMatrix holds axes of length 2×2×2"):
        read_volume(metaimage(tmp_path / "two.mha", axes=2.0 * TURN))
    with pytest.raises(InputError, match="ImageOrientationPatient holds axes of length 2×2"):
        read_volume(_dicom_skewed(tmp_path / "two", 2.0 * np.eye(3)))
    (note,) = read_volume(metaimage(tmp_path / "nearly.mha", axes=1.002 * TURN)).notes
    assert "TransformMatrix" in note


@pytest.mark.parametrize("bad", ["nan", "inf", "0", "-0.5"])
def test_numbers_that_are_no_place_are_refused(tmp_path, bad):
    turned = metaimage(tmp_path / "turned.mha", TransformMatrix=f"{bad} 0 0 0 1 0 0 0 1")
    flat = np.c_[np.diag([float(bad), 0.5, 1.25]), ORIGIN]
    sizes = (1, float(bad), 0.5, 1.25, 1, 1, 1, 1)
    files = {
        turned: "TransformMatrix",
        metaimage(tmp_path / "size.mha", ElementSpacing=f"{bad} 1 1"): "ElementSpacing",
        nifti(tmp_path / "qform.nii", sform_code=(0,), qform_code=(1,), pixdim=sizes): "pixdim",
    }
    if bad != "-0.5":  # a negative step is a left-handed grid
        files[nifti(tmp_path / "sform.nii", srow=tuple(flat.ravel()))] = "srow|affine"
        files[nrrd(tmp_path / "steps.nrrd", space_directions=f"({bad},0,0) (0,1,0) (0,0,1)")] = "space directions"
    if bad in ("nan", "inf"):
        files[nrrd(tmp_path / "origin.nrrd", space_origin=f"({bad},0,0)")] = "space origin"
        files[metaimage(tmp_path / "origin.mha", Offset=f"{bad} 0 0")] = "Offset"
        quatern = (float(bad), 0, 0, 0, 0, 0)
        files[nifti(tmp_path / "q.nii", sform_code=(0,), qform_code=(1,), quatern=quatern)] = "quatern"
    for path, field in files.items():
        with pytest.raises(InputError, match=rf"{path.name}: .*({field})"):
            read_volume(path)


def test_a_matrix_of_rank_two_is_refused(tmp_path, made):
    flat = TURN.copy()
    flat[:, 1] = flat[:, 0]
    with pytest.raises(InputError, match="not at right angles"):
        read_volume(made[0](tmp_path, flat))


def test_a_dicom_seg_follows_the_rule(tmp_path):
    pydicom = pytest.importorskip("pydicom")
    pytest.importorskip("highdicom", reason="writes DICOM-SEG")
    write_mask(LumenMask(Volume(RAMP > 0, SPACING, ORIGIN, np.eye(3))), tmp_path / "seg.dcm", manifest={})
    content = pydicom.dcmread(tmp_path / "seg.dcm")
    orientation = content.SharedFunctionalGroupsSequence[0].PlaneOrientationSequence[0]
    orientation.ImageOrientationPatient = [1, 0, 0, 0.002, 1, 0]
    content.save_as(tmp_path / "seg.dcm")
    (tmp_path / "seg.json").unlink()  # which is of the mask as it was
    (note,) = read_mask(tmp_path / "seg.dcm").warnings
    assert "ImageOrientationPatient" in note
    orientation.ImageOrientationPatient = [1, 0, 0, 0.3, 0.954, 0]
    content.save_as(tmp_path / "seg.dcm")
    with pytest.raises(InputError, match=r"ImageOrientationPatient.*not at right angles"):
        read_mask(tmp_path / "seg.dcm")
