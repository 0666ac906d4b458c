"""Reading what an anatomy is made from: the kind of file decides which reader takes it; those of markups stand here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot import files
from endopilot.errors import InputError
from endopilot.types import LumenMask
from endopilot.vessels.sources import (
    AXES,
    RADIUS_NAMES,
    RAS_TO_LPS,
    AnatomySource,
    Polylines,
    checked_lines,
    mm_per_unit,
)

MASK_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
SURFACE_SUFFIXES = (".stl", ".obj", ".ply", ".vtp", ".vtu", ".vtk")

_TABLE = "a table of points and radii becomes an anatomy in Python, by endopilot.Polylines (docs/guide/patient.md)"
_CONVERT = {
    ".csv": _TABLE,
    ".txt": _TABLE,
    ".swc": "write its points as the lines of a VTP with an array Radius (mm)",
    ".fcsv": "its points are a list without radii; open it in Slicer and save a centerline curve as .mrk.json",
    ".ctgr": "SimVascular's contours are no wall; export its model as VTP or its mesh as VTU",
    ".glb": "open it in Blender or MeshLab and export STL or PLY",
    ".gltf": "open it in Blender or MeshLab and export STL or PLY",
    ".step": "open it in the CAD program and export STL in mm",
    ".pth": "SimVascular's path has no radii; export its model as VTP or its mesh as VTU",
}
"""How a file that is not read becomes one that is, by its suffix."""


_NUMBERED_AXES = {"0": "ras", "1": "lps"}  # axes by the numbers of Slicer's older files


def read_source(path: str | Path, *, label: int | str | None = None, threshold: float | None = None) -> AnatomySource:
    """Read a vessel from a mask, a surface or centerlines; the kind follows from the file.

    Args:
        path: mask (NIfTI, NRRD, MHA, DICOM-SEG), surface (STL, OBJ, PLY, VTP, VTU, VTK) or centerline (VTP with lines
            and radii, as VMTK writes it, or a Slicer markups curve `.mrk.json` with radii); or the folder of a
            patient's markups curves, which are the lines of one tree.
        label: number or name of the segment that is the lumen, where a mask has several.
        threshold: of a mask of grey levels, the value at the wall.

    Raises:
        InputError: the file is missing, damaged, empty, of an unknown kind, or a centerline without radii.
    """
    path = Path(path)
    if not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: no such file; give a mask, a surface or a centerline")
    lower = path.name.lower()
    for option, value in (("label", label), ("threshold", threshold)):
        if value is not None and not lower.endswith(MASK_SUFFIXES):
            raise InputError(f"{path}: --{option} {value} was given, but only masks have {option}s; leave it out")
    if path.is_dir():
        return _read_curves(path)
    if lower.endswith(MASK_SUFFIXES):
        from endopilot.imaging.volume import read_mask  # slow to import

        source = AnatomySource(read_mask(path, label=label, threshold=threshold), coordinates="lps")
    elif lower.endswith(".json"):
        source = _read_markups(path)
    elif lower.endswith(SURFACE_SUFFIXES):
        from endopilot.vessels.polydata import read_polydata  # slow to import

        source = read_polydata(path)
    else:
        known = " ".join((*MASK_SUFFIXES, *SURFACE_SUFFIXES, ".mrk.json"))
        convert = _CONVERT.get(path.suffix.lower())
        raise InputError(f"{path}: unknown kind of file; {convert or f'known are {known}'}")
    read = source.content.volume.files if isinstance(source.content, LumenMask) else ()
    return replace(source, file=path.name, sha256=files.input_hash(path, read)[path.name])


def _read_curves(folder: Path) -> AnatomySource:
    entries = sorted(folder.iterdir())
    curves = [path for path in entries if path.name.lower().endswith(".mrk.json")]
    if (folder / "anatomy.json").exists():
        raise InputError(f"{folder}: is an anatomy already; give it to the next command, such as `endopilot simulate`")
    if not curves:
        raise InputError(f"{folder}: holds no curves (.mrk.json); give a file or a folder of curves")
    read = [_read_markups(path) for path in curves]
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


def _read_markups(path: Path) -> AnatomySource:
    """Read the curves of Slicer's markups, in LPS mm; other markups beside them are left out with a note."""
    content = files.read_json(path)
    markups = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(markups, list) or not markups or not all(isinstance(markup, dict) for markup in markups):
        raise InputError(f"{path}: holds no Slicer markups; export the centerline curve as .mrk.json")
    curves, notes, others = [], list[str](), list[str]()
    for number, markup in enumerate(markups):
        name, kind = str(markup.get("label") or markup.get("name") or number), str(markup.get("type") or "Curve")
        if kind.lower() in ("curve", "line"):
            curves.append(_curve(markup, f"{path}: curve {name!r}", notes))
        else:
            others.append(f"{kind} {name!r} is no centerline")
    if not curves:
        raise InputError(f"{path}: {others[0]}; save it as an open curve (type Curve) in Slicer's Markups module")
    notes += [f"{other}, and is left out" for other in others]
    points, radii, axes, factors = zip(*curves, strict=True)
    lines = checked_lines(Polylines(points, radii), path, notes)
    factor = factors[0] if len(set(factors)) == 1 else 1.0
    return AnatomySource(lines, coordinates=" and ".join(sorted(set(axes))), factor=factor, notes=tuple(notes))


def _curve(
    markup: dict[str, Any], where: str, notes: list[str]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], str, float]:
    """Return the positions and radii of a curve, LPS mm, the axes and the mm in the unit that it states."""
    stated, unit = markup.get("coordinateSystem"), markup.get("coordinateUnits")
    axes = (AXES | _NUMBERED_AXES).get(str("LPS" if stated is None else stated).upper())
    if axes is None:
        raise InputError(
            f"{where}: coordinateSystem is {stated!r}, from which no place in the patient follows; "
            "save it in LPS or RAS"
        )
    factor = _factor(unit, where)
    try:
        control = markup["controlPoints"]
        given = np.array([point.get("positionStatus", "defined") == "defined" for point in control], dtype=bool)
        places = np.array([control[i]["position"] for i in np.flatnonzero(given)], dtype=float)
        measured = {str(each.get("name")).lower(): each for each in markup.get("measurements", ())}
        sizes = next((measured[wanted] for wanted in RADIUS_NAMES if wanted in measured), {})
        radius = np.array(sizes.get("controlPointValues", ()), dtype=float)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: a position or radius is no number; export the curve again") from error
    radius = radius[given] if radius.shape == given.shape else radius
    if len(places) < 2 or places.shape != (radius.size, 3):
        raise InputError(
            f"{where} has positions of the shape {places.shape} and {radius.size} radii (it measures "
            f"{', '.join(measured) or 'nothing'}), not a radius at each of two points or more; export it from Slicer's "
            "Extract Centerline module"
        )
    if not given.all():
        notes.append(f"{where}: {int((~given).sum())} control points without a position are left out")
    if stated is None:
        notes.append(f"{where}: axes not stated: taken for LPS, the default of the format")
    if factor != 1.0:
        notes.append(f"{where} states {_first(unit)}: multiplied by {factor:g}")
    own = sizes.get("units")
    turn = RAS_TO_LPS if axes == "ras" else 1.0
    return places * turn * factor, radius.ravel() * (_factor(own, where) if own else factor), axes, factor


def _factor(unit: Any, where: str) -> float:
    factor = 1.0 if unit is None else mm_per_unit(_first(unit))
    if factor is None:
        raise InputError(f"{where}: unit {unit!r} is no known length; save it in mm")
    return factor


def _first(unit: Any) -> Any:
    """Return a unit's own name: newer files write it as a list of name, system and meaning."""
    return unit[0] if isinstance(unit, list) and unit else unit
