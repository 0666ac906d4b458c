"""CT as DICOM: one series of axial-like slices, its geometry checked, its identifiers left behind.

Headers are read with pydicom, restricted to the tags below, so that nothing that names a patient is ever in memory.
Pixels are decoded by GDCM through SimpleITK, which knows more compressions than pydicom alone and applies the rescale.
"""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk
from jaxtyping import Float
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.errors import InvalidDicomError
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, generate_uid

from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.progress import progress
from endopilot.types import Volume

# What geometry and decoding need; no tag here names a patient, a place or a day.
_TAGS = (
    "SeriesInstanceUID",
    "SeriesNumber",
    "Modality",
    "ImageType",
    "SamplesPerPixel",
    "NumberOfFrames",
    "Rows",
    "Columns",
    "BitsAllocated",
    "BitsStored",
    "PixelRepresentation",
    "PixelSpacing",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "RescaleSlope",
    "RescaleIntercept",
)

# Transfer syntaxes that GDCM decodes: uncompressed, deflated, RLE, JPEG, JPEG-LS, JPEG 2000.
_UNCOMPRESSED = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")
_DECODED = (
    *_UNCOMPRESSED,
    "1.2.840.10008.1.2.1.99",
    "1.2.840.10008.1.2.5",
    *(f"1.2.840.10008.1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81, 90, 91)),
)

_TILT_TOLERANCE_DEGREES = 0.1
_SPACING_TOLERANCE = 0.05
"""Slice distances may differ from their median by this share: positions are written with few digits."""
_FEWEST_SLICES = 4


@dataclass(frozen=True)
class _Slice:
    """What the header of one file says, identifiers left out."""

    path: Path
    series_uid: str
    series_number: int | None
    transfer_syntax: str
    header: Dataset


def is_dicom(path: Path) -> bool:
    """Tell whether a file starts as DICOM Part 10 files do: 128 bytes of preamble, then DICM."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def read_series(path: Path, series: str | None) -> Volume:
    """Read a CT series in HU.

    Args:
        path: a folder, or one file of the series wanted.
        series: number or SeriesInstanceUID of the series to take where the folder holds several.

    Raises:
        InputError: there is no image or more than one series, or the series is no plain CT volume.
    """
    folder = path if path.is_dir() else path.parent
    slices = _read_headers(folder)
    if path.is_file():
        slices = [slice_ for slice_ in slices if slice_.series_uid == _series_of(path, slices)]
    chosen = _choose(slices, series, folder)
    _check_slices(chosen, folder)
    ordered, spacing, origin, direction = _geometry(chosen, folder)
    return Volume(_read_pixels(ordered, folder), spacing, origin, direction)


def _read_headers(folder: Path) -> list[_Slice]:
    """Return the header of every DICOM image in a folder, other files and scout views left out."""
    files = sorted(file for file in folder.iterdir() if file.is_file())
    found = []
    # pydicom's warnings quote header values; none may reach a log.
    with progress("Reading DICOM headers", len(files)) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for file in files:
            advance()
            try:
                header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=list(_TAGS))
            except InvalidDicomError:
                continue
            except Exception:
                raise InputError(f"{file}: its DICOM header is damaged; copy or export the series again") from None
            if "Rows" not in header or "LOCALIZER" in header.get("ImageType", ()):
                continue
            number = header.get("SeriesNumber")
            found.append(
                _Slice(
                    path=file,
                    series_uid=str(header.get("SeriesInstanceUID", "")),
                    series_number=None if number is None else int(number),
                    transfer_syntax=str(header.file_meta.get("TransferSyntaxUID", _UNCOMPRESSED[0])),
                    header=header,
                )
            )
    if not found:
        raise InputError(f"{folder}: no DICOM image in this folder; give the folder that holds the slices themselves")
    return found


def _series_of(path: Path, slices: Sequence[_Slice]) -> str:
    for slice_ in slices:
        if slice_.path == path:
            return slice_.series_uid
    raise InputError(f"{path}: a DICOM file without an axial image; give a folder of CT slices")


def _choose(slices: Sequence[_Slice], series: str | None, folder: Path) -> list[_Slice]:
    """Return the slices of the one series there is, or of the one asked for."""
    by_uid: defaultdict[str, list[_Slice]] = defaultdict(list)
    for slice_ in slices:
        by_uid[slice_.series_uid].append(slice_)
    groups = sorted(by_uid.values(), key=lambda group: (group[0].series_number or 0, group[0].series_uid))
    if series is None and len(groups) == 1:
        return groups[0]
    # Names of our own: a series' description is free text, and may name the patient.
    numbers = Counter(group[0].series_number for group in groups)
    names = [
        str(group[0].series_number)
        if group[0].series_number is not None and numbers[group[0].series_number] == 1
        else f"{group[0].series_number or 0}.{ordinal}"
        for ordinal, group in enumerate(groups, start=1)
    ]
    for name, group in zip(names, groups, strict=True):
        if series in (name, group[0].series_uid):
            return group
    listed = "; ".join(
        f"{name}: {group[0].header.get('Modality', '?')}, {len(group)} slices of "
        f"{group[0].header.Columns}×{group[0].header.Rows}"
        for name, group in zip(names, groups, strict=True)
    )
    if series is None:
        raise InputError(f"{folder}: {len(groups)} DICOM series ({listed}); choose one with series=")
    raise InputError(f"{folder}: no series {series!r} (the folder holds {listed}); choose one with series=")


def _check_slices(slices: Sequence[_Slice], folder: Path) -> None:
    """Refuse a series that is no CT of plain single-frame slices that can be decoded."""
    for slice_ in slices:
        header, name = slice_.header, slice_.path.name
        if header.get("Modality", "CT") != "CT":
            raise InputError(f"{folder}: modality {header.Modality}; HU are needed, give a CT series")
        if int(header.get("SamplesPerPixel", 1)) != 1:
            raise InputError(f"{folder}/{name}: a colour image (RGB); give the grey-level CT series")
        if int(header.get("NumberOfFrames", 1) or 1) != 1:
            raise InputError(f"{folder}/{name}: a multi-frame file; export one file a slice, or NIfTI")
        if slice_.transfer_syntax not in _DECODED:
            raise InputError(
                f"{folder}/{name}: compressed as {UID(slice_.transfer_syntax).name}, which is not supported; "
                "decompress the series (gdcmconv --raw) or export it uncompressed"
            )
        missing = [
            tag for tag in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing") if not header.get(tag)
        ]
        if missing:
            raise InputError(f"{folder}/{name}: no {missing[0]} in its header; export the series with its geometry")
        needed = int(header.Rows) * int(header.Columns) * int(header.get("BitsAllocated", 16)) // 8
        if slice_.transfer_syntax in _UNCOMPRESSED and slice_.path.stat().st_size < needed:
            raise InputError(f"{folder}/{name}: truncated, its pixels are incomplete; copy or export the series again")
    if len(slices) < _FEWEST_SLICES:
        raise InputError(f"{folder}: only {len(slices)} slices; give a series of at least {_FEWEST_SLICES}")
    for tag in ("Rows", "Columns", "PixelSpacing", "ImageOrientationPatient"):
        values = [np.atleast_1d(np.asarray(slice_.header.get(tag), dtype=float)) for slice_ in slices]
        if any(not np.allclose(value, values[0], atol=1e-3) for value in values):
            raise InputError(f"{folder}: {tag} differs between slices; give a folder with one volume alone")


def _geometry(
    slices: Sequence[_Slice], folder: Path
) -> tuple[list[_Slice], Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return slices in order, spacing, origin and direction (DICOM PS3.3 C.7.6.2.1.1), gaps and tilt refused."""
    orientation = np.array(slices[0].header.ImageOrientationPatient, dtype=float)
    along_i, along_j = orientation[:3], orientation[3:]
    normal = np.cross(along_i, along_j)
    positions = np.array([slice_.header.ImagePositionPatient for slice_ in slices], dtype=float)
    order = np.argsort(positions @ normal, kind="stable")
    positions = positions[order]
    steps = np.diff(positions @ normal)
    step = float(np.median(steps))
    if np.any(steps < 1e-3):
        raise InputError(
            f"{folder}: several images at one slice position (cardiac phases, or a series stored twice); "
            "keep one phase in the folder"
        )
    gaps = np.flatnonzero(np.abs(steps - step) > _SPACING_TOLERANCE * step)
    if gaps.size:
        first = gaps[0]
        raise InputError(
            f"{folder}: {gaps.size} irregular slice distance(s), the first {steps[first]:.2f} mm instead of "
            f"{step:.2f} mm after slice {first + 1}: slices are missing; export the whole series again"
        )
    travel = positions[-1] - positions[0]
    sideways = travel - (travel @ normal) * normal
    tilt = np.degrees(np.arctan2(np.linalg.norm(sideways), travel @ normal))
    if tilt > _TILT_TOLERANCE_DEGREES:
        raise InputError(
            f"{folder}: gantry tilt of {tilt:.1f}°; resample the series to straight slices (such as dcm2niix does)"
        )
    rows_mm, columns_mm = (float(value) for value in slices[0].header.PixelSpacing)
    spacing = np.array([columns_mm, rows_mm, (travel @ normal) / (len(slices) - 1)])
    return [slices[i] for i in order], spacing, positions[0], np.stack([along_i, along_j, normal], axis=1)


def _read_pixels(slices: Sequence[_Slice], folder: Path) -> np.ndarray:
    """Decode slices in the order given and return HU: int16 where all are whole numbers that fit, else float32."""
    whole = all(
        float(slice_.header.get(tag, default)).is_integer()
        for slice_ in slices
        for tag, default in (("RescaleSlope", 1.0), ("RescaleIntercept", 0.0))
    )
    rows, columns = int(slices[0].header.Rows), int(slices[0].header.Columns)
    voxels = np.empty((len(slices), rows, columns), dtype=np.float32)
    sitk.ProcessObject.SetGlobalWarningDisplay(False)  # GDCM's own lines may quote header values
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    with progress("Reading DICOM slices", len(slices)) as advance:
        for slice_, plane in zip(slices, voxels, strict=True):
            reader.SetFileName(str(slice_.path))
            try:
                plane[:] = sitk.GetArrayFromImage(reader.Execute()).reshape(rows, columns)
            except (RuntimeError, ValueError):
                # GDCM's message may quote the header: it ends here.
                raise InputError(
                    f"{folder}/{slice_.path.name}: its pixels cannot be decoded (truncated or damaged); "
                    "copy or export the series again"
                ) from None
            advance()
    limits = np.iinfo(np.int16)
    if whole and limits.min <= voxels.min() and voxels.max() <= limits.max:
        return voxels.astype(np.int16)
    return voxels


def write_series(volume: Volume, folder: Path) -> None:
    """Write a CT volume as a DICOM series, one uncompressed file a slice, without any patient's data.

    HU are rounded to whole numbers.

    Args:
        volume: CT in HU.
        folder: a new folder.

    Raises:
        InputError: the folder is there already, or cannot be written.
    """
    if folder.exists():
        raise InputError(f"{folder}: is there already; give a new folder for the DICOM series")
    voxels = np.clip(np.round(volume.voxels), -32768, 32767).astype("<i2")
    normal = np.cross(volume.direction[:, 0], volume.direction[:, 1])
    if normal @ volume.direction[:, 2] < 0:
        raise InputError(f"{folder}: DICOM slices must be right-handed; write the volume as .nii.gz instead")
    frame, study, series = generate_uid(), generate_uid(), generate_uid()
    with writing(folder) as partial, progress("Writing DICOM slices", len(voxels)) as advance:
        partial.mkdir()
        for k, plane in enumerate(voxels):
            header = _slice_header(volume, k)
            header.FrameOfReferenceUID, header.StudyInstanceUID, header.SeriesInstanceUID = frame, study, series
            header.PixelData = plane.tobytes()
            header.save_as(partial / f"slice-{k:04d}.dcm", enforce_file_format=True)
            advance()


def _slice_header(volume: Volume, k: int) -> Dataset:
    """Return the header of slice `k`, identifiers left out (type 2 attributes are present and empty)."""
    header = Dataset()
    header.file_meta = FileMetaDataset()
    header.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    header.SOPClassUID = header.file_meta.MediaStorageSOPClassUID = CTImageStorage
    header.SOPInstanceUID = header.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    for empty in ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"):
        setattr(header, empty, "")
    header.ReferringPhysicianName = header.AccessionNumber = header.Manufacturer = ""
    header.Modality, header.ImageType = "CT", ["DERIVED", "SECONDARY", "AXIAL"]
    header.SeriesNumber, header.InstanceNumber = 1, k + 1
    header.ImagePositionPatient = [f"{x:.6g}" for x in volume.index_to_world(np.array([0.0, 0.0, k]))]
    header.ImageOrientationPatient = [f"{x:.8g}" for x in volume.direction[:, :2].T.ravel()]
    header.PixelSpacing = [f"{volume.spacing_mm[1]:.8g}", f"{volume.spacing_mm[0]:.8g}"]
    header.SliceThickness = f"{volume.spacing_mm[2]:.8g}"
    header.Rows, header.Columns = volume.voxels.shape[1:]
    header.SamplesPerPixel, header.PhotometricInterpretation = 1, "MONOCHROME2"
    header.BitsAllocated, header.BitsStored, header.HighBit, header.PixelRepresentation = 16, 16, 15, 1
    header.RescaleSlope, header.RescaleIntercept, header.RescaleType = 1, 0, "HU"
    return header
