"""Reading and writing volumes and masks, in LPS mm and HU, whatever the file format: a file is read right, or its
volume's notes say what was changed, or it is refused in one line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk

from endopilot.errors import InputError
from endopilot.files import json_text, read_json, regular, sha256, writing
from endopilot.imaging import dicom_seg
from endopilot.imaging.geometry import farthest_apart_mm
from endopilot.imaging.grid import to_image
from endopilot.imaging.nifti import read_nifti
from endopilot.imaging.segments import ImageFile, inside_segment
from endopilot.imaging.text_headers import read_metaimage, read_nrrd
from endopilot.imaging.voxels import compact
from endopilot.settings import public
from endopilot.types import Insertion, LumenMask, Volume

SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha")  # file formats that are read and written, by suffix
MASK_SUFFIXES = (*SUFFIXES, dicom_seg.SUFFIX)  # file formats of masks, by suffix; the last is a DICOM-SEG object

_READ_ONLY_SUFFIXES = (".mhd", ".nhdr")
_SMALLEST_SIZE = 4  # fewer voxels than this along an axis are no volume: a slice, or a scout view


@public
def read_volume(path: str | Path, *, series: str | None = None, phase: str | None = None) -> Volume:
    """Read a CT volume in HU.

    Args:
        path: a folder with one DICOM series, one of its files, or a NIfTI, NRRD or MHA file.
        series: which series to take where a folder holds several: its number, or its SeriesInstanceUID.
        phase: which cardiac phase to take where a series holds several: its number as the headers give it, such as
            75 (per cent of the cycle).

    Returns:
        The volume, int16 where the HU are whole numbers, float32 otherwise. Its notes say what reading it changed.

    Raises:
        InputError: the path is missing, is of an unknown format or damaged, or holds anything but one plain
            three-dimensional volume (several series or phases, missing slices, gantry tilt, 4-D, RGB).
    """
    path = regular(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    try:
        if path.is_dir() or (_suffix(path) is None and _is_dicom(path)):
            from endopilot.imaging.dicom import read_series  # pydicom comes with an extra

            return read_series(path, series, phase)
    except PermissionError as error:
        raise InputError(f"{path}: may not be read ({error.strerror}); ask for access to it") from error
    for name, value in (("series", series), ("phase", phase)):
        if value is not None:
            plural = "series" if name == "series" else "phases"
            raise InputError(f"{path}: {name}={value!r} was given, but only DICOM has {plural}; leave the option out")
    image = _read_file(path)
    if len(image.layers) > 1:
        raise InputError(f"{path}: a segmentation of {len(image.layers)} layers; give the CT, in HU")
    volume = replace(image.volume, voxels=compact(image.volume.voxels))
    if not np.isfinite(volume.voxels).all():
        raise InputError(f"{path}: some voxels are not finite numbers; write it again with −1024 HU in their place")
    return volume


def _is_dicom(path: Path) -> bool:
    """Tell whether a file starts as DICOM Part 10 files do: 128 bytes of preamble, then DICM."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def check_output(path: str | Path, *, mask: bool = False) -> None:
    """Raise InputError for a name that nothing could be written under, before the work is done: an unknown suffix, a
    folder that holds something, DICOM-SEG without highdicom, or a JSON file beside a mask that is not this mask's."""
    path = Path(path)
    if mask and (sidecar := _sidecar(path)).exists() and _mask_of(sidecar).get("name") != path.name:
        raise InputError(
            f"{sidecar}: is there already and is not the record of {path.name}, which would replace it; choose another "
            "name, or move it away"
        )
    if mask and path.suffix.lower() == dicom_seg.SUFFIX:
        dicom_seg.need_highdicom(path)
    elif not mask and path.suffix == "":
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path}: is there already; give a new folder for the DICOM series")
    elif _suffix(path) not in SUFFIXES:
        others = f"or {dicom_seg.SUFFIX} (DICOM-SEG)" if mask else "or a folder without suffix for DICOM slices"
        raise InputError(f"{path}: unknown format; name the output with one of {', '.join(SUFFIXES)}, {others}")


def write_volume(volume: Volume, path: str | Path) -> None:
    """Write a volume; the suffix (.nii.gz, .nii, .nrrd, .mha) chooses the format, and a new folder makes a DICOM
    series, of whole HU. Booleans become uint8. Raises InputError for a suffix or folder that does not do."""
    path = Path(path)
    check_output(path)
    if path.suffix == "":
        from endopilot.imaging.dicom_write import write_series  # pydicom comes with an extra

        write_series(volume, path)
        return
    with writing(path) as partial:
        _write_file(volume, partial)


def _write_file(volume: Volume, partial: Path) -> None:
    """Write a volume to a temporary file, and read it again: ITK does not tell of a full disk (OSError)."""
    try:
        # Level 1 costs a few percent in size and saves most of the time.
        sitk.WriteImage(to_image(volume), partial, useCompression=partial.suffix != ".nii", compressionLevel=1)
        again = _decoded(partial).volume
    except (RuntimeError, InputError) as error:
        raise OSError("its writer failed") from error
    near = farthest_apart_mm(again, volume) < volume.spacing_mm.min() / 2
    if not near or not np.array_equal(again.voxels, volume.voxels, equal_nan=True):
        raise OSError("what was written is not the volume")


def read_mask(path: str | Path, *, label: int | str | None = None, threshold: float | None = None) -> LumenMask:
    """Read the mask of one vessel, with its ostium where `write_mask` left a sidecar JSON of this very file beside it.

    Args:
        path: a NIfTI, NRRD or MHA file of whole numbers, 0 outside, or of grey levels; or a DICOM-SEG object.
        label: number or name of the segment to take where the file holds several; segments may overlap.
        threshold: of grey levels, the value at the wall; the volume's border is outside.

    Raises:
        InputError: the file is missing, damaged or no mask, the label is not in it, or nothing is inside.
    """
    path = regular(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    if path.suffix.lower() == dicom_seg.SUFFIX:
        if threshold is not None:
            raise InputError(f"{path}: threshold={threshold:g}: DICOM-SEG holds no grey levels; leave the option out")
        volume = dicom_seg.read_seg(path, label)
    else:
        image = _read_file(path)
        inside, notes = inside_segment(image, label, threshold, path)
        volume = replace(image.volume, voxels=inside, notes=(*image.volume.notes, *notes))
    ostium, method, warnings = _read_sidecar(path)
    return LumenMask(volume, ostium, method, (*volume.notes, *warnings))


def write_mask(mask: LumenMask, path: str | Path, *, manifest: Mapping[str, Any]) -> None:
    """Write a mask (.nii.gz, .nii, .nrrd, .mha, or .dcm for DICOM-SEG), and `<stem>.json` with its ostium, method,
    warnings, the run's manifest, and the mask's SHA-256, by which it is of no other; or neither. Raises as
    `check_output`."""
    path = Path(path)
    check_output(path, mask=True)
    ostium = mask.ostium
    with writing(_sidecar(path)) as record, writing(path) as partial:
        if path.suffix.lower() == dicom_seg.SUFFIX:
            dicom_seg.write_seg(mask, partial)
        else:
            _write_file(mask.volume, partial)
        content = {
            "mask": {"name": path.name, "sha256": sha256(partial)},
            "ostium": ostium and {"position_mm": ostium.position, "direction": ostium.direction},
            "method": mask.method,
            "warnings": list(mask.warnings),
            "manifest": dict(manifest),
        }
        record.write_text(json_text(content) + "\n", encoding="utf-8")


def _suffix(path: Path) -> str | None:
    name = path.name.lower()
    return next((suffix for suffix in (*SUFFIXES, *_READ_ONLY_SUFFIXES) if name.endswith(suffix)), None)


def _sidecar(path: Path) -> Path:
    suffix = _suffix(path) or path.suffix
    return path.with_name(path.name[: len(path.name) - len(suffix)] + ".json")


def _read_file(path: Path) -> ImageFile:
    try:
        image = _decoded(path)
    except OSError as error:
        raise InputError(f"{path}: may not be read ({error.strerror}); ask for access to it") from error
    shape = image.volume.voxels.shape[::-1]
    if min(shape) < _SMALLEST_SIZE:
        raise InputError(
            f"{path}: {'×'.join(map(str, shape))} voxels are no volume; give at least {_SMALLEST_SIZE} along each axis"
        )
    return image


def _decoded(path: Path) -> ImageFile:
    suffix = None if path.is_dir() else _suffix(path)
    if suffix is None:
        raise InputError(
            f"{path}: unknown format; give one of {', '.join(SUFFIXES)}, or a folder of DICOM slices (3D Slicer opens "
            "most others and saves them as .nrrd)"
        )
    return {".nrrd": read_nrrd, ".nhdr": read_nrrd, ".mha": read_metaimage, ".mhd": read_metaimage}.get(
        suffix, read_nifti
    )(path)


def _mask_of(sidecar: Path) -> dict[str, Any]:
    """Return name and SHA-256 of the mask that a sidecar is of; nothing where it is another's JSON file."""
    try:
        of = read_json(sidecar, keys=("mask", "ostium"))["mask"]
    except InputError:
        return {}
    return of if isinstance(of, dict) else {}


def _read_sidecar(mask: Path) -> tuple[Insertion | None, str, tuple[str, ...]]:
    """Return ostium, method and warnings from the sidecar of a mask. An ostium in another vessel is plausible and
    wrong: where the sidecar is not of this very file, the ostium is not taken, and a warning gives it."""
    path = _sidecar(mask)
    content = read_json(path) if path.exists() else None
    if not isinstance(content, dict) or "ostium" not in content:
        return None, "given", ()
    ostium, method, warnings = content["ostium"], str(content.get("method", "given")), content.get("warnings", [])
    if not isinstance(warnings, list) or not all(isinstance(warning, str) for warning in warnings):
        raise InputError(f"{path}: warnings is no list of sentences; make the mask again")
    if ostium is not None:
        ostium = _insertion(ostium, path)
    of = _mask_of(path)
    if of.get("sha256") == sha256(mask):
        return ostium, method, tuple(warnings)
    name = of.get("name")
    whose = f"{name} before it was changed" if name == mask.name else name or "a mask that it does not name"
    given = (
        "" if ostium is None else "; if its ostium is right, give --ostium-mm {:g} {:g} {:g}".format(*ostium.position)
    )
    return None, "given", (f"{path.name} is the record of {whose}, and was left out for {mask.name}{given}",)


def _insertion(given: Any, path: Path) -> Insertion:
    try:
        position, direction = (np.array(given[name], dtype=float) for name in ("position_mm", "direction"))
    except (KeyError, TypeError, ValueError):
        position = direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if position.shape != (3,) or direction.shape != (3,) or not np.isfinite(position).all() or not 0 < length < np.inf:
        raise InputError(
            f"{path}: ostium needs position_mm and direction, three finite numbers each, direction not zero"
        )
    return Insertion(position, direction / length)
