"""Masks as DICOM segmentation objects (DICOM-SEG, PS3.3 A.51), with the optional package `highdicom`.

The object carries its own geometry, on the grid of the mask, and no UID of the CT that it was made from: a study's UIDs
lead to its patient.
"""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Integer

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.types import LumenMask, Volume

SUFFIX = ".dcm"


def need_highdicom(path: Path) -> Any:
    """Return the package `highdicom`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module("highdicom")
    except ImportError as error:
        raise InputError(
            f"{path}: DICOM-SEG needs the package highdicom; pip install 'endopilot[dicom-seg]', or use .nii.gz"
        ) from error


def write_seg(mask: LumenMask, path: Path) -> None:
    """Write a mask as a binary DICOM-SEG object with one segment, empty slices included.

    Raises:
        InputError: highdicom is absent, or the file cannot be written.
    """
    hd = need_highdicom(path)
    from pydicom.sr.codedict import codes

    from endopilot.imaging.dicom_write import slice_headers  # pydicom comes with an extra

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
    with writing(path) as partial:
        content.save_as(partial)


def read_seg(path: Path) -> Volume:
    """Read a DICOM-SEG object as a volume of segment numbers, 0 outside; where segments overlap, the highest wins.

    Raises:
        InputError: highdicom is absent, or the file is damaged, no segmentation, or not on a regular grid.
    """
    hd = need_highdicom(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they quote header values
            content = hd.seg.segread(path)
            stack = content.get_volume(skip_overlap_checks=True)
            numbers = np.array(content.segment_numbers)
    except Exception:
        # The message may quote the header, so it is not passed on.
        raise InputError(
            f"{path}: cannot be read as a DICOM-SEG of parallel, evenly spaced slices; export the mask as .nii.gz"
        ) from None
    affine = np.asarray(stack.affine)[:3]
    spacing = np.linalg.norm(affine[:, :3], axis=0)
    return Volume(
        _numbered(np.asarray(stack.array), numbers), spacing[::-1], affine[:, 3], (affine[:, :3] / spacing)[:, ::-1]
    )


def _numbered(stack: np.ndarray, numbers: Integer[np.ndarray, "n"]) -> Integer[np.ndarray, "nz ny nx"]:
    """Return the number of the segment that holds each voxel: at least half, where segments are fractional."""
    if stack.ndim == 3:
        return stack.astype(np.int16)
    result = np.zeros(stack.shape[:3], dtype=np.int16)
    for number, layer in zip(numbers, np.moveaxis(stack, -1, 0), strict=True):
        inside: Bool[np.ndarray, "nz ny nx"] = layer >= 0.5
        result[inside] = number
    return result
