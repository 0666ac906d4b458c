"""Surfaces and centerlines from STL, OBJ, PLY, VTP, VTU and VTK, with the axes and the unit that their headers state:
3D Slicer writes `SPACE=LPS` or `SPACE=RAS` in an STL's header, a PLY's or OBJ's comment, a VTK file's title, a VTP's
fields."""

from __future__ import annotations

import io
import itertools
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from endopilot.errors import InputError
from endopilot.vessels import mesh_process
from endopilot.vessels.sources import (
    ASSUMED,
    AXES,
    RADIUS_NAMES,
    RAS_TO_LPS,
    STATED,
    AnatomySource,
    Polylines,
    checked_lines,
    in_mm,
    mm_per_unit,
)
from endopilot.vessels.surface import Surface

_HEADER_BYTES = 65536  # statements of axes and unit stand in the first bytes of a file
_LONGEST_S, _BYTES_A_SECOND = 30.0, 1e6  # a file that takes longer than this, and at this speed, is damaged

_SPACE = re.compile(r"\bSPACE\s*[=:]\s*[\"']?([A-Za-z][A-Za-z-]*)", re.IGNORECASE)
_UNIT = re.compile(r"\bUNITS?\s*[=:]\s*[\"']?([A-Za-zµμ]+)", re.IGNORECASE)

_FEWEST_BYTES = 16  # no format holds a vessel in fewer bytes

_ASCII_STL = re.compile(r"\s*solid.*(facet|endsolid)", re.IGNORECASE | re.DOTALL)
"""How an STL of text begins: a binary one may begin with "solid" too, but no facet follows."""

_ELEMENT = re.compile(r"^element (\w+) (-?\d+)\s*$", re.MULTILINE)


def read_polydata(path: Path) -> AnatomySource:
    """Read a surface, or centerlines with radii, in LPS mm where the header states axes and unit. Raises InputError for
    a damaged file, one that is neither, centerlines without radii, or axes other than LPS and RAS."""
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
    promised = _promised_faces(path, head)
    data = arrays(path)
    notes: list[str] = []
    points, lines = data["points"], data["line_points"]
    if len(points) == 0:
        raise InputError(f"{path}: holds no points; the file is empty or truncated, export it again")
    _check_whole(path, "polygons", promised, len(data.get("corners", ())))
    if not np.isfinite(points).all():
        raise InputError(f"{path}: some coordinates are not finite numbers; export it again")
    statement = f"{head.decode('latin-1')}\n{data['fields']}"
    coordinates = _coordinates(statement, path)
    factor, odds = _factor(statement, notes)
    if "corners" in data:
        content: Surface | Polylines = _surface(points, data["corners"], path)
        if data["kind"] == "vtkUnstructuredGrid":
            notes.append("a volume mesh: its outer surface is taken")
        if len(lines):
            notes.append("lines beside the triangles are left out: the file is read as a surface")
    elif len(lines) == 0:
        raise InputError(f"{path}: holds neither triangles nor lines; export a surface or a centerline")
    else:
        content = _lines(data, path, notes)
    content = in_mm(content, factor, RAS_TO_LPS if coordinates == "ras" else np.ones(3))
    return AnatomySource(content, coordinates=coordinates, factor=factor, odds=odds, notes=tuple(notes))


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Return what `mesh_process`, which may crash or hang, reads; InputError for neither triangles nor lines."""
    limit_s = _LONGEST_S + path.stat().st_size / _BYTES_A_SECOND
    command = [sys.executable, "-P", mesh_process.__file__, str(path.resolve())]
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise _damaged(path, f"it takes more than {limit_s:.0f} s") from error
    if done.returncode != 0:
        raise _damaged(path, "its reader fails on it")
    with np.load(io.BytesIO(done.stdout)) as archive:
        data = {name: archive[name] for name in archive.files}
    if str(data["complaint"]).strip():
        raise _damaged(path, str(data["complaint"]))
    if "points" not in data:
        raise InputError(f"{path}: holds {data['kind']}, neither triangles nor lines; export it as PolyData")
    return data


def _damaged(path: Path, complaint: str) -> InputError:
    lines = [line.strip() for line in complaint.splitlines() if line.strip()]
    said = next(
        (line for line in lines if not line.startswith(("ERROR: In", "Generic Warning: In", "Warning: In"))), ""
    )
    said = re.sub(r"^vtk\w+ \(0x[0-9a-f]+\): ", "", said)[:160].rstrip(".: ")
    return InputError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({said or 'damaged'}); export it again")


def _coordinates(statement: str, path: Path) -> str | None:
    found = sorted({name.upper() for name in _SPACE.findall(statement)})
    axes = {AXES.get(name) for name in found}
    if len(axes) > 1 or None in axes:
        raise InputError(
            f"{path}: the header states SPACE={' and '.join(found)}; give a file in LPS or RAS that states one of them"
        )
    return axes.pop() if axes else None


def _factor(statement: str, notes: list[str]) -> tuple[float, float]:
    """Return mm in the unit that a header states, and how sure that is."""
    found = sorted({name.lower() for name in _UNIT.findall(statement)})
    factor = mm_per_unit(found[0]) if len(found) == 1 else None
    if factor is None:
        if found:
            notes.append(
                f"the header states the unit {' and '.join(found)}, which is not one known length: taken for mm"
            )
        return 1.0, ASSUMED
    if factor != 1.0:
        notes.append(f"the header states the unit {found[0]}: multiplied by {factor:g}")
    return factor, STATED


def _surface(points: np.ndarray, corners: np.ndarray, path: Path) -> Surface:
    vertices, index = np.unique(points, axis=0, return_inverse=True)
    faces = index.reshape(-1)[corners]
    first, second, third = faces.T
    faces = faces[(first != second) & (second != third) & (third != first)]
    if len(faces) < 4:
        raise InputError(f"{path}: holds {len(faces)} triangles, too few for a vessel; export it again")
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], faces.reshape(-1, 3).astype(np.int64))


def _lines(data: dict[str, np.ndarray], path: Path, notes: list[str]) -> Polylines:
    radius, places = _radius_array(data, path), data["points"]
    if len(radius) != len(places):
        raise InputError(f"{path}: holds {len(radius)} radii for {len(places)} points; export it again")
    lines = [data["line_points"][start:end] for start, end in itertools.pairwise(data["line_offsets"])]
    whole = [index for index in lines if len(index) > 1]
    if len(whole) < len(lines):
        notes.append(f"{len(lines) - len(whole)} lines of a single point are left out")
    lines = Polylines(tuple(places[index] for index in whole), tuple(radius[index] for index in whole))
    return checked_lines(lines, path, notes)


def _radius_array(data: dict[str, np.ndarray], path: Path) -> np.ndarray:
    held = {name.removeprefix("point:"): values for name, values in data.items() if name.startswith("point:")}
    for wanted in RADIUS_NAMES:
        for name, values in held.items():
            if name.lower() == wanted and values.ndim == 1:
                return values
    found = ", ".join(held) or "no arrays at all"
    raise InputError(
        f"{path}: is a centerline without radii (it holds {found}); "
        "add a point array MaximumInscribedSphereRadius in mm, as VMTK writes it"
    )


def _promised_faces(path: Path, head: bytes) -> int:
    """Return how many polygons a PLY's header promises: those that are missing at its end VTK leaves out unsaid. Raises
    InputError for a file that is empty, or shorter than what its header promises takes at least."""
    size = path.stat().st_size
    if size < _FEWEST_BYTES:
        raise InputError(f"{path}: is empty or truncated; export it again")
    text, kind = head.decode("latin-1"), path.suffix.lower()
    if kind == ".stl" and not _ASCII_STL.match(text[:1024]):
        _check_whole(path, "triangles", int.from_bytes(head[80:84], "little"), (size - 84) // 50)
    if kind != ".ply":
        return 0
    elements = {name: int(count) for name, count in _ELEMENT.findall(text.partition("end_header")[0])}
    for name, count in elements.items():
        _check_whole(path, f"of element {name}", count, size)
        _check_whole(path, f"of element {name}", 0, count)
    return elements.get("face", 0)


def _check_whole(path: Path, what: str, promised: int, held: int) -> None:
    if held < promised:
        raise InputError(
            f"{path}: is truncated: its header promises {promised} {what}, and it holds {max(held, 0)}; export it again"
        )
