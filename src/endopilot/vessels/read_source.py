"""Reading what an anatomy is made from: the kind of file decides which reader takes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from endopilot import files
from endopilot.errors import InputError
from endopilot.types import LumenMask
from endopilot.vessels.markups import read_markups
from endopilot.vessels.sources import AnatomySource, Polylines

MASK_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
SURFACE_SUFFIXES = (".stl", ".obj", ".ply", ".vtp", ".vtu", ".vtk")

_CONVERT = {
    ".swc": "write its points as the lines of a VTP with an array Radius (mm)",
    ".fcsv": "its points are a list without radii; open it in Slicer and save a centerline curve as .mrk.json",
    ".ctgr": "SimVascular's contours are no wall; export its model as VTP or its mesh as VTU",
    ".glb": "open it in Blender or MeshLab and export STL or PLY",
    ".gltf": "open it in Blender or MeshLab and export STL or PLY",
    ".step": "open it in the CAD program and export STL in mm",
    ".pth": "SimVascular's path has no radii; export its model as VTP or its mesh as VTU",
}
"""How a file that is not read becomes one that is, by its suffix."""


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
        source = read_markups(path)
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
    """Return all markups curves of a folder as the lines of one tree."""
    entries = sorted(folder.iterdir())
    curves = [path for path in entries if path.name.lower().endswith(".mrk.json")]
    if (folder / "anatomy.json").exists():
        raise InputError(f"{folder}: is an anatomy already; give it to the next command, such as `endopilot simulate`")
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
