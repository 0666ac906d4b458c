"""Segments that overlap, in layers of a Seg.nrrd or frames of a DICOM-SEG: each is read whole, by number or name."""

from __future__ import annotations

import numpy as np
import pytest
from make_images import ORIGIN, RAMP, SPACING, TURN, nrrd

from endopilot.errors import InputError
from endopilot.imaging.volume import read_mask, read_volume, write_volume
from endopilot.types import Volume

_A = (RAMP > -20) & (RAMP < 20)
_B = RAMP > 0


def _slicer(path, layers, segments, **fields):
    keys = {}
    for number, (name, layer, value) in enumerate(segments):
        keys |= {f"Segment{number}_ID": f"id{number}", f"Segment{number}_Name": name}
        if layer is not None:
            keys |= {f"Segment{number}_Layer": layer, f"Segment{number}_LabelValue": value}
    return nrrd(path, voxels=np.asarray(layers, dtype=np.uint8), keys=keys, **fields)


@pytest.mark.parametrize("values", [(1, 2), (1, 1), (3, 3)], ids=str)
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


def test_layers_lie_where_the_header_puts_them(tmp_path):
    path = _slicer(tmp_path / "seg.nrrd", [_A, _B], [("a", 0, 1), ("b", 1, 1)])
    volume = read_mask(path, label="b").volume
    np.testing.assert_allclose(volume.direction, TURN)
    np.testing.assert_allclose(volume.spacing_mm, SPACING)
    np.testing.assert_allclose(volume.origin_mm, ORIGIN)


def test_segments_of_one_layer_have_names_too(tmp_path):
    path = _slicer(tmp_path / "seg.nrrd", _A * 1 + (~_A & _B) * 4, [("rca", 0, 1), ("lca", 0, 4), ("none", 0, 6)])
    for label in ("lca", 4, "4"):
        np.testing.assert_array_equal(read_mask(path, label=label).volume.voxels, ~_A & _B)


def test_a_segmentation_without_layers_has_a_segment_in_each(tmp_path):
    """Slicer before 4.11 wrote one component a segment, and neither layer nor value."""
    path = _slicer(tmp_path / "old.nrrd", [_A, _B], [("a", None, None), ("b", None, None)])
    np.testing.assert_array_equal(read_mask(path, label="b").volume.voxels, _B)


def test_the_one_segment_that_holds_voxels_needs_no_choice(tmp_path):
    path = _slicer(tmp_path / "seg.nrrd", [_A * 0, _B * 1], [("a", 0, 1), ("b", 1, 1)])
    np.testing.assert_array_equal(read_mask(path).volume.voxels, _B)


def test_two_segments_of_one_name_are_told_apart_by_number(tmp_path):
    path = _slicer(tmp_path / "seg.nrrd", [_A, _B], [("v", 0, 1), ("v", 1, 2)], type="uint8")
    path.write_bytes(path.read_bytes())
    with pytest.raises(InputError, match="2 segments are called v; choose one by number"):
        read_mask(_slicer(tmp_path / "seg.nrrd", [_A * 1, _B * 2], [("v", 0, 1), ("v", 1, 2)]), label="v")


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


@pytest.mark.parametrize("omit", [False, True])
def test_overlapping_segments_of_a_dicom_seg_are_read_whole(tmp_path, omit):
    a, b = _A & (np.indices(RAMP.shape)[0] != 2), _B
    path = _dicom_seg(tmp_path / "two.dcm", np.stack([a, b], axis=-1).astype(np.uint8), omit_empty_frames=omit)
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
