"""Meshes and centerlines in the formats that other programs write, with the headers they write."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyvista

SLICER = "3D Slicer output. SPACE={}"
"""What 3D Slicer writes into the header of a mesh, with the axes in place of the braces."""


def arc() -> np.ndarray:
    """Return a vessel's axis that no mirroring leaves as it is, LPS mm."""
    along = np.linspace(0.0, 1.0, 60)
    return np.column_stack([10 + 30 * np.sin(2 * along), -5 + 20 * along**2, 5 + 60 * along])


def tube(axis: np.ndarray, radius: float | np.ndarray = 2.0, sides: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of an open tube around an axis."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    vertices = (axis[:, None] + ring).reshape(-1, 3)
    first = (sides * np.arange(len(axis) - 1)[:, None] + np.arange(sides)).ravel()
    beside = first - first % sides + (first % sides + 1) % sides
    lower = np.column_stack([first, beside, first + sides])
    upper = np.column_stack([beside, beside + sides, first + sides])
    return vertices, np.concatenate([lower, upper])


def write_surface(path: Path, vertices: np.ndarray, faces: np.ndarray, header: str = "") -> Path:
    """Write a surface in the format of the path's suffix, with a line in its header, title, comment or field data.

    `name.bin.stl` is binary, `name.stl` is text. In a VTP the header is NAME=text.
    """
    kind = path.suffix
    if path.name.endswith(".bin.stl"):
        records = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        records["corners"] = vertices[faces]
        path.write_bytes(header.encode().ljust(80, b"\0") + struct.pack("<I", len(faces)) + records.tobytes())
    elif kind == ".stl":
        rows = [f"solid {header}"]
        for corners in vertices[faces]:
            rows += ["facet normal 0 0 1", "outer loop", *(f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners)]
            rows += ["endloop", "endfacet"]
        path.write_text("\n".join([*rows, "endsolid"]) + "\n")
    elif kind == ".ply":
        rows = ["ply", "format ascii 1.0", f"comment {header}", f"element vertex {len(vertices)}"]
        rows += [f"property float {axis}" for axis in "xyz"]
        rows += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        path.write_text("\n".join(rows + _rows(vertices) + [f"3 {a} {b} {c}" for a, b, c in faces]) + "\n")
    elif kind == ".obj":
        rows = [f"v {row}" for row in _rows(vertices)] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        path.write_text("\n".join([f"# {header}", *rows]) + "\n")
    elif kind == ".vtk":
        rows = ["# vtk DataFile Version 4.2", header or "a vessel", "ASCII", "DATASET POLYDATA"]
        rows += [f"POINTS {len(vertices)} double", *_rows(vertices), f"POLYGONS {len(faces)} {4 * len(faces)}"]
        path.write_text("\n".join(rows + [f"3 {a} {b} {c}" for a, b, c in faces]) + "\n")
    else:
        _write_vtp(path, vertices, faces, [], None, header)
    return path


def write_lines(path: Path, lines: list[np.ndarray], radii: list[np.ndarray] | None, header: str = "") -> Path:
    """Write centerlines as a VTP with radii as VMTK names them; `header` is a text NAME=text in its field data."""
    _write_vtp(path, np.concatenate(lines), np.empty((0, 3), dtype=int), lines, radii, header)
    return path


def markup(line: np.ndarray, radius: np.ndarray, **other: object) -> dict[str, object]:
    """Return one of Slicer's curves in LPS mm; `other` replaces or adds entries."""
    return {
        "type": "Curve", "coordinateSystem": "LPS", "coordinateUnits": "mm", "label": "curve",
        "controlPoints": [{"position": point.tolist(), "positionStatus": "defined"} for point in line],
        "measurements": [{"name": "Radius", "units": "mm", "controlPointValues": radius.tolist()}],
    } | other  # fmt: skip


def _rows(vertices: np.ndarray) -> list[str]:
    return [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]


def _write_vtp(path, points, faces, lines, radii, header) -> None:
    starts = np.cumsum([0, *map(len, lines)])
    cells = [np.append(len(line), start + np.arange(len(line))) for start, line in zip(starts, lines, strict=False)]
    triangles = np.insert(faces, 0, 3, axis=1).ravel() if len(faces) else None
    data = pyvista.PolyData(np.asarray(points, float), triangles, lines=np.concatenate(cells) if lines else None)
    if radii is not None:
        data.point_data["MaximumInscribedSphereRadius"] = np.concatenate(radii).astype(float)
    if header:
        name, _, text = header.partition("=")
        data.field_data[name] = [text]
    data.save(path)
