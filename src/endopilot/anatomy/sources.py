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


@dataclass(frozen=True, eq=False)
class Polylines:
    """Centerlines as a file holds them: any number of lines, in any order and direction, possibly overlapping.

    Attributes:
        points: positions of each line, mm.
        radius: inscribed-sphere radii of each line, mm.
    """

    points: tuple[Float[np.ndarray, "_ 3"], ...]
    radius: tuple[Float[np.ndarray, "_"], ...]


@dataclass(frozen=True, eq=False)
class AnatomySource:
    """The content of a file, and which file it was.

    Attributes:
        content: mask, surface (as read, perhaps open) or centerlines.
        file: name of the file, without its folder.
        sha256: its SHA-256.
        coordinates: "lps" or "ras", where the file says which; None where only the user can know.
    """

    content: LumenMask | Surface | Polylines | VesselTree
    file: str = ""
    sha256: str = ""
    coordinates: str | None = None


def read_source(path: str | Path, *, label: int | str | None = None) -> AnatomySource:
    """Read a vessel from a mask, a surface or centerlines; the kind follows from the file.

    Args:
        path: mask (NIfTI, NRRD, MHA, DICOM-SEG), surface (STL, OBJ, PLY, VTP, VTK) or centerline (VTP with lines and
            radii, as VMTK writes it, or a Slicer markups curve `.mrk.json` with a radius measurement).
        label: number or name of the segment that is the lumen, where a mask has several.

    Raises:
        InputError: the file is missing, damaged, empty, of an unknown kind, or a centerline without radii.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a mask, a surface or a centerline")
    lower = path.name.lower()
    if label is not None and not lower.endswith(MASK_SUFFIXES):
        raise InputError(f"{path}: --label {label} was given, but only masks have labels; leave the option out")
    coordinates: str | None = None
    if lower.endswith(MASK_SUFFIXES):
        from endopilot.imaging.volume import read_mask

        content: Any = read_mask(path, label=label)
        coordinates = "lps"
    elif lower.endswith(".json"):
        content = _read_markups(path)
        coordinates = "lps"
    elif lower.endswith(SURFACE_SUFFIXES):
        content = _read_polydata(path)
    else:
        known = " ".join((*MASK_SUFFIXES, *SURFACE_SUFFIXES, ".mrk.json"))
        raise InputError(f"{path}: unknown kind of file; known are {known}")
    read = content.volume.files if isinstance(content, LumenMask) else ()
    return AnatomySource(content, path.name, files.input_hash(path, read)[path.name], coordinates)


def transformed(source: AnatomySource, *, scale: float, coordinates: str) -> AnatomySource:
    """Return a source in LPS mm: multiplied by `scale` and, if its file does not say LPS, turned over from RAS."""
    turn = np.array([-1.0, -1.0, 1.0]) if coordinates == "ras" and source.coordinates is None else np.ones(3)
    content = source.content
    if isinstance(content, Surface):
        faces = content.faces
        content = Surface(content.vertices * turn * scale, faces)
    elif isinstance(content, Polylines):
        content = Polylines(
            tuple(points * turn * scale for points in content.points), tuple(r * scale for r in content.radius)
        )
    elif isinstance(content, LumenMask) and scale != 1.0:
        volume = content.volume
        ostium = content.ostium
        content = replace(
            content,
            volume=replace(volume, spacing_mm=volume.spacing_mm * scale, origin_mm=volume.origin_mm * scale),
            ostium=None if ostium is None else replace(ostium, position=ostium.position * scale),
        )
    return replace(source, content=content)


def _read_polydata(path: Path) -> Surface | Polylines:
    import pyvista

    # Some readers crash or hang on an empty or foreign file; the first bytes identify it.
    if path.stat().st_size < 16:
        raise InputError(f"{path}: is empty or truncated; export it again")
    data: Any
    try:
        with _quiet_vtk():
            data = pyvista.read(path)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({error}); export it again") from error
    if not isinstance(data, pyvista.PolyData):
        data = data.extract_surface() if hasattr(data, "extract_surface") else None
    if data is None or data.n_points == 0:
        raise InputError(f"{path}: holds no points; the file is empty or truncated, export it again")
    if not np.isfinite(data.points).all():
        raise InputError(f"{path}: some coordinates are not finite numbers; export it again")
    if data.n_faces > 0 or data.n_strips > 0:
        mesh: Any = data.triangulate()
        mesh = mesh.clean(lines_to_points=False, polys_to_lines=False, strips_to_polys=False)
        faces = mesh.faces.reshape(-1, 4)[:, 1:] if mesh.n_faces else np.empty((0, 3), dtype=np.int64)
        if len(faces) < 4:
            raise InputError(f"{path}: holds {len(faces)} triangles, too few for a vessel; export it again")
        return Surface(np.asarray(mesh.points, dtype=float), np.asarray(faces, dtype=np.int64))
    if data.n_lines == 0:
        raise InputError(f"{path}: holds neither triangles nor lines; export a surface or a centerline")
    radius = _radius_array(data.point_data, path)
    points, radii = [], []
    connectivity, position = data.lines, 0
    while position < len(connectivity):
        count = int(connectivity[position])
        index = connectivity[position + 1 : position + 1 + count]
        if count > 1:
            points.append(np.asarray(data.points[index], dtype=float))
            radii.append(np.asarray(radius[index], dtype=float))
        position += count + 1
    return _checked(Polylines(tuple(points), tuple(radii)), path)


def _radius_array(point_data: Any, path: Path) -> np.ndarray:
    for wanted in RADIUS_NAMES:
        for name in point_data:
            if str(name).lower() == wanted:
                return np.asarray(point_data[name], dtype=float).reshape(-1)
    found = ", ".join(str(name) for name in point_data) or "no arrays at all"
    raise InputError(
        f"{path}: is a centerline without radii (it holds {found}); "
        "add a point array MaximumInscribedSphereRadius in mm, as VMTK writes it"
    )


def _read_markups(path: Path) -> Polylines:
    content = files.read_json(path)
    markups = content.get("markups") if isinstance(content, dict) else None
    if not markups:
        raise InputError(f"{path}: holds no Slicer markups; export the centerline curve as .mrk.json")
    points, radii = [], []
    for markup in markups:
        control = markup.get("controlPoints") or []
        if len(control) < 2:
            continue
        turn = np.array([-1.0, -1.0, 1.0]) if str(markup.get("coordinateSystem", "LPS")).upper() == "RAS" else 1.0
        measurements = {str(m.get("name", "")).lower(): m for m in markup.get("measurements") or []}
        values = next(
            (measurements[name]["controlPointValues"] for name in RADIUS_NAMES if _has_values(measurements, name)), None
        )
        if values is None or len(values) != len(control):
            raise InputError(
                f"{path}: curve {markup.get('label', len(points))!r} has no radius measurement for its {len(control)} "
                "control points; export it from Slicer's Extract Centerline module"
            )
        try:
            points.append(np.array([point["position"] for point in control], dtype=float).reshape(-1, 3) * turn)
            radii.append(np.array(values, dtype=float))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: a control point has no numeric position; export the curve again") from error
    return _checked(Polylines(tuple(points), tuple(radii)), path)


def _has_values(measurements: dict[str, Any], name: str) -> bool:
    return bool(measurements.get(name, {}).get("controlPointValues"))


def _checked(lines: Polylines, path: Path) -> Polylines:
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


def _quiet_vtk():
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

    class Quiet:
        def __enter__(self) -> None:
            self.level = vtkLogger.GetCurrentVerbosityCutoff()
            vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
            vtkObject.GlobalWarningDisplayOff()

        def __exit__(self, *_: object) -> None:
            vtkLogger.SetStderrVerbosity(self.level)
            vtkObject.GlobalWarningDisplayOn()

    return Quiet()
