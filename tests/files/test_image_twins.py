"""A file is read itself, whatever lies beside it, and its hash is that of the bytes that were read."""

from __future__ import annotations

import numpy as np
import pytest
from make_images import RAMP, metaimage, nifti, nrrd

from endopilot.errors import InputError
from endopilot.files import sha256
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.vessels.read_source import read_source


def test_a_nifti_is_read_itself_beside_its_twin(tmp_path):
    for packed, plain in ((1, 2), (3, 4)):
        nifti(tmp_path / "v.nii.gz", voxels=RAMP + np.int16(packed))
        nifti(tmp_path / "v.nii", voxels=RAMP + np.int16(plain))
        (tmp_path / "v.hdr").write_bytes(b"something else")
        (tmp_path / "v.img").write_bytes(RAMP.tobytes())
        for name, added in (("v.nii.gz", packed), ("v.nii", plain)):
            np.testing.assert_array_equal(read_volume(tmp_path / name).voxels, RAMP + added)
            assert read_volume(tmp_path / name).files == (tmp_path / name,)


def test_the_hash_of_a_mask_is_that_of_the_file_read(tmp_path):
    nifti(tmp_path / "v.nii.gz", voxels=(RAMP > 0).astype("<i2"))
    nifti(tmp_path / "v.nii", voxels=(RAMP > 20).astype("<i2"))
    source = read_source(tmp_path / "v.nii.gz")
    assert source.sha256 == sha256(tmp_path / "v.nii.gz")
    assert source.content.volume.voxels.sum() == (RAMP > 0).sum()


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


def test_a_folder_in_place_of_the_voxels_is_refused(tmp_path):
    (tmp_path / "v.raw").mkdir()
    with pytest.raises(InputError, match=r"missing \(v.raw\)"):
        read_volume(metaimage(tmp_path / "v.mhd", ElementDataFile="v.raw"))
