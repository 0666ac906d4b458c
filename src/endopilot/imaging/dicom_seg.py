"""Masks as DICOM segmentation objects (DICOM-SEG, PS3.3 A.51), read and written with the optional package `highdicom`,
without any UID of the CT, which would lead to its patient."""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.imaging.geometry import parted, placed
from endopilot.imaging.segments import Segment, choose
from endopilot.types import LumenMask, Volume

SUFFIX = ".dcm"
_HALF = 0.5


def need_highdicom(path: Path) -> Any:
    """Return the package `highdicom`, or raise InputError where it is not installed."""
    try:
        return importlib.import_module("highdicom")
    except ImportError as error:
        raise InputError(
            f"{path}: DICOM-SEG needs the package highdicom; pip install 'endopilot[dicom-seg]', or use .nii.gz"
        ) from error


def write_seg(mask: LumenMask, path: Path) -> None:
    """Write a mask as a binary DICOM-SEG object with one segment, empty slices included."""
    hd = need_highdicom(path)
    from pydicom.sr.codedict import codes

    from endopilot.imaging.dicom_write import save, slice_headers  # pydicom comes with an extra

    volume = mask.volume
    header = slice_headers(volume)[0]
    affine = np.eye(4)
    affine[:3, :3] = (volume.direction * volume.spacing_mm)[:, ::-1]
    affine[:3, 3] = volume.origin_mm
    array = hd.Volume(
        volume.voxels.astype(np.uint8), affine, "PATIENT", frame_of_reference_uid=header.FrameOfReferenceUID
    )
    segment = hd.seg.SegmentDescription(
        1,
        "lumen",
        codes.SCT.AnatomicalStructure,
        codes.SCT.Artery,
        hd.seg.SegmentAlgorithmTypeValues.AUTOMATIC,
        hd.AlgorithmIdentificationSequence(mask.method, codes.cid7162.EdgeDetection, __version__),
    )
    content = hd.seg.Segmentation(
        source_images=[header],
        pixel_array=array,
        segmentation_type=hd.seg.SegmentationTypeValues.BINARY,
        segment_descriptions=[segment],
        series_instance_uid=hd.UID(),
        series_number=2,
        sop_instance_uid=hd.UID(),
        instance_number=1,
        manufacturer="endopilot",
        manufacturer_model_name="endopilot",
        software_versions=__version__,
        device_serial_number="0",
        content_label="LUMEN",
        omit_empty_frames=False,
    )
    # highdicom needs a source image; there is none that may be named.
    del content.ReferencedSeriesSequence
    del content.SourceImageSequence
    save(content, path)


def read_seg(path: Path, label: int | str | None = None) -> Volume:
    """Read one segment of a DICOM-SEG object, by number or SegmentLabel, as booleans; of a fractional one, voxels that
    it fills by half or more. Raises InputError for a damaged or another file, an irregular grid, or no such segment."""
    hd = need_highdicom(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they quote header values
            content = hd.seg.segread(path)
            names = {n: str(content.get_segment_description(n).segment_label) for n in content.segment_numbers}
            # One segment at a time: all together may be larger than the memory.
            present = [n for n in names if (_shares(content, n).array >= _HALF).any()]
    except Exception:
        # The message may quote the header, so it is not passed on.
        raise InputError(
            f"{path}: cannot be read as a DICOM-SEG of parallel, evenly spaced slices; export the mask as .nii.gz"
        ) from None
    if not present:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    # Names are free text, as a series' description is, and may name the patient: they are compared, not shown.
    chosen = choose([(n, Segment(names[n], 0, n)) for n in present], label, path, show_names=False).value
    found, note = (
        _shares(content, chosen),
        f"{path.name}: a fractional segment; voxels that it fills by half or more were taken",
    )
    fractional = content.SegmentationType == "FRACTIONAL"
    return placed(
        found.array[..., 0] >= _HALF,
        *parted(found.affine[:3, 2::-1]),
        found.affine[:3, 3],
        path=path,
        fields=("ImageOrientationPatient", "PixelSpacing", "ImagePositionPatient"),
        notes=(note,) if fractional else (),
        files=(path,),
    )


def _shares(content: Any, number: int) -> Any:
    """Return by how much a segment fills each voxel, on the grid of all segments: i, j and k, the last of highdicom's
    axes first, are right-handed."""
    return content.get_volume(segment_numbers=[number]).ensure_handedness("LEFT_HANDED", flip_axis=0)
