"""A cine as DICOM: one multi-frame X-Ray Angiographic Image (PS3.3 A.14) that names no patient."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt16
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import UID, ExplicitVRLittleEndian, XRayAngiographicImageStorage, generate_uid
from pydicom.valuerep import format_number_as_ds

from endopilot.angiograms.cine import Cine
from endopilot.files import writing
from endopilot.xray.absorbers import is_coronary

_BITS = 12
_LARGEST = 2**_BITS - 1
_WIDER = 2.0
"""The stored values reach this many times as far as the grey scale of a monitor."""
_EMPTY = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"),
    *("ReferringPhysicianName", "AccessionNumber", "Manufacturer", "KVP", "XRayTubeCurrent", "ExposureTime"),
    *("ContentDate", "ContentTime", "PatientOrientation"),
)


def stored(signal: Float32[np.ndarray, "rows columns"], window: float) -> UInt16[np.ndarray, "rows columns"]:
    """Return a frame as its file holds it: the logarithm of the light, 12 bits, wider than what a monitor shows.

    Args:
        window: half-width of the monitor's grey scale, powers of e.
    """
    value = np.float32(_LARGEST / 2) * (1 + signal / np.float32(_WIDER * window))
    return np.clip(np.rint(value), 0, _LARGEST).astype("<u2")


def write_xa(
    path: Path, cine: Cine, frames: UInt16[np.ndarray, "frames rows columns"], *, number: int, identity: str
) -> None:
    """Write the frames of a cine. The same cine gives the same bytes.

    Args:
        number: of the cine among the patient's.
        identity: of the patient in this data set; UIDs are made of it.
    """
    header = _header(cine, number, identity)
    header.NumberOfFrames, header.Rows, header.Columns = frames.shape
    header.PixelData = frames.tobytes()
    with writing(path) as partial:
        header.save_as(partial, enforce_file_format=True)


def _uid(*parts: str) -> UID:
    return generate_uid(entropy_srcs=[hashlib.sha256(part.encode()).hexdigest() for part in parts])


def _decimal(value: float) -> str:
    """Return a number as a decimal string of at most 16 characters, DICOM's limit (PS3.5 6.2)."""
    return format_number_as_ds(float(value))


def _header(cine: Cine, number: int, identity: str) -> Dataset:
    """Return all but the pixels."""
    config, draw = cine.config, cine.draw
    image, geometry, meta = config.image, config.image.geometry, FileMetaDataset()
    header = Dataset()
    header.file_meta = meta
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    header.SOPClassUID = meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    header.SOPInstanceUID = meta.MediaStorageSOPInstanceUID = _uid(identity, "cine", str(number))
    header.StudyInstanceUID, header.SeriesInstanceUID = _uid(identity, "study"), _uid(identity, "series", str(number))
    for empty in _EMPTY:
        setattr(header, empty, None)
    if is_coronary(cine.imager.anatomy):
        header.BodyPartExamined = "HEART"
    else:
        header.Laterality = None
    header.Modality, header.SeriesNumber, header.InstanceNumber = "XA", number + 1, 1
    header.ImageType = ["DERIVED", "SECONDARY", "SINGLE PLANE"]
    header.DerivationDescription = "simulated from a CT angiogram or a synthetic patient"
    header.SamplesPerPixel, header.PhotometricInterpretation = 1, "MONOCHROME2"
    header.BitsAllocated, header.BitsStored, header.HighBit, header.PixelRepresentation = 16, _BITS, _BITS - 1, 0
    header.PixelIntensityRelationship = "LOG"
    header.RescaleSlope, header.RescaleIntercept, header.RescaleType = 1, 0, "US"
    header.WindowCenter, header.WindowWidth = (_LARGEST + 1) / 2, (_LARGEST + 1) / _WIDER
    header.LossyImageCompression, header.BurnedInAnnotation = "00", "NO"
    header.FrameIncrementPointer = 0x00181063  # frame time
    header.FrameTime = _decimal(1000 / config.frames_per_second)
    header.CineRate = header.RecommendedDisplayFrameRate = config.frames_per_second
    header.StartTrim, header.StopTrim = 1, config.frames
    header.RadiationSetting, header.AveragePulseWidth = "GR", _decimal(1000 * image.pulse_s)
    header.PositionerMotion = "STATIC"
    header.PositionerPrimaryAngle, header.PositionerSecondaryAngle = map(_decimal, draw.angles_deg)
    header.DistanceSourceToPatient = _decimal(geometry.source_to_isocenter_mm)
    header.DistanceSourceToDetector = _decimal(geometry.source_to_detector_mm)
    header.EstimatedRadiographicMagnificationFactor = _decimal(
        geometry.source_to_detector_mm / geometry.source_to_isocenter_mm
    )
    header.ImagerPixelSpacing = [_decimal(geometry.pixel_mm)] * 2
    header.FocalSpots = _decimal(image.focal_spot_mm)
    if draw.injection is not None:
        header.ContrastBolusAgent = "iodine"
        header.ContrastFlowRate = _decimal(draw.injection.rate_ml_s)
        header.ContrastFlowDuration = _decimal(draw.injection.duration_s)
    return header
