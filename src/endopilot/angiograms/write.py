"""A patient and a cine on disk, with keypoints and masks as COCO has them: `write_patient` and `write_cine`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import UID, ExplicitVRLittleEndian, XRayAngiographicImageStorage, generate_uid
from pydicom.valuerep import format_number_as_ds

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.angiograms.cine import CLASSES, KEYPOINTS, Cine, CineFrame, box_of, encoded, laid_together
from endopilot.angiograms.config import CT_FILE, Layout, is_anatomy
from endopilot.angiograms.draw import draw_cine, motion_of
from endopilot.files import png_image, write_json, writing
from endopilot.imaging.segment import segment
from endopilot.imaging.volume import read_volume, write_volume
from endopilot.types import Volume
from endopilot.xray.absorbers import WATER_MM, is_coronary, surroundings
from endopilot.xray.carm import Image, Vector
from endopilot.xray.image import XrayImager

_BITS = 12
_LARGEST = 2**_BITS - 1
_WIDER = 2.0
"""The stored values reach this many times as far as the grey scale of a monitor."""
_EMPTY = ("PatientBirthDate", "PatientSex", "ReferringPhysicianName", "AccessionNumber")
_KV, _MA, _THIN_MM, _THICK_MM = (81.0, 125.0), (474.0, 841.0), 150.0, 300.0
"""Voltage and current of 45 public cines; the exposure control goes through them with the water that stands for the
patient: an assumption."""


def stored(signal: Image, window: float) -> UInt16[np.ndarray, "rows columns"]:
    """Return a frame as its file holds it: the logarithm of the light, 12 bits, wider than a monitor's half-window."""
    value = np.float32(_LARGEST / 2) * (1 + signal / np.float32(_WIDER * window))
    return np.clip(np.rint(value), 0, _LARGEST).astype("<u2")


def write_xa(
    path: Path, cine: Cine, frames: UInt16[np.ndarray, "frames rows columns"], *, number: int, identity: str
) -> None:
    """Write the frames of a cine, of this number among those of the patient, of whose identity UIDs are made; the same
    cine gives the same bytes."""
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


def _towards(axis: Vector) -> str:
    """Return where an axis of the image points in the patient: the letters of PS3.3 C.7.6.1.1.1, the largest first."""
    letters = [pair[int(part > 0)] for pair, part in zip(("RL", "AP", "FH"), axis, strict=True)]
    return "".join(letters[k] for k in np.argsort(-np.abs(axis)) if abs(axis[k]) > np.sin(np.pi / 12))


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
    header.PatientName, header.PatientID, header.StudyID = "Simulated^Patient", identity.rpartition(" ")[2][:64], "1"
    header.StudyDate = header.ContentDate = "20000101"  # that files can be sorted; nothing was taken on any day
    header.StudyTime = header.ContentTime = "000000"
    header.Manufacturer, header.PatientPosition = "endopilot", "HFS"
    header.PatientOrientation = [_towards(cine.view.axes[0]), _towards(-cine.view.axes[1])]
    share = np.clip((-cine.reference / WATER_MM - _THIN_MM) / (_THICK_MM - _THIN_MM), 0, 1)
    header.KVP, header.XRayTubeCurrent = _decimal(np.interp(share, (0, 1), _KV)), round(np.interp(share, (0, 1), _MA))
    header.ExposureTime = round(1000 * image.pulse_s)
    header.ShutterShape = header.CollimatorShape = "RECTANGULAR"
    edges = "LeftVerticalEdge", "RightVerticalEdge", "UpperHorizontalEdge", "LowerHorizontalEdge"
    for edge, place in zip(edges, cine.beam.edges, strict=True):
        setattr(header, f"Shutter{edge}", place)
        setattr(header, f"Collimator{edge}", place)
    header.ShutterPresentationValue = 0
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


CATEGORIES: tuple[dict[str, Any], ...] = tuple(
    {"id": number, "name": name, "supercategory": "vessel" if name in ("vessel", "contrast") else "device"}
    | (
        {
            "keypoints": list(KEYPOINTS[name]),
            "skeleton": [[k, k + 1] for k in range(1, len(KEYPOINTS[name]))],
        }
        if name in KEYPOINTS
        else {}
    )
    for number, name in enumerate(CLASSES, 1)
)
"""COCO's categories: the masks by name, with the keypoints of the devices. Of several driven catheters, the mask is
that of all, and the keypoints are those of the inner one."""
_SEEN = 2
_MOST_FRAMES = 100_000
"""A cine's images are numbered from its own number times this."""


def frame_entries(
    cine: Cine, frame: CineFrame, image: str, number: int, cine_number: int
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return a frame's entry in `images`, and its entries in `annotations`; what does not show has none."""
    pixels = len(frame.grey)
    image_id = cine_number * _MOST_FRAMES + number
    annotations, keypoints = [], cine.keypoints(frame)
    for category in CATEGORIES:
        name = category["name"]
        mask = frame.masks.get(name)
        if mask is None or not mask.any():
            continue
        entry = {
            "id": image_id * (len(CATEGORIES) + 1) + category["id"],
            "image_id": image_id,
            "category_id": category["id"],
            "segmentation": encoded(mask),
            "area": int(np.count_nonzero(mask)),
            "bbox": box_of(mask),
            "iscrowd": 0,
        }
        if name in keypoints:
            at = keypoints[name][1]
            shown = np.all((at >= -0.5) & (at < pixels - 0.5), axis=1)  # NaN, beyond the device's end, is not
            entry["keypoints"] = [
                value
                for (column, row), is_shown in zip(at.tolist(), shown.tolist(), strict=True)
                for value in ((round(column, 2), round(row, 2), _SEEN) if is_shown else (0, 0, 0))
            ]
            entry["num_keypoints"] = int(shown.sum())
        annotations.append(entry)
    entry = {"id": image_id, "file_name": image, "width": pixels, "height": pixels, "frame": number}
    return entry, annotations


def coco(parts: Iterable[Mapping[str, Any]], about: str) -> dict[str, Any]:
    """Return one COCO object of those of some cines."""
    parts = list(parts)
    return {
        "info": {"description": about},
        "images": [image for part in parts for image in part["images"]],
        "annotations": [entry for part in parts for entry in part["annotations"]],
        "categories": list(CATEGORIES),
    }


RECORD_FILE, COCO_FILE = "cine.json", "coco.json"
"""What a cine shows, and its keypoints and masks."""
TRUTH_FILE, DICOM_FILE = "truth.npz", "cine.dcm"
_kept: dict[tuple[str, Path], XrayImager] = {}
"""The imager of the last patient in this process: cines of one patient follow each other."""


def write_patient(layout: Layout, folder: Path) -> None:
    """Write a patient's vessel and CT into the data set; the vessel of a CT is segmented. Raises InputError for a
    source that cannot be read, a CT without such a vessel, or devices that do not fit."""
    source, segmentation = layout.sources[layout.names.index(folder.name)], layout.config.segmentation
    if is_anatomy(source):
        anatomy = read_anatomy(source)
        ct = read_volume(source / CT_FILE) if (source / CT_FILE).exists() else surroundings(anatomy)
    else:
        ct = read_volume(source)
        vessel = segmentation.vessel if segmentation.method == "coronary" else "generic"
        mask = segment(ct, config=segmentation)
        anatomy = extract_anatomy(mask, name=folder.name, config=AnatomyConfig(vessel=vessel))
    layout.stack.check(anatomy)
    with writing(folder) as partial:
        write_anatomy(anatomy, output=partial)
        if ct is not None:
            whole = np.rint(ct.voxels).astype(np.int16)
            write_volume(Volume(whole, ct.spacing_mm, ct.origin_mm, ct.direction), partial / CT_FILE)


def write_cine(layout: Layout, folder: Path) -> None:
    """Make a cine, and write its frames, and what is true of them, into its folder. Raises InputError where no motion
    of the devices can be simulated in the vessel, or for no such policy."""
    name, _, number = folder.name.rpartition("-")
    patient, config = layout.names.index(name), layout.config
    imager = _imager(layout, patient)
    cine = Cine(config, draw_cine(config, imager.anatomy, int(number)), imager)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    signals, truths = [], []
    with writing(folder) as partial:
        for part in ("frames", "masks"):
            (partial / part).mkdir(parents=True)
        for index, frame in enumerate(cine.frames()):
            file = f"{index:04d}.png"
            (partial / "frames" / file).write_bytes(png_image(frame.grey))
            (partial / "masks" / file).write_bytes(png_image(laid_together(frame.masks)))
            path = f"cines/{folder.name}/frames/{file}"
            image, entries = frame_entries(cine, frame, path, index, patient * config.cines + int(number))
            images.append(image | {"cine": folder.name, "patient": name})
            annotations += entries
            signals.append(stored(frame.signal, config.image.window))
            truths.append(_truth_of(cine, frame, index))
        xa, identity = np.stack(signals), f"{layout.key} {name}"
        write_xa(partial / DICOM_FILE, cine, xa, number=int(number), identity=identity)
        np.savez(partial / TRUTH_FILE, allow_pickle=False, **_truth(cine, truths))
        about = f"endopilot angiograms, cine {folder.name}"
        write_json(partial / COCO_FILE, coco([{"images": images, "annotations": annotations}], about), indented=False)
        write_json(partial / RECORD_FILE, _record(cine, layout, patient, int(number)))


def _imager(layout: Layout, patient: int) -> XrayImager:
    folder = layout.patients[patient]
    if (key := (layout.key, folder)) not in _kept:
        ct = read_volume(folder / CT_FILE) if (folder / CT_FILE).exists() else None
        _kept.clear()
        _kept[key] = XrayImager(read_anatomy(folder), layout.stack, ct=ct, config=layout.config.image)
    return _kept[key]


def _truth_of(cine: Cine, frame: CineFrame, number: int) -> dict[str, np.ndarray]:
    """Return what is true of one frame, by the names of the arrays in the cine's file."""
    truth = {"centerline_px": cine.project(cine.flow.points, number)}
    for name, line in frame.lines_mm.items():
        truth |= {f"{name}_mm": line, f"{name}_px": frame.lines_px[name]}
    for name, (places, pixels) in cine.keypoints(frame).items():
        truth |= {f"{name}_keypoints_mm": places, f"{name}_keypoints_px": pixels}
    return truth


def _truth(cine: Cine, frames: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return what is true of a cine: arrays by name. Lines that are shorter than others end in NaN."""
    truth = {
        "time_s": np.arange(len(frames)) / cine.config.frames_per_second,
        "projection": cine.projection,
        "placed": cine.placed,
        "centerline_mm": cine.flow.points,
        "centerline_radius_mm": cine.flow.radius,
        "centerline_branch": cine.flow.branch,
        "centerline_section": cine.flow.section,
        "centerline_contrast": cine.contrast.astype(np.float32),
        **{name: _padded([frame[name] for frame in frames]) for name in frames[0]},
    }
    if cine.draw.devices:
        truth |= {"inserted_length_mm": cine.driven.proximal[..., 0], "rotation_rad": cine.driven.proximal[..., 1]}
    return truth


def _padded(lines: Sequence[Float[np.ndarray, "_ d"]]) -> Float[np.ndarray, "frames n d"]:
    longest = max(len(line) for line in lines)
    return np.stack([np.pad(x, ((0, longest - len(x)), (0, 0)), constant_values=np.nan) for x in lines]).astype(
        np.float32
    )


def _record(cine: Cine, layout: Layout, patient: int, number: int) -> dict[str, Any]:
    draw, anatomy = cine.draw, cine.imager.anatomy
    motion = motion_of(cine.config, anatomy.name)
    return {
        "patient": anatomy.name,
        "split": layout.splits[patient],
        "number": number,
        "frames": cine.config.frames,
        "pixels": cine.config.image.pixels,
        "frames_per_second": cine.config.frames_per_second,
        "view": draw.view,
        "view_angles_deg": draw.angles_deg,
        "pose": {"rotation_rad": draw.pose.rotation_rad, "translation_mm": draw.pose.translation_mm},
        "isocenter_mm": cine.imager.isocenter,
        "projection": cine.projection,
        "dose": draw.dose,
        "air_kerma_ugy": cine.air_kerma_ugy,
        "injection": None if draw.injection is None else asdict(draw.injection),
        "blood_mm_s": draw.blood_mm_s,
        "blood_ml_s": cine.flow.inflow_ml_s,
        "motion": None if motion is None else asdict(motion),
        "motion_begins_s": -draw.lead / cine.config.frames_per_second,
        "devices": [device.name for device in layout.stack.devices] if draw.devices else [],
        "motions_redrawn": cine.driven.redrawn,
        "section_names": list(anatomy.tree.section_names),
        "masks": dict(CLASSES),
    }
