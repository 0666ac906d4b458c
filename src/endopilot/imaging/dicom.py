"""CT from DICOM: one series of axial-like slices, its geometry checked, its identifiers left behind: only the tags
below are read. GDCM decodes pixels, but for RLE, where it does not come back from some damaged files."""

from __future__ import annotations

import os
import re
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pydicom
import SimpleITK as sitk
from jaxtyping import Float
from pydicom.dataset import Dataset
from pydicom.errors import InvalidDicomError
from pydicom.pixels.utils import pixel_array
from pydicom.uid import UID, AllTransferSyntaxes

from endopilot.errors import InputError
from endopilot.imaging.dicom_phases import PHASE_TAGS, choose_phase, slices_text
from endopilot.imaging.geometry import plane, slice_grid
from endopilot.progress import progress
from endopilot.types import Volume

# What geometry and decoding need; no tag here names a patient, a place or a day.
_NUMBERS = (
    *("SeriesNumber", "SamplesPerPixel", "NumberOfFrames", "Rows", "Columns", "BitsAllocated", "PixelRepresentation"),
    *("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient", "RescaleSlope", "RescaleIntercept"),
    *("PixelPaddingValue", "PixelPaddingRangeLimit"),
    *PHASE_TAGS,
)
_WORDS = (
    *("SeriesInstanceUID", "Modality", "ImageType", "RescaleType", "PhotometricInterpretation"),
    "LossyImageCompression",
)

# Transfer syntaxes that are decoded: uncompressed, deflated, RLE, JPEG, JPEG-LS, JPEG 2000.
_UNCOMPRESSED = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")
_DEFLATED = "1.2.840.10008.1.2.1.99"
_RLE = "1.2.840.10008.1.2.5"
_ENCAPSULATED = (_RLE, *(f"1.2.840.10008.1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81, 90, 91)))
_LOSSY = tuple(f"1.2.840.10008.1.2.4.{number}" for number in (50, 51, 81))
_DECODED = (*_UNCOMPRESSED, _DEFLATED, *_ENCAPSULATED)

# Encapsulated pixels begin and end with these bytes (PS3.5 A.4).
_PIXELS_BEGIN = (b"\xe0\x7f\x10\x00OB\0\0\xff\xff\xff\xff", b"\xe0\x7f\x10\x00OW\0\0\xff\xff\xff\xff")
_PIXELS_END = b"\xfe\xff\xdd\xe0\0\0\0\0"

_PREAMBLE = 128
_MOST_NAMED = 10
_FEWEST_SLICES = 4
_HU_TYPES = ("", "HU")
_PERHAPS_HU_TYPES = ("US", "HU_MOD")  # RescaleType of modified HU, and of converters that leave the type open
_AIR_HU = -1024.0  # what pixels are given that lie outside the scanned circle (PixelPaddingValue)


@dataclass(frozen=True, eq=False)
class _Slice:
    """What a file's header says of its image, without identifiers: `numbers` and `words`, in capitals."""

    path: Path
    transfer_syntax: str
    numbers: dict[str, tuple[float, ...]]
    words: dict[str, str]

    def whole(self, name: str, absent: int) -> int:
        """Return the first value of one of `_NUMBERS`."""
        return int(self.numbers[name][0]) if self.numbers[name] else absent

    @property
    def series(self) -> tuple[int, str]:
        """SeriesNumber, 0 where it is absent, and SeriesInstanceUID."""
        return self.whole("SeriesNumber", 0), self.words["SeriesInstanceUID"]

    @property
    def size(self) -> tuple[int, int]:
        """Rows, Columns."""
        return self.whole("Rows", 0), self.whole("Columns", 0)

    @property
    def rescale(self) -> tuple[float, ...]:
        """RescaleSlope, RescaleIntercept."""
        return self.numbers["RescaleSlope"][:1] + self.numbers["RescaleIntercept"][:1]

    @property
    def padding(self) -> tuple[float, ...]:
        """Lowest and highest stored value of pixels that show nothing, as signed as the pixels are."""
        given = self.numbers["PixelPaddingValue"][:1]
        bits, signed = self.whole("BitsAllocated", 16), self.whole("PixelRepresentation", 0) == 1
        given += self.numbers["PixelPaddingRangeLimit"][:1] if given else ()
        stored = sorted(value - 2.0**bits if signed and value >= 2.0 ** (bits - 1) else value for value in given)
        return (stored[0], stored[-1]) if stored else ()


def read_series(path: Path, series: str | None, phase: str | None = None) -> Volume:
    """Read a CT series in HU from a folder with its subfolders, or by one of its files; `series` is a number or a UID,
    `phase` a number. Raises InputError where there is no image, more than one series, or no plain CT volume."""
    folder = path if path.is_dir() else path.parent
    slices, left_out = _read_headers(_files(folder, deep=path == folder))
    if not slices:
        said = f" ({left_out[0]})" if left_out else ""
        raise InputError(f"{path}: no DICOM image here{said}; give the folder that holds the slices of a CT series")
    if path != folder:
        of_file = next((slice_.series[1] for slice_ in slices if slice_.path == path), None)
        if of_file is None:
            raise InputError(f"{path}: a DICOM file without an axial image; give a folder of CT slices")
        slices = [slice_ for slice_ in slices if slice_.series[1] == of_file]
    chosen = _choose(slices, series, folder)
    notes = [*_check_slices(chosen, folder), *left_out]
    first = chosen[0]
    axes, normal = plane(first.numbers["ImageOrientationPatient"], first.numbers["PixelSpacing"], path=first.path)
    of_phase, phase_notes = choose_phase(
        {tag: [next(iter(slice_.numbers[tag]), None) for slice_ in chosen] for tag in PHASE_TAGS},
        np.array([slice_.numbers["ImagePositionPatient"] for slice_ in chosen]) @ normal,
        phase,
        folder,
        named=next((index for index, slice_ in enumerate(chosen) if slice_.path == path), None),
    )
    ordered, place = _geometry([chosen[index] for index in of_phase], axes, normal, folder)
    voxels, pixel_notes = _read_pixels(ordered)
    said = tuple(f"{folder.name}: {note}" for note in (*notes, *phase_notes, *pixel_notes))
    files = tuple(sorted(slice_.path for slice_ in ordered))
    return replace(place, voxels=voxels, notes=(*said, *place.notes), files=files)


def _files(folder: Path, *, deep: bool) -> list[Path]:
    """Return all that lies in a folder, and in its subfolders if `deep`: links to folders are not followed."""

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: may not be read ({error.strerror}); ask for access to it") from error

    found: list[Path] = []
    for parent, folders, names in os.walk(folder, onerror=refuse):
        links = (name for name in folders if Path(parent, name).is_symlink())
        found += [Path(parent, name) for name in (*names, *links)]
        if not deep:
            break
    return sorted(found)


def _read_headers(files: Sequence[Path]) -> tuple[list[_Slice], list[str]]:
    """Return the headers of DICOM images without scout views, and notes on other files. Raises InputError for a file
    that may be a slice whose content is lost: named as the slices are and no text, or an image by its own word."""
    found, others = [], []
    # pydicom's warnings quote header values; none may reach a log.
    with progress("Reading DICOM headers", len(files)) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for file in files:
            advance()
            try:
                if not file.is_file():
                    raise InvalidDicomError
                header = pydicom.dcmread(file, stop_before_pixels=True, specific_tags=[*_NUMBERS, *_WORDS])
                if "Rows" not in header:
                    meta = header.file_meta
                    if "TransferSyntaxUID" not in meta or "Image Storage" in meta.MediaStorageSOPClassUID.name:
                        raise EOFError("cut short")
                    others.append((file, False))
                elif "LOCALIZER" not in (header.get("ImageType") or ()):
                    found.append(_slice(file, header))
            except InvalidDicomError:
                others.append((file, _is_no_text(file)))
            except PermissionError as error:
                raise InputError(f"{file}: may not be read ({error.strerror}); ask for access to it") from error
            except Exception:
                # pydicom's message may quote the header, so it is not passed on.
                raise InputError(f"{file}: its DICOM header is damaged; copy or export the series again") from None
    suffixes = {_kind_of_suffix(slice_.path) for slice_ in found}
    for file, perhaps_slice in others:
        if perhaps_slice and _kind_of_suffix(file) in suffixes:
            raise InputError(
                f"{file}: is named as the slices beside it are, but is no DICOM file (empty, cut short, without "
                "preamble, or a broken link); copy or export it again, or move it away"
            )
    names = [file.name for file, _ in others]
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return found, [f"without an image and left out: {', '.join(names[:_MOST_NAMED])}{more}"] if names else []


def _is_no_text(file: Path) -> bool:
    """Return whether a file that is no DICOM may be the rest of one: it is empty, not there, or holds zero bytes."""
    content = file.open("rb").read(_PREAMBLE + 4) if file.is_file() else b""
    return not content or b"\0" in content


def _kind_of_suffix(file: Path) -> str:
    """Return a file's suffix, its digits alike, as they are the last part of a UID; hidden files have names alone."""
    return file.name if file.name.startswith(".") else re.sub(r"\d+", "0", file.suffix.lower())


def _slice(file: Path, header: Dataset) -> _Slice:
    """Take what is needed out of a header; any error means that it is damaged."""
    present = {tag: header[tag].value for tag in (*_NUMBERS, *_WORDS) if header.get(tag) not in (None, "")}
    return _Slice(
        file,
        str(header.file_meta.get("TransferSyntaxUID", _UNCOMPRESSED[0])),
        {tag: tuple(float(x) for x in np.atleast_1d(present.get(tag, ()))) for tag in _NUMBERS},
        {tag: str(present.get(tag, "")).strip().upper() for tag in _WORDS},
    )


def _choose(slices: Sequence[_Slice], series: str | None, folder: Path) -> list[_Slice]:
    groups_by: defaultdict[str, list[_Slice]] = defaultdict(list)
    for slice_ in slices:
        groups_by[slice_.series[1]].append(slice_)
    groups = sorted(groups_by.values(), key=lambda group: group[0].series)
    if series is None and len(groups) == 1:
        return groups[0]
    # Names of our own: a series' description is free text, and may name the patient.
    numbers = [group[0].series[0] for group in groups]
    names = [
        str(number) if number and numbers.count(number) == 1 else f"{number}.{ordinal}"
        for ordinal, number in enumerate(numbers, start=1)
    ]
    for name, group in zip(names, groups, strict=True):
        if series in (name, group[0].series[1]):
            return group
    listed = "; ".join(
        f"{name}: {group[0].words['Modality'] or 'CT'}, {slices_text(len(group))} of {'×'.join(map(str, size[::-1]))}"
        for name, group, size in zip(names, groups, (group[0].size for group in groups), strict=True)
    )
    if series is None:
        raise InputError(
            f"{folder}: {len(groups)} DICOM series ({listed}); choose one with --series, or give one of its files"
        )
    raise InputError(f"{folder}: no series {series!r} (the folder holds {listed}); choose one with --series")


def _syntax_name(uid: str) -> str:
    """Return what DICOM calls a transfer syntax; a UID that it does not know may be anything, and is not shown."""
    return UID(uid).name if uid in AllTransferSyntaxes else "no transfer syntax of DICOM"


def _check_slices(slices: Sequence[_Slice], folder: Path) -> list[str]:
    """Refuse a series that is no CT of plain single-frame slices that can be decoded; return what is to be noted."""
    for slice_ in slices:
        path = slice_.path
        if slice_.words["Modality"] not in ("", "CT"):
            raise InputError(f"{folder}: modality {slice_.words['Modality']}; HU are needed, give a CT series")
        if slice_.whole("SamplesPerPixel", 1) != 1:
            raise InputError(f"{path}: a colour image (RGB); give the grey-level CT series")
        if slice_.whole("NumberOfFrames", 1) != 1:
            raise InputError(f"{path}: a multi-frame file; export one file a slice, or NIfTI")
        if slice_.transfer_syntax not in _DECODED:
            raise InputError(
                f"{path}: compressed as {_syntax_name(slice_.transfer_syntax)}, which is not supported; "
                "decompress the series (gdcmconv --raw) or export it uncompressed"
            )
        for tag, value, count in (
            ("Rows and Columns", slice_.numbers["Rows"] + slice_.numbers["Columns"], 2),
            ("ImagePositionPatient", slice_.numbers["ImagePositionPatient"], 3),
            ("ImageOrientationPatient", slice_.numbers["ImageOrientationPatient"], 6),
            ("PixelSpacing", slice_.numbers["PixelSpacing"], 2),
            ("RescaleSlope and RescaleIntercept", slice_.rescale, 2),
        ):
            if len(value) != count or not np.isfinite(value).all():
                raise InputError(f"{path}: no {tag} in its header; export the series again with its complete header")
        if slice_.rescale[0] == 0:
            raise InputError(f"{path}: RescaleSlope is 0, which leaves no HU; export the series again")
        if slice_.words["RescaleType"] not in (*_HU_TYPES, *_PERHAPS_HU_TYPES):
            raise InputError(f"{path}: RescaleType is not HU; give the CT series in HU, not one computed from it")
        if slice_.words["PhotometricInterpretation"] == "MONOCHROME1":
            raise InputError(
                f"{path}: PhotometricInterpretation MONOCHROME1 (white is low): some programs invert such values, "
                "others do not; export the series as MONOCHROME2"
            )
        needed = slice_.size[0] * slice_.size[1] * slice_.whole("BitsAllocated", 16) // 8
        if slice_.transfer_syntax in _UNCOMPRESSED and path.stat().st_size < needed:
            raise InputError(f"{path}: truncated, its pixels are incomplete; copy or export the series again")
    if len(slices) < _FEWEST_SLICES:
        raise InputError(f"{folder}: only {slices_text(len(slices))}; give a series of at least {_FEWEST_SLICES}")
    for tag, values in (
        ("Rows and Columns", [slice_.size for slice_ in slices]),
        *((tag, [slice_.numbers[tag] for slice_ in slices]) for tag in ("PixelSpacing", "ImageOrientationPatient")),
    ):
        if np.ptp(np.array(values, dtype=float), axis=0).max() > 1e-3:
            raise InputError(f"{folder}: {tag} differ between slices; give a folder with one volume alone")
    open_types = sorted({slice_.words["RescaleType"] for slice_ in slices} & set(_PERHAPS_HU_TYPES))
    notes = [f"RescaleType {', '.join(open_types)} was taken as HU"] if open_types else []
    lossy = [s for s in slices if s.transfer_syntax in _LOSSY or s.words["LossyImageCompression"] == "01"]
    if lossy:
        name = _syntax_name(lossy[0].transfer_syntax)
        notes.append(f"compressed with loss ({name}): HU are not those of the scanner")
    return notes


def _geometry(
    slices: Sequence[_Slice], axes: Float[np.ndarray, "3 2"], normal: Float[np.ndarray, "3"], folder: Path
) -> tuple[list[_Slice], Volume]:
    """Return slices in order, and where they lie (DICOM PS3.3 C.7.6.2.1.1); gaps are refused."""
    positions = np.array([slice_.numbers["ImagePositionPatient"] for slice_ in slices])
    order = np.argsort(positions @ normal, kind="stable")
    steps = np.diff(positions[order] @ normal)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(np.round(steps / usual) > 1)
    if gaps.size:
        first = gaps[0]
        count = "1 irregular slice distance" if gaps.size == 1 else f"{gaps.size} irregular slice distances"
        raise InputError(
            f"{folder}: {count}, the first {steps[first]:.2f} mm instead of {usual:.2f} mm after slice {first + 1}: "
            "slices are missing; export the whole series again"
        )
    spacing, size = slices[0].numbers["PixelSpacing"], slices[0].size
    place = slice_grid(positions[order], axes, spacing, size, path=folder)
    return [slices[i] for i in order], place


def _read_pixels(slices: Sequence[_Slice]) -> tuple[np.ndarray, list[str]]:
    """Return HU of slices in the order given, int16 if whole, else float32; pixels that show nothing become air."""
    padded = 0
    whole = all(number.is_integer() for slice_ in slices for number in slice_.rescale)
    voxels = np.empty((len(slices), *slices[0].size), dtype=np.float32)
    sitk.ProcessObject.SetGlobalWarningDisplay(False)  # GDCM's own lines may quote header values
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    with progress("Reading DICOM slices", len(slices)) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for slice_, plane in zip(slices, voxels, strict=True):
            try:
                plane[:] = _decoded(slice_, reader).reshape(plane.shape)
            except Exception:
                # The decoder's message may quote the header, so it is not passed on.
                raise InputError(
                    f"{slice_.path}: its pixels cannot be decoded (truncated or damaged "
                    f"{_syntax_name(slice_.transfer_syntax)}); copy or export the series again, or decompress it "
                    "(gdcmconv --raw)"
                ) from None
            padded += _pad(slice_, plane)
            advance()
    notes = []
    if padded:
        notes.append(f"{padded} pixels of PixelPaddingValue, which show nothing, were set to {_AIR_HU:g} HU")
    limits = np.iinfo(np.int16)
    if whole and limits.min <= voxels.min() and voxels.max() <= limits.max:
        return voxels.astype(np.int16), notes
    return voxels, notes


def _pad(slice_: _Slice, plane: Float[np.ndarray, "ny nx"]) -> int:
    """Set the pixels of a slice that show nothing to the HU of air, and return how many were anything else."""
    if not slice_.padding:
        return 0
    slope, intercept = slice_.rescale
    low, high = sorted(np.float32(value * slope + intercept) for value in slice_.padding)
    nothing = (plane >= low) & (plane <= high) & (plane != _AIR_HU)
    plane[nothing] = _AIR_HU
    return int(np.count_nonzero(nothing))


def _decoded(slice_: _Slice, reader: sitk.ImageFileReader) -> np.ndarray:
    if slice_.transfer_syntax in _ENCAPSULATED:
        content = slice_.path.read_bytes()
        begin = max(content.rfind(mark) for mark in _PIXELS_BEGIN)
        if begin < 0 or content.rfind(_PIXELS_END) < begin:
            raise ValueError("encapsulated pixels without an end")
    if slice_.transfer_syntax == _RLE:
        slope, intercept = slice_.rescale
        return pixel_array(slice_.path) * np.float32(slope) + np.float32(intercept)
    reader.SetFileName(str(slice_.path))
    return sitk.GetArrayFromImage(reader.Execute())
