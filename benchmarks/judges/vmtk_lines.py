"""Run inside VMTK's environment: `python vmtk_lines.py WALL.stl ENDS.json LINES.json` makes its centerlines.

ENDS holds `source` and `targets`, positions in mm; LINES gets for each target the points and radii from it to the
source, and the processor time that VMTK took, s.
"""

import json
import sys
import time
from pathlib import Path

from vmtk import vmtkscripts  # pyright: ignore[reportMissingImports]
from vtkmodules.util.numpy_support import vtk_to_numpy


def main(wall: str, ends: str, lines: str) -> None:
    """Read a wall, make its centerlines and write them."""
    asked = json.loads(Path(ends).read_text(encoding="utf-8"))
    reader = vmtkscripts.vmtkSurfaceReader()
    reader.InputFileName = wall
    reader.Execute()
    started = time.process_time()
    maker = vmtkscripts.vmtkCenterlines()
    maker.Surface = reader.Surface
    maker.SeedSelectorName = "pointlist"
    maker.SourcePoints = asked["source"]
    maker.TargetPoints = [value for target in asked["targets"] for value in target]
    maker.AppendEndPoints = 0
    maker.Execute()
    seconds = time.process_time() - started
    made = maker.Centerlines
    points = vtk_to_numpy(made.GetPoints().GetData())
    radius = vtk_to_numpy(made.GetPointData().GetArray("MaximumInscribedSphereRadius"))
    found = []
    for number in range(made.GetNumberOfCells()):
        ids = made.GetCell(number).GetPointIds()
        own = [ids.GetId(at) for at in range(ids.GetNumberOfIds())]
        found.append({"points": points[own].tolist(), "radius": radius[own].tolist()})
    Path(lines).write_text(json.dumps({"seconds": seconds, "lines": found}), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
