"""Reads one mesh file with VTK, in a process of its own as VTK may crash and print, and writes an npz archive to
standard output: `points`; `corners` of triangles; `line_points` and `line_offsets`, where each line begins; arrays of
numbers as `point:NAME` and `cell:NAME`; the texts `kind`, `fields` and `complaint`. It imports nothing of endopilot."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np


def read(path: str) -> dict[str, np.ndarray]:
    """Return a mesh file's arrays by name, with VTK's complaints; outside its own process, of whole files alone."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    level = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    vtkOutputWindow.SetInstance(window)
    try:
        reader = _reader(path)
        reader.SetFileName(path)
        reader.Update()
        result = _arrays(reader.GetOutputDataObject(0))
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(level)
    return {"complaint": np.array(window.GetOutput())} | result


def _arrays(data: Any) -> dict[str, np.ndarray]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    kind = "nothing" if data is None else data.GetClassName()
    if kind == "vtkUnstructuredGrid":
        from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

        outside = vtkGeometryFilter()
        outside.SetInputData(data)
        outside.Update()
        data = outside.GetOutput()
    result: dict[str, np.ndarray] = {"kind": np.array(kind)}
    if data is None or not data.IsA("vtkPolyData"):
        return result
    count = data.GetNumberOfPoints()
    points = vtk_to_numpy(data.GetPoints().GetData()).astype(float) if count else np.empty((0, 3))
    result |= {"points": points, "fields": np.array(_fields(data.GetFieldData()))}
    cells = {name: _cells(getattr(data, f"Get{name}")()) for name in ("Polys", "Strips", "Lines")}
    foreign = any(len(index) and (index.min() < 0 or index.max() >= count) for _, index in cells.values())
    if foreign:
        return result | {"complaint": np.array(f"a triangle or line names a point that is not among its {count}")}
    result["line_offsets"], result["line_points"] = cells["Lines"]
    for place, attributes in (("point", data.GetPointData()), ("cell", data.GetCellData())):
        for i in range(attributes.GetNumberOfArrays()):
            array = attributes.GetArray(i)  # None for texts
            if array is not None and array.GetName():
                result[f"{place}:{array.GetName()}"] = vtk_to_numpy(array).astype(float)
    if len(cells["Polys"][1]) or len(cells["Strips"][1]):
        result["corners"] = _triangles(data)
    return result


def _reader(path: str) -> Any:
    from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOPLY import vtkPLYReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    readers = {".stl": vtkSTLReader, ".obj": vtkOBJReader, ".ply": vtkPLYReader}
    readers |= {".vtp": vtkXMLPolyDataReader, ".vtu": vtkXMLUnstructuredGridReader}
    return readers.get(Path(path).suffix.lower(), vtkDataSetReader)()


def _cells(cells: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return where each cell begins in the list of point indices, and that list."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    offsets = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    index = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    if len(offsets) and (np.diff(offsets).min(initial=0) < 0 or offsets[0] != 0 or offsets[-1] > len(index)):
        return np.zeros(1, dtype=np.int64), np.array([-1])  # a list that is none names foreign points
    return offsets, index


def _fields(field_data: Any) -> str:
    texts = []
    for i in range(field_data.GetNumberOfArrays()):
        array = field_data.GetAbstractArray(i)
        if array.IsA("vtkStringArray") and array.GetNumberOfValues():
            texts.append(f"{array.GetName()}={array.GetValue(0)}")
    return "\n".join(texts)


def _triangles(data: Any) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    alone = vtkPolyData()
    alone.SetPoints(data.GetPoints())
    alone.SetPolys(data.GetPolys())
    alone.SetStrips(data.GetStrips())
    split = vtkTriangleFilter()
    split.SetInputData(alone)
    split.PassVertsOff()
    split.PassLinesOff()
    split.Update()
    return vtk_to_numpy(split.GetOutput().GetPolys().GetConnectivityArray()).astype(np.int64).reshape(-1, 3)


if __name__ == "__main__":
    archive = io.BytesIO()
    np.savez(archive, **read(sys.argv[1]))  # pyright: ignore[reportArgumentType]
    sys.stdout.buffer.write(archive.getvalue())
