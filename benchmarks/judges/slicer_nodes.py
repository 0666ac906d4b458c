"""Run inside Slicer's environment: `python slicer_nodes.py FILES.json NODES.json` opens files as 3D Slicer does.

FILES lists paths; NODES gets for each what its node holds in Slicer's world, turned to LPS mm: a model's points and
forces, those of all models of a sequence after its times, or an image's first, middle and last voxel.
"""

import json
import sys
from pathlib import Path

import numpy as np
import slicer  # pyright: ignore[reportMissingImports]
import vtk  # pyright: ignore[reportMissingImports]
from vtk.util.numpy_support import vtk_to_numpy  # pyright: ignore[reportMissingImports]

LPS = np.array([-1.0, -1.0, 1.0])
KINDS = {
    ".vtp": ("vtkMRMLModelNode", "vtkMRMLModelStorageNode"),
    ".nrrd": ("vtkMRMLScalarVolumeNode", "vtkMRMLNRRDStorageNode"),
    ".mrb": ("vtkMRMLSequenceNode", "vtkMRMLSequenceStorageNode"),
    ".gz": ("vtkMRMLScalarVolumeNode", "vtkMRMLVolumeArchetypeStorageNode"),
}


def opened(path: str) -> dict[str, list]:
    """Return what a file holds."""
    scene, cache, manager = slicer.vtkMRMLScene(), slicer.vtkCacheManager(), slicer.vtkDataIOManager()
    cache.SetRemoteCacheDirectory(str(Path(path).parent))  # where a sequence is unpacked
    manager.SetCacheManager(cache)
    scene.SetDataIOManager(manager)
    node, storage = (getattr(slicer, kind)() for kind in KINDS[path[path.rindex(".") :]])
    for each in (node, storage):
        scene.AddNode(each)
    storage.SetFileName(path)
    if not storage.ReadData(node):
        sys.exit(f"{path}: Slicer does not read it")
    if node.IsA("vtkMRMLSequenceNode"):
        numbers = range(node.GetNumberOfDataNodes())
        held: dict[str, list] = {"points": [], "values": [float(node.GetNthIndexValue(number)) for number in numbers]}
        for number in numbers:
            for name, part in zip(held, lines(node.GetNthDataNode(number)), strict=True):
                held[name] += part
        return held
    if node.IsA("vtkMRMLModelNode"):
        return dict(zip(("points", "values"), lines(node), strict=True))
    image, matrix = node.GetImageData(), vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    size = np.array(image.GetDimensions())
    indices = [np.zeros(3, int), size // 2, size - 1]
    points = [LPS * np.array(matrix.MultiplyPoint([*map(float, index), 1.0])[:3]) for index in indices]
    values = [image.GetScalarComponentAsDouble(*map(int, index), 0) for index in indices]
    return {"points": [point.tolist() for point in points], "values": values}


def lines(node: slicer.vtkMRMLModelNode) -> tuple[list, list]:
    """Return the points of a model, and the forces on them if it holds any."""
    force = node.GetPolyData().GetPointData().GetArray("Force")
    points = LPS * vtk_to_numpy(node.GetPolyData().GetPoints().GetData())
    return points.tolist(), [] if force is None else vtk_to_numpy(force).tolist()


def main(asked: str, answer: str) -> None:
    """Open the files, and write what they hold."""
    found = [opened(path) for path in json.loads(Path(asked).read_text(encoding="utf-8"))]
    Path(answer).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
