"""Reading and writing volumes and masks, in LPS mm, whatever the file format.

CT comes from a DICOM series or from NIfTI, NRRD or MHA; masks from the last three or DICOM-SEG. SimpleITK turns RAS
files into LPS and applies the rescale slope and intercept, so that voxels are HU; what it reads without complaint
although it is not one plain three-dimensional CT is refused here in one line.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk

from endopilot.errors import InputError
from endopilot.files import read_json, write_json, writing
from endopilot.imaging import dicom_seg
from endopilot.imaging.grid import from_image, to_image
from endopilot.imaging.nifti import check_nifti
from endopilot.types import Insertion, LumenMask, Volume

SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha")
"""File formats that are read and written, by suffix."""

MASK_SUFFIXES = (*SUFFIXES, dicom_seg.SUFFIX)
"""File formats of masks, by suffix; the last is a DICOM-SEG object."""

_READ_ONLY_SUFFIXES = (".mhd", ".nhdr")
_SMALLEST_SIZE = 4
"""Fewer voxels than this along an axis are no volume: a slice, or a scout view."""

_MOST_LABELS_LISTED = 20


def read_volume(path: str | Path, *, series: str | None = None) -> Volume:
    """Read a CT volume in HU.

    Args:
        path: a folder with one DICOM series, one of its files, or a NIfTI, NRRD or MHA file.
        series: which series to take where a folder holds several: its number, or its SeriesInstanceUID.

    Returns:
        The volume, int16 where the HU are whole numbers, float32 otherwise.

    Raises:
        InputError: the path is missing, is of an unknown format or damaged, or holds anything but one plain
            three-dimensional volume (several series, missing slices, gantry tilt, 4-D, RGB).
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    try:
        if path.is_dir() or (_suffix(path) is None and _is_dicom(path)):
            from endopilot.imaging.dicom import read_series  # pydicom comes with an extra

            return read_series(path, series)
    except PermissionError as error:
        raise InputError(f"{path}: may not be read ({error.strerror}); ask for access to it") from error
    if series is not None:
        raise InputError(f"{path}: series={series!r} was given, but only DICOM has series; leave the option out")
    volume = _read_file(path)
    if not np.isfinite(volume.voxels).all():
        raise InputError(f"{path}: some voxels are not finite numbers; write it again with −1024 HU in their place")
    return volume


def _is_dicom(path: Path) -> bool:
    """Tell whether a file starts as DICOM Part 10 files do: 128 bytes of preamble, then DICM."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def check_output(path: str | Path, *, mask: bool = False) -> None:
    """Refuse a name that nothing could be written under, before the work is done.

    Args:
        path: where a volume, or a mask, is to be written.
        mask: it is a mask; a volume may go to a folder of DICOM slices too, a mask to a DICOM-SEG object.

    Raises:
        InputError: the suffix is unknown, the folder holds something, or highdicom is absent.
    """
    path = Path(path)
    if mask and path.suffix.lower() == dicom_seg.SUFFIX:
        dicom_seg.need_highdicom(path)
    elif not mask and path.suffix == "":
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path}: is there already; give a new folder for the DICOM series")
    elif _suffix(path) not in SUFFIXES:
        others = f"or {dicom_seg.SUFFIX} (DICOM-SEG)" if mask else "or a folder without suffix for DICOM slices"
        raise InputError(f"{path}: unknown format; name the output with one of {', '.join(SUFFIXES)}, {others}")


def write_volume(volume: Volume, path: str | Path) -> None:
    """Write a volume; the suffix of `path` chooses the format, and a path without suffix makes a DICOM series.

    Booleans are written as uint8; a DICOM series holds whole HU.

    Args:
        volume: the volume.
        path: a file ending in .nii.gz, .nii, .nrrd or .mha, or a new folder for a DICOM series of CT images.

    Raises:
        InputError: the suffix is unknown, the folder holds something or cannot be written, or the disk is full.
    """
    path = Path(path)
    check_output(path)
    if path.suffix == "":
        from endopilot.imaging.dicom_write import write_series  # pydicom comes with an extra

        write_series(volume, path)
        return
    with writing(path) as partial:
        try:
            # Level 1 costs a few percent in size and saves most of the time.
            sitk.WriteImage(to_image(volume), partial, useCompression=path.suffix != ".nii", compressionLevel=1)
        except RuntimeError as error:
            raise InputError(
                f"{path}: cannot be written; see that the folder is writable and the disk is not full"
            ) from error


def read_mask(path: str | Path, *, label: int | None = None) -> LumenMask:
    """Read the mask of one vessel, with its ostium where `write_mask` left a sidecar JSON beside it.

    Args:
        path: a NIfTI, NRRD or MHA file of whole numbers, 0 outside, or a DICOM-SEG object.
        label: which value to take where the file holds several.

    Returns:
        The mask; its ostium is None where no sidecar holds it.

    Raises:
        InputError: the file is missing, damaged or no mask, the label is not in it, or nothing is inside.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    volume = dicom_seg.read_seg(path) if path.suffix.lower() == dicom_seg.SUFFIX else _read_file(path)
    inside = _inside(volume.voxels, label, path)
    sidecar = _sidecar(path)
    ostium, method = _read_sidecar(sidecar) if sidecar.exists() else (None, "given")
    return LumenMask(Volume(inside, volume.spacing_mm, volume.origin_mm, volume.direction), ostium, method)


def write_mask(mask: LumenMask, path: str | Path, *, manifest: Mapping[str, Any]) -> None:
    """Write a mask, and beside it `<stem>.json` with its ostium, method and warnings and the manifest of the run.

    Args:
        mask: the mask.
        path: a file ending in .nii.gz, .nii, .nrrd, .mha, or .dcm for a DICOM-SEG object.
        manifest: the record of the run, as `endopilot.files.manifest` makes it.

    Raises:
        InputError: the suffix is unknown, highdicom is absent, the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    check_output(path, mask=True)
    if path.suffix.lower() == dicom_seg.SUFFIX:
        dicom_seg.write_seg(mask, path)
    else:
        write_volume(mask.volume, path)
    ostium = mask.ostium
    write_json(
        _sidecar(path),
        {
            "ostium": ostium and {"position_mm": ostium.position, "direction": ostium.direction},
            "method": mask.method,
            "warnings": list(mask.warnings),
            "manifest": dict(manifest),
        },
    )


def _suffix(path: Path) -> str | None:
    """Return the known suffix that the file's name ends in, or None."""
    name = path.name.lower()
    return next((suffix for suffix in (*SUFFIXES, *_READ_ONLY_SUFFIXES) if name.endswith(suffix)), None)


def _sidecar(path: Path) -> Path:
    suffix = _suffix(path) or path.suffix
    return path.with_name(path.name[: len(path.name) - len(suffix)] + ".json")


def _read_file(path: Path) -> Volume:
    """Read one file whose suffix SimpleITK supports, refusing what is not a scalar volume."""
    if path.is_dir() or _suffix(path) is None:
        raise InputError(f"{path}: unknown format; give one of {', '.join(SUFFIXES)}, or a folder of DICOM slices")
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        with _quiet_itk():
            reader.ReadImageInformation()
    except RuntimeError as error:
        raise InputError(f"{path}: {_reason(error, path)}; export it again") from error
    size = tuple(reader.GetSize())
    shape = "×".join(map(str, size))
    components = reader.GetNumberOfComponents()
    if components != 1:
        raise InputError(f"{path}: {components} values in every voxel (colour or vectors); give a grey-level volume")
    if len(size) > 3 and any(extent > 1 for extent in size[3:]):
        raise InputError(f"{path}: {len(size)}-D ({shape}); give a single 3-D volume, such as one cardiac phase")
    if len(size) < 3 or min(size[:3]) < _SMALLEST_SIZE:
        raise InputError(f"{path}: {shape} voxels are no volume; give at least {_SMALLEST_SIZE} along each axis")
    if path.name.lower().endswith((".nii", ".nii.gz")):
        check_nifti(path)
    if path.name.lower().endswith((".nrrd", ".nhdr")) and not reader.HasMetaDataKey("NRRD_space"):
        raise InputError(f"{path}: has no orientation (no space in its header); export it with its space directions")
    try:
        with _quiet_itk():
            image = reader.Execute()
        if len(size) > 3:
            image = sitk.Extract(image, [*size[:3], *(0 for _ in size[3:])])
    except RuntimeError as error:
        raise InputError(f"{path}: truncated or damaged ({_reason(error, path)}); copy or export it again") from error
    return _compact(from_image(image))


def _compact(volume: Volume) -> Volume:
    """Hold whole numbers that fit as int16, all others as float32."""
    voxels = volume.voxels
    limits = np.iinfo(np.int16)
    whole = voxels.dtype.kind in "iu" and voxels.min() >= limits.min and voxels.max() <= limits.max
    voxels = voxels.astype(np.int16 if whole else np.float32)
    return Volume(voxels, volume.spacing_mm, volume.origin_mm, volume.direction)


def _reason(error: RuntimeError, path: Path) -> str:
    """Say in a few words what ITK's long message means; its paths and source lines help nobody."""
    text = str(error)
    if "orthonormal" in text.lower():
        return "its axes are not at right angles (a sheared affine)"
    if "Unable to determine ImageIO reader" in text:
        return "its content does not match its suffix, or its header is damaged"
    if path.suffix.lower() in _READ_ONLY_SUFFIXES:
        return "the file of voxels that it names is missing, incomplete or damaged"
    return "its header or voxels cannot be read"


@contextmanager
def _quiet_itk() -> Iterator[None]:
    """Keep ITK's and MetaIO's own lines off standard error, where they would bury ours."""
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _inside(values: np.ndarray, label: int | None, path: Path) -> np.ndarray:
    """Return where a label image holds the label, after making sure that it is one."""
    if not np.isfinite(values).all() or values.min() < 0 or not np.array_equal(values, np.round(values)):
        raise InputError(
            f"{path}: values from {values.min():g} to {values.max():g} are no mask; give whole numbers ≥ 0"
        )
    labels = np.unique(values[values > 0]).astype(int)
    listed = ", ".join(map(str, labels[:_MOST_LABELS_LISTED])) + (", …" if len(labels) > _MOST_LABELS_LISTED else "")
    if len(labels) == 0:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    if label is None and len(labels) > 1:
        raise InputError(f"{path}: the mask holds {len(labels)} labels ({listed}); choose one: label=N (--label N)")
    if label is not None and label not in labels:
        raise InputError(f"{path}: no voxel has label {label}; the file holds {listed}")
    return values == (labels[0] if label is None else label)


def _read_sidecar(path: Path) -> tuple[Insertion | None, str]:
    """Return ostium and method from a sidecar; JSON files that others put beside a mask have neither."""
    content = read_json(path)
    if not isinstance(content, dict) or "ostium" not in content:
        return None, "given"
    ostium, method = content["ostium"], str(content.get("method", "given"))
    if ostium is None:
        return None, method
    try:
        position = np.array(ostium["position_mm"], dtype=float)
        direction = np.array(ostium["direction"], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: ostium needs position_mm and direction, three numbers each") from error
    length = np.linalg.norm(direction)
    if position.shape != (3,) or direction.shape != (3,) or not np.isfinite(position).all() or not 0 < length < np.inf:
        raise InputError(
            f"{path}: ostium needs position_mm and direction, three finite numbers each, direction not zero"
        )
    return Insertion(position, direction / length), method
