"""CT to DICOM: one series of uncompressed slices that names no patient, with the attributes that DICOM requires of a CT
image (PS3.3 A.3.3); highdicom writes no CT images but needs the same header for a mask."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, generate_uid
from pydicom.valuerep import format_number_as_ds

from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.progress import progress
from endopilot.types import Volume

_UNNAMED = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"),
    *("ReferringPhysicianName", "AccessionNumber", "Manufacturer", "PositionReferenceIndicator"),
    *("KVP", "AcquisitionNumber", "PatientPosition", "SeriesDate", "SeriesTime", "ContentDate", "ContentTime"),
)


def write_series(volume: Volume, folder: Path) -> None:
    """Write a CT volume in whole HU as a DICOM series without patient's data, a file a slice; the same volume gives the
    same bytes. Raises InputError where the folder holds files already, or cannot be written."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; give a new folder for the DICOM series")
    voxels = np.clip(np.round(volume.voxels), -32768, 32767).astype("<i2")
    with writing(folder) as partial, progress("Writing DICOM slices", len(voxels)) as advance:
        partial.mkdir()
        for k, (header, plane) in enumerate(zip(slice_headers(volume), voxels, strict=True)):
            header.PixelData = plane.tobytes()
            save(header, partial / f"slice-{k:04d}.dcm")
            advance()


def save(content: Dataset, path: Path) -> None:
    """Write a DICOM file, and compare what has arrived byte by byte; raises InputError if it differs."""
    stream = io.BytesIO()
    content.save_as(stream, enforce_file_format=True)
    path.write_bytes(stream.getvalue())
    if path.read_bytes() != stream.getvalue():
        raise InputError(f"{path}: was not written whole; see that the folder is writable and the disk is not full")


def slice_headers(volume: Volume) -> list[Dataset]:
    """Return each slice's header, pixels left out; UIDs follow from the volume's own content (PS3.5 B.2)."""
    content = hashlib.sha256(np.ascontiguousarray(volume.voxels).tobytes())
    for part in (volume.spacing_mm, volume.origin_mm, volume.direction):
        content.update(np.ascontiguousarray(part).tobytes())
    digest = content.hexdigest()

    def uid(name: str) -> UID:
        return generate_uid(entropy_srcs=[digest, name])

    headers = []
    for k in range(len(volume.voxels)):
        header = _slice_header(volume, k)
        header.StudyInstanceUID, header.SeriesInstanceUID = uid("study"), uid("series")
        header.FrameOfReferenceUID = uid("frame of reference")
        header.SOPInstanceUID = header.file_meta.MediaStorageSOPInstanceUID = uid(f"slice {k}")
        headers.append(header)
    return headers


def _slice_header(volume: Volume, k: int) -> Dataset:
    header = Dataset()
    header.file_meta = FileMetaDataset()
    header.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    header.SOPClassUID = header.file_meta.MediaStorageSOPClassUID = CTImageStorage
    for empty in _UNNAMED:
        setattr(header, empty, None)
    header.Modality, header.ImageType = "CT", ["DERIVED", "SECONDARY", "AXIAL"]
    header.SeriesNumber, header.InstanceNumber = 1, k + 1
    header.ImagePositionPatient = _decimals(volume.index_to_world(np.array([0.0, 0.0, k])))
    header.ImageOrientationPatient = _decimals(volume.direction[:, :2].T.ravel())
    header.PixelSpacing = _decimals(volume.spacing_mm[[1, 0]])
    header.SliceThickness = _decimals(volume.spacing_mm[2:])[0]
    header.Rows, header.Columns = volume.voxels.shape[1:]
    header.SamplesPerPixel, header.PhotometricInterpretation = 1, "MONOCHROME2"
    header.BitsAllocated, header.BitsStored, header.HighBit, header.PixelRepresentation = 16, 16, 15, 1
    header.RescaleSlope, header.RescaleIntercept, header.RescaleType = 1, 0, "HU"
    header.WindowCenter, header.WindowWidth = 200, 800
    return header


def _decimals(values: np.ndarray) -> list[str]:
    """Return numbers as decimal strings of at most 16 characters, DICOM's limit (PS3.5 6.2)."""
    return [format_number_as_ds(float(value)) for value in values]
