from __future__ import annotations

import sys

import numpy as np
import pydicom
import pytest
from scipy.spatial.transform import Rotation

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask, read_volume, write_mask, write_volume
from endopilot.types import Insertion, LumenMask, Volume

hd = pytest.importorskip("highdicom", reason="DICOM-SEG needs highdicom (the extra dicom-seg)")


def _mask(*, left_handed: bool = False) -> LumenMask:
    """Return a mask on an anisotropic oblique grid, empty in its first and last slices, with a slice missing within."""
    direction = Rotation.from_euler("xyz", [12, -7, 20], degrees=True).as_matrix()
    if left_handed:
        direction = direction * [1.0, 1.0, -1.0]
    voxels = np.random.default_rng(1).random((9, 13, 11)) > 0.7
    voxels[[0, 1, 4, 8]] = False
    volume = Volume(voxels, np.array([0.35, 0.390625, 0.75]), np.array([-81.123456, 12.5, 1080.54321]), direction)
    return LumenMask(volume, Insertion(np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.8])), "coronary")


def _places(mask: LumenMask) -> np.ndarray:
    """Return the LPS positions of the voxels inside, in an order that does not depend on the grid's."""
    points = mask.volume.index_to_world(np.argwhere(mask.volume.voxels)[:, ::-1].astype(float))
    return points[np.lexsort(points.round(3).T)]


@pytest.mark.parametrize("left_handed", [False, True])
def test_a_mask_survives_as_dicom_seg_with_its_grid(tmp_path, left_handed):
    mask = _mask(left_handed=left_handed)
    write_mask(mask, tmp_path / "rca.dcm", manifest={})
    again = read_mask(tmp_path / "rca.dcm")
    assert again.volume.voxels.shape == mask.volume.voxels.shape
    np.testing.assert_allclose(_places(again), _places(mask), atol=1e-6)
    np.testing.assert_allclose(again.volume.spacing_mm, mask.volume.spacing_mm, atol=1e-6)
    assert again.ostium is not None and again.method == "coronary"
    np.testing.assert_allclose(again.ostium.position, [1.0, 2.0, 3.0])


def test_it_is_a_segmentation_that_names_no_other_image(tmp_path):
    write_mask(_mask(), tmp_path / "rca.dcm", manifest={})
    content = pydicom.dcmread(tmp_path / "rca.dcm")
    assert content.Modality == "SEG" and content.SegmentationType == "BINARY"
    assert [segment.SegmentLabel for segment in content.SegmentSequence] == ["lumen"]
    for element in content.iterall():
        assert element.keyword not in ("ReferencedSOPInstanceUID", "InstitutionName")
        assert element.value in (None, "") or not element.keyword.startswith("Patient") or element.tag.group != 0x10
    with pytest.raises(InputError, match="modality SEG"):
        read_volume(tmp_path / "rca.dcm")


def test_what_is_no_segmentation_is_refused(tmp_path):
    write_volume(Volume(np.zeros((4, 8, 8), np.int16), np.ones(3), np.zeros(3), np.eye(3)), tmp_path / "ct")
    write_mask(_mask(), tmp_path / "rca.dcm", manifest={})
    (tmp_path / "cut.dcm").write_bytes((tmp_path / "rca.dcm").read_bytes()[:900])
    (tmp_path / "text.dcm").write_text("not DICOM")
    for path in (tmp_path / "ct" / "slice-0001.dcm", tmp_path / "cut.dcm", tmp_path / "text.dcm"):
        with pytest.raises(InputError, match=rf"{path.name}: cannot be read as a DICOM-SEG"):
            read_mask(path)


def test_without_highdicom_the_extra_is_named(tmp_path, monkeypatch):
    write_mask(_mask(), tmp_path / "rca.dcm", manifest={})
    monkeypatch.setitem(sys.modules, "highdicom", None)
    for work in (lambda: read_mask(tmp_path / "rca.dcm"), lambda: write_mask(_mask(), tmp_path / "n.dcm", manifest={})):
        with pytest.raises(InputError, match=r"needs the package highdicom; pip install 'endopilot\[dicom-seg\]'"):
            work()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["rca.dcm", "rca.json"]
