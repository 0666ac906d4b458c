"""Damaged image files: read right, read with a note, or refused in one line, and never a word on standard error."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_fuzz import bounded, damaged, outcome
from make_images import CORNERS, RAMP, TURN, dicom, metaimage, nifti, nrrd, places

from endopilot.imaging.volume import read_mask, read_volume
from endopilot.types import Volume

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
