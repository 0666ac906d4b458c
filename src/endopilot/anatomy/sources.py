"""What an anatomy can be made from, read from files: a mask, a surface, or centerlines with radii."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot import files
from endopilot.anatomy.surface import Surface
from endopilot.errors import InputError
from endopilot.types import LumenMask, VesselTree

MASK_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
SURFACE_SUFFIXES = (".stl", ".obj", ".ply", ".vtp", ".vtk")
RADIUS_NAMES = ("maximuminscribedsphereradius", "misr", "radius", "radii")
"""Names of the point array or measurement that holds radii, in lower case: VMTK's, Slicer's, and plain ones."""

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Polylines:
    """Centerlines as a file holds them: any number of lines, in any order and direction, possibly overlapping.

    Attributes:
        points: positions of each line, mm.
        radius: inscribed-sphere radii of each line, mm.
        names: what messages call each line; its number if none are given.
    """

    points: tuple[Float[np.ndarray, "_ 3"], ...]
    radius: tuple[Float[np.ndarray, "_"], ...]
    names: tuple[str, ...] = ()

    def name(self, number: int) -> str:
        """Return what messages call a line."""
        return f"line {self.names[number]!r}" if self.names else f"line {number}"


@dataclass(frozen=True, eq=False)
class AnatomySource:
    """The content of a file, and which file it was.

    Attributes:
        content: mask, surface (as read, perhaps open) or centerlines; in LPS where the file states its axes.
        file: name of the file, without its folder.
        sha256: its SHA-256.
        coordinates: axes that the file states, "lps" or "ras"; None where it states none.
        factor: mm in the unit that the file states; `content` is in mm already where that is not 1.
        notes: what the reader did or left out, a sentence each.
    """

    content: LumenMask | Surface | Polylines | VesselTree
    file: str = ""
    sha256: str = ""
    coordinates: str | None = None
    factor: float = 1.0
    notes: tuple[str, ...] = ()


def read_source(path: str | Path, *, label: int | str | None = None) -> AnatomySource:
    """Read a vessel from a mask, a surface or centerlines; the kind follows from the file.

    Args:
        path: mask (NIfTI, NRRD, MHA, DICOM-SEG), surface (STL, OBJ, PLY, VTP, VTK) or centerline (VTP with lines and
            radii, as VMTK writes it, or a Slicer markups curve `.mrk.json` with a radius measurement); or the folder
            of a patient's markups curves, which are the lines of one tree.
        label: number or name of the segment that is the lumen, where a mask has several.

    Raises:
        InputError: the file is missing, damaged, empty, of an unknown kind, or a centerline without radii.
    """
    path = Path(path)
    if not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: no such file; give a mask, a surface or a centerline")
    lower = path.name.lower()
    if label is not None and not lower.endswith(MASK_SUFFIXES):
        raise InputError(f"{path}: --label {label} was given, but only masks have labels; leave the option out")
    if path.is_dir():
        return _read_curves(path)
    if lower.endswith(MASK_SUFFIXES):
        from endopilot.imaging.volume import read_mask

        source = AnatomySource(read_mask(path, label=label), coordinates="lps")
    elif lower.endswith(".json"):
        from endopilot.anatomy.markups import read_markups

        source = read_markups(path)
    elif lower.endswith(SURFACE_SUFFIXES):
        from endopilot.anatomy.polydata import read_polydata

        source = read_polydata(path)
    else:
        known = " ".join((*MASK_SUFFIXES, *SURFACE_SUFFIXES, ".mrk.json"))
        raise InputError(f"{path}: unknown kind of file; known are {known}")
    read = source.content.volume.files if isinstance(source.content, LumenMask) else ()
    return replace(source, file=path.name, sha256=files.input_hash(path, read)[path.name])


def _read_curves(folder: Path) -> AnatomySource:
    """Return all markups curves of a folder as the lines of one tree.

    Raises:
        InputError: the folder holds none, or one cannot be read.
    """
    from endopilot.anatomy.markups import read_markups

    entries = sorted(folder.iterdir())
    curves = [path for path in entries if path.name.lower().endswith(".mrk.json")]
    if not curves:
        raise InputError(f"{folder}: holds no curves (.mrk.json); give a file or a folder of curves")
    read = [read_markups(path) for path in curves]
    lines = [source.content for source in read if isinstance(source.content, Polylines)]
    names = [
        path.name[: -len(".mrk.json")] for path, own in zip(curves, lines, strict=True) for _ in range(len(own.points))
    ]
    factors = {source.factor for source in read}
    notes = [f"{len(curves)} files of curves in the folder are the lines of one tree"]
    if len(entries) > len(curves):
        others = ", ".join(path.name for path in entries if path not in curves)
        notes.append(f"beside the curves the folder holds {others}: left out")
    notes += [f"{path.name}: {note}" for path, source in zip(curves, read, strict=True) for note in source.notes]
    return AnatomySource(
        Polylines(
            tuple(points for own in lines for points in own.points),
            tuple(radius for own in lines for radius in own.radius),
            tuple(names),
        ),
        file=folder.resolve().name,
        sha256=next(iter(files.input_hash(folder, curves).values())),
        coordinates=" and ".join(sorted({source.coordinates or "lps" for source in read})),
        factor=factors.pop() if len(factors) == 1 else 1.0,
        notes=tuple(notes),
    )


def transformed(source: AnatomySource, *, scale: float, coordinates: str | None) -> AnatomySource:
    """Return a source in LPS mm, with a note where nothing states the axes.

    Args:
        source: as read.
        scale: factor that turns its unit into mm; 1 where it is mm, or where the file states its unit.
        coordinates: "lps" or "ras" where the user states the axes, otherwise None.

    Raises:
        InputError: the user states other axes or another unit than the file.
    """
    label, notes = source.file or "the source", source.notes
    if coordinates is not None and source.coordinates is not None and coordinates != source.coordinates:
        stated = (
            "is a mask, which is read in LPS whatever its own axes"
            if isinstance(source.content, LumenMask)
            else (f"states {source.coordinates.upper()}")
        )
        raise InputError(f"{label}: --coordinates {coordinates} was given, but the file {stated}; leave the option out")
    if source.factor != 1.0:
        if scale not in (1.0, source.factor):
            raise InputError(
                f"{label}: --scale {scale:g} was given, but the file states a unit of {source.factor:g} mm; "
                "leave the option out"
            )
        scale = 1.0
    if source.coordinates is None and coordinates is None and source.file:
        notes = (*notes, "axes not stated: taken for LPS (--coordinates ras if they are RAS)")
    turned = coordinates == "ras" and source.coordinates is None
    content = in_mm(source.content, scale, RAS_TO_LPS if turned else np.ones(3))
    return replace(source, content=content, notes=notes)


def in_mm(content: Any, factor: float, turn: Float[np.ndarray, "3"]) -> Any:
    """Return what a source holds with positions and radii multiplied by `factor`, and axes turned over by signs."""
    if isinstance(content, Surface):
        return Surface(content.vertices * turn * factor, content.faces)
    if isinstance(content, Polylines):
        points = tuple(points * turn * factor for points in content.points)
        return replace(content, points=points, radius=tuple(radius * factor for radius in content.radius))
    if isinstance(content, LumenMask) and factor != 1.0:
        volume, ostium = content.volume, content.ostium
        return replace(
            content,
            volume=replace(volume, spacing_mm=volume.spacing_mm * factor, origin_mm=volume.origin_mm * factor),
            ostium=None if ostium is None else replace(ostium, position=ostium.position * factor),
        )
    return content


def checked_lines(lines: Polylines, path: Path) -> Polylines:
    """Return centerlines whose positions are finite and whose radii are positive.

    Raises:
        InputError: there is no line, or a position or radius is none.
    """
    if not lines.points:
        raise InputError(f"{path}: holds no line of at least two points; export the centerline again")
    radius = np.concatenate(lines.radius)
    if not (np.isfinite(radius).all() and np.isfinite(np.concatenate(lines.points)).all()):
        raise InputError(f"{path}: some positions or radii are not finite numbers; export the centerline again")
    if (radius <= 0).all():
        raise InputError(f"{path}: all radii are zero; write inscribed-sphere radii in mm")
    if (radius <= 0).any():
        raise InputError(
            f"{path}: {int((radius <= 0).sum())} of {len(radius)} radii are not positive; mend those points"
        )
    return lines
