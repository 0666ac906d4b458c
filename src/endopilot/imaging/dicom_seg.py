"""Masks as DICOM segmentation objects (DICOM-SEG, PS3.3 A.51), written with the optional package `highdicom`, without
any UID of the CT, which would lead to its patient."""

from __future__ import annotations

import importlib
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Integer

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.imaging.geometry import plane, slice_grid
from endopilot.imaging.segments import Segment, choose
from endopilot.types import LumenMask, Volume

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

SUFFIX = ".dcm"
_SAME_MM = 1e-3  # frames nearer to each other than this are of one slice


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
    import pydicom  # comes with an extra

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they quote header values
            content = pydicom.dcmread(path)
            numbers, positions, orientation, spacing, step = _frames(content)
            names = {int(s.SegmentNumber): str(s.get("SegmentLabel", "")) for s in content.SegmentSequence}
            kind = str(content.SegmentationType)
            pixels = content.pixel_array.reshape(len(numbers), int(content.Rows), int(content.Columns))
            half = (int(content.MaximumFractionalValue) + 1) // 2 if kind == "FRACTIONAL" else 1
    except Exception:
        # The message may quote the header, so it is not passed on.
        raise InputError(
            f"{path}: cannot be read as a DICOM-SEG of parallel, evenly spaced slices; export the mask as .nii.gz"
        ) from None
    axes, normal = plane(orientation, spacing, path=path)
    slots = _slots(positions @ normal, step, path)
    place = slice_grid(positions, slots, axes, spacing, pixels.shape[1:], path=path)
    present = {number for number, pixel in zip(numbers, pixels, strict=True) if pixel.max() >= half}
    if kind == "LABELMAP":
        present = {int(number) for number in np.unique(pixels) if number > 0}
    if not present:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    numbered = [(number, Segment(names.get(number, ""), 0, number)) for number in sorted(present)]
    # Names are free text, as a series' description is, and may name the patient: they are compared, not shown.
    chosen = choose(numbered, label, path, show_names=False).value
    inside: Bool[np.ndarray, "nz ny nx"] = np.zeros((slots.max() + 1, *pixels.shape[1:]), dtype=bool)
    for slot, number, pixel in zip(slots, numbers, pixels, strict=True):
        if kind == "LABELMAP":
            inside[slot] |= pixel == chosen
        elif number == chosen:
            inside[slot] |= pixel >= half
    if kind == "FRACTIONAL":
        note = f"{path.name}: a fractional segment; voxels that it fills by half or more were taken"
        place = replace(place, notes=(*place.notes, note))
    return place.volume(inside, (path,))


def _frames(content: Dataset) -> tuple[list[int], np.ndarray, tuple[float, ...], tuple[float, ...], float]:
    """Return each frame's ReferencedSegmentNumber (0 in a label map) and ImagePositionPatient; of all
    ImageOrientationPatient, PixelSpacing and SpacingBetweenSlices (0 if absent), mm. Any error means an unreadable
    object."""
    shared = content.SharedFunctionalGroupsSequence[0]

    def item(frame: Dataset, name: str) -> Dataset:
        return (frame if name in frame else shared)[name].value[0]

    numbers: list[int] = []
    positions, planes = [], set()
    for frame in content.PerFrameFunctionalGroupsSequence:
        identified = "SegmentIdentificationSequence" in frame or "SegmentIdentificationSequence" in shared
        numbers.append(int(item(frame, "SegmentIdentificationSequence").ReferencedSegmentNumber) if identified else 0)
        positions.append([float(x) for x in item(frame, "PlanePositionSequence").ImagePositionPatient])
        measures = item(frame, "PixelMeasuresSequence")
        orientation = item(frame, "PlaneOrientationSequence").ImageOrientationPatient
        step = float(measures.get("SpacingBetweenSlices") or 0.0)
        planes.add((*map(float, orientation), *map(float, measures.PixelSpacing), step))
    (common,) = planes  # more are frames of several grids
    places = np.array(positions).reshape(len(numbers), 3)
    if len(common) != 9 or not np.isfinite(places).all() or len({*zip(numbers, *places.T, strict=True)}) < len(places):
        raise ValueError("several frames at one place, or none")
    return numbers, places, common[:6], common[6:8], common[8]


def _slots(heights: Float[np.ndarray, "frames"], step_mm: float, path: Path) -> Integer[np.ndarray, "frames"]:
    """Return the slice of each frame from its height along the normal, mm; empty slices may be left out."""
    order = np.argsort(heights, kind="stable")
    begins = np.diff(heights[order], prepend=-np.inf) > _SAME_MM
    place_of = (np.cumsum(begins) - 1)[np.argsort(order)]
    distances = np.diff(heights[order][begins])
    if not distances.size:
        raise InputError(f"{path}: all frames are of one slice; give a mask of a volume")
    steps = np.round(distances / (step_mm or distances.min())).astype(int)
    if steps.min() < 1:
        raise InputError(f"{path}: ImagePositionPatient of its frames are not evenly spaced; export it as .nii.gz")
    if (multiple := int(np.gcd.reduce(steps))) > 1:
        raise InputError(
            f"{path}: SpacingBetweenSlices is {step_mm:g} mm, but all frames lie {multiple} times as far apart; "
            "export it as .nii.gz"
        )
    return np.concatenate([[0], np.cumsum(steps)])[place_of]
