"""Masks as DICOM segmentation objects (DICOM-SEG, PS3.3 A.51), written with the optional package `highdicom`.

The object carries its own geometry, on the grid of the mask, and no UID of the CT that it was made from: a study's UIDs
lead to its patient.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Integer

from endopilot import __version__
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.imaging.geometry import Fields, Geometry, geometry, plane
from endopilot.imaging.segments import Segment, choose
from endopilot.types import LumenMask, Volume

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

SUFFIX = ".dcm"
_SAME_MM = 1e-3
"""Frames nearer to each other than this are of one slice."""
_SPACING_TOLERANCE = 0.05
"""Distances of frames may err by this share of the step: positions are written with few digits."""


@dataclass(frozen=True)
class _Frame:
    """What the header says of one frame.

    Attributes:
        number: ReferencedSegmentNumber; 0 in a label map.
        position: ImagePositionPatient, LPS mm.
        orientation: ImageOrientationPatient.
        spacing_mm: PixelSpacing: between rows, between columns.
        step_mm: SpacingBetweenSlices; 0 where it is absent.
    """

    number: int
    position: tuple[float, ...]
    orientation: tuple[float, ...]
    spacing_mm: tuple[float, ...]
    step_mm: float


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


def read_seg(path: Path, label: int | str | None = None) -> Volume:
    """Read one segment of a DICOM-SEG object, whatever other segments overlap it, as a volume of booleans.

    Of a fractional segment, voxels that it fills by half or more are taken, and a note says so.

    Args:
        path: the file.
        label: number or SegmentLabel of the segment; None where there is but one.

    Raises:
        InputError: the file is damaged, no segmentation, or not on a regular grid, or the segment is not there.
    """
    import pydicom  # comes with an extra

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they quote header values
            content = pydicom.dcmread(path)
            frames = _frames(content)
            names = {int(s.SegmentNumber): str(s.get("SegmentLabel", "")) for s in content.SegmentSequence}
            kind = str(content.SegmentationType)
            pixels = content.pixel_array.reshape(len(frames), int(content.Rows), int(content.Columns))
            half = (int(content.MaximumFractionalValue) + 1) // 2 if kind == "FRACTIONAL" else 1
    except Exception:
        # The message may quote the header, so it is not passed on.
        raise InputError(
            f"{path}: cannot be read as a DICOM-SEG of parallel, evenly spaced slices; export the mask as .nii.gz"
        ) from None
    place, size_k, slots = _grid(frames, pixels.shape[1:], path)
    present = _present(pixels, half, frames, kind)
    if not present:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    numbered = [(number, Segment(names.get(number, ""), 0, number)) for number in sorted(present)]
    # Names are free text, as a series' description is, and may name the patient: they are compared, not shown.
    chosen = choose(numbered, label, path, show_names=False).value
    inside: Bool[np.ndarray, "nz ny nx"] = np.zeros((size_k, *pixels.shape[1:]), dtype=bool)
    for slot, frame, pixel in zip(slots, frames, pixels, strict=True):
        if kind == "LABELMAP":
            inside[slot] |= pixel == chosen
        elif frame.number == chosen:
            inside[slot] |= pixel >= half
    notes = place.notes
    if kind == "FRACTIONAL":
        notes += (f"{path.name}: a fractional segment; voxels that it fills by half or more were taken",)
    return Volume(inside, place.spacing_mm, place.origin_mm, place.direction, notes, (path,))


def _frames(content: Dataset) -> list[_Frame]:
    """Return the geometry of every frame; any error means that the object is none that can be read."""
    shared = content.SharedFunctionalGroupsSequence[0]

    def item(frame: Dataset, name: str) -> Dataset:
        return (frame if name in frame else shared)[name].value[0]

    frames = []
    for frame in content.PerFrameFunctionalGroupsSequence:
        identified = "SegmentIdentificationSequence" in frame or "SegmentIdentificationSequence" in shared
        measures = item(frame, "PixelMeasuresSequence")
        frames.append(
            _Frame(
                number=int(item(frame, "SegmentIdentificationSequence").ReferencedSegmentNumber) if identified else 0,
                position=tuple(float(x) for x in item(frame, "PlanePositionSequence").ImagePositionPatient),
                orientation=tuple(float(x) for x in item(frame, "PlaneOrientationSequence").ImageOrientationPatient),
                spacing_mm=tuple(float(x) for x in measures.PixelSpacing),
                step_mm=float(measures.get("SpacingBetweenSlices") or 0.0),
            )
        )
    if not frames or {len(frame.position) for frame in frames} != {3} or len(frames[0].orientation) != 6:
        raise ValueError("no frames with a place")
    places = {(frame.number, frame.position) for frame in frames}
    if not np.isfinite([frame.position for frame in frames]).all() or len(places) < len(frames):
        raise ValueError("several frames at one place, or none")
    if len(frames[0].spacing_mm) != 2 or len({(frame.orientation, frame.spacing_mm) for frame in frames}) != 1:
        raise ValueError("frames of several grids")
    return frames


def _grid(
    frames: Sequence[_Frame], size: tuple[int, ...], path: Path
) -> tuple[Geometry, int, Integer[np.ndarray, "frames"]]:
    """Return where the voxels lie, the number of slices, and the slice of each frame; empty slices may be left out.

    Raises:
        InputError: frames are not at whole numbers of steps from the first.
    """
    first = frames[0]
    axes, normal = plane(first.orientation, first.spacing_mm, path=path)
    positions = np.array([frame.position for frame in frames])
    heights = positions @ normal
    order = np.argsort(heights, kind="stable")
    begins = np.diff(heights[order], prepend=-np.inf) > _SAME_MM
    place_of = (np.cumsum(begins) - 1)[np.argsort(order)]
    distances = np.diff(heights[order][begins])
    if not distances.size:
        raise InputError(f"{path}: all frames are of one slice; give a mask of a volume")
    # Without SpacingBetweenSlices, the least distance is the step.
    step = first.step_mm or float(distances.min())
    steps = np.round(distances / step)
    if np.abs(distances / step - steps).max() > _SPACING_TOLERANCE or steps.min() < 1:
        raise InputError(f"{path}: ImagePositionPatient of its frames are not evenly spaced; export it as .nii.gz")
    slots = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    along_k = (positions[heights.argmax()] - positions[heights.argmin()]) / slots[-1]
    length = float(np.linalg.norm(along_k))
    place = geometry(
        np.column_stack([axes, along_k / length]),
        np.array([first.spacing_mm[1], first.spacing_mm[0], length]),
        positions[heights.argmin()],
        (size[1], size[0], int(slots[-1]) + 1),
        path=path,
        fields=Fields("ImageOrientationPatient and ImagePositionPatient", "PixelSpacing", "ImagePositionPatient"),
    )
    if (multiple := int(np.gcd.reduce(steps.astype(int)))) > 1:
        raise InputError(
            f"{path}: SpacingBetweenSlices is {first.step_mm:g} mm, but all frames lie {multiple} times as far apart; "
            "export it as .nii.gz"
        )
    return place, int(slots[-1]) + 1, slots[place_of]


def _present(pixels: np.ndarray, half: int, frames: Sequence[_Frame], kind: str) -> set[int]:
    """Return the numbers of the segments that hold a voxel."""
    if kind == "LABELMAP":
        return {int(number) for number in np.unique(pixels) if number > 0}
    return {frame.number for frame, pixel in zip(frames, pixels, strict=True) if pixel.max() >= half}
