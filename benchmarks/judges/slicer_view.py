"""Run inside Slicer's environment: `python slicer_view.py PORT PICTURE` draws what a cockpit sends to 3D Slicer.

OpenIGTLink messages are read from the port until each has come, and shown in a 3D view by Slicer's own classes.
"""

import itertools
import socket
import struct
import sys

import numpy as np
import slicer  # pyright: ignore[reportMissingImports]
import vtk  # pyright: ignore[reportMissingImports]
from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray  # pyright: ignore[reportMissingImports]

HEADER = struct.Struct(">H12s20sQQQ")  # version, type, name, time, size of the body, checksum (openigtlink.org, v2)
MODELS = {"Vessel": ((0.85, 0.35, 0.35), 0.25, 1), "Centerlines": ((1, 1, 1), 0.7, 1), "Wire": ((1, 0.85, 0.1), 1, 4)}
"""Colour, opacity and width of lines of each model."""
SIZE, DEEP_MM = (1000, 760), 120.0
MANAGERS = ("Camera", "View", "Model", "OrientationMarker", "Markups")


def received(port: int) -> dict[str, bytes]:
    """Return the newest body of each message once the wire is as deep as is to be shown, by the name of its device."""
    found: dict[str, bytes] = {}
    with socket.create_connection(("127.0.0.1", port)) as peer, peer.makefile("rb") as stream:
        while not {*MODELS, "Target", "Tip"} <= found.keys() or length_mm(found["Wire"]) < DEEP_MM:
            _, _, name, _, size, _ = HEADER.unpack(stream.read(HEADER.size))
            found[name.rstrip(b"\0").decode()] = stream.read(size)
    return found


def polydata(body: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, lines and polygons of a POLYDATA message."""
    sizes = struct.unpack(">10I", body[:40])
    ends = np.cumsum([40, 12 * sizes[0], sizes[2], sizes[4], sizes[6]])
    points, _, lines, polygons = (body[a:b] for a, b in itertools.pairwise(ends))
    cells, corners = (np.frombuffer(each, ">u4").astype(np.int64) for each in (lines, polygons))
    return np.frombuffer(points, ">f4").reshape(-1, 3).astype(float), cells, corners


def length_mm(body: bytes) -> float:
    """Return the length of a line, mm."""
    return float(np.linalg.norm(np.diff(polydata(body)[0], axis=0), axis=1).sum())


def model(scene: slicer.vtkMRMLScene, name: str, body: bytes) -> None:
    """Show a message as a model."""
    places, lines, polygons = polydata(body)
    made, points = vtk.vtkPolyData(), vtk.vtkPoints()
    points.SetData(numpy_to_vtk(places, deep=True))
    made.SetPoints(points)
    for cells, put in ((lines, made.SetLines), (polygons, made.SetPolys)):
        held = vtk.vtkCellArray()
        held.ImportLegacyFormat(numpy_to_vtkIdTypeArray(cells, deep=True))
        put(held)
    node = slicer.vtkMRMLModelNode()
    node.SetName(name)
    scene.AddNode(node)
    node.SetAndObservePolyData(made)
    node.CreateDefaultDisplayNodes()
    (red, green, blue), opacity, width = MODELS[name]
    display = node.GetDisplayNode()
    display.SetColor(red, green, blue)
    display.SetOpacity(opacity)
    display.SetLineWidth(width)


def main(port: str, picture: str) -> None:
    """Read the messages, and draw them."""
    found = received(int(port))
    scene, logic = slicer.vtkMRMLScene(), slicer.vtkMRMLApplicationLogic()
    logic.SetMRMLScene(scene)
    markups = slicer.vtkSlicerMarkupsLogic()
    markups.SetMRMLApplicationLogic(logic)
    markups.SetMRMLScene(scene)
    logic.SetModuleLogic("Markups", markups)
    factory = slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance()
    factory.SetMRMLApplicationLogic(logic)
    for name in MANAGERS:
        factory.RegisterDisplayableManager(f"vtkMRML{name}DisplayableManager")
    view = slicer.vtkMRMLViewNode()
    view.SetLayoutName("1")
    scene.AddNode(view)
    view.SetBoxVisible(False)
    view.SetAxisLabelsVisible(False)
    view.SetOrientationMarkerType(view.OrientationMarkerTypeAxes)
    window, renderer, interactor = vtk.vtkRenderWindow(), vtk.vtkRenderer(), vtk.vtkRenderWindowInteractor()
    window.SetOffScreenRendering(1)
    window.SetSize(*SIZE)
    window.SetMultiSamples(8)
    window.AddRenderer(renderer)
    interactor.SetRenderWindow(window)
    group = factory.InstantiateDisplayableManagers(renderer)
    group.SetMRMLDisplayableNode(view)
    for name in MODELS:
        model(scene, name, found[name])
    target = slicer.vtkMRMLMarkupsFiducialNode()
    scene.AddNode(target)
    target.CreateDefaultDisplayNodes()
    target.GetDisplayNode().SetTextScale(4.0)
    name, place = found["Target"][:64].rstrip(b"\0").decode(), struct.unpack(">3f", found["Target"][100:112])
    target.AddControlPoint(vtk.vtkVector3d(*place), f"Target, section {name}")
    renderer.ResetCamera()
    renderer.GetActiveCamera().Zoom(1.4)
    window.Render()
    image, writer = vtk.vtkWindowToImageFilter(), vtk.vtkPNGWriter()
    image.SetInput(window)
    image.ReadFrontBufferOff()
    writer.SetFileName(picture)
    writer.SetInputConnection(image.GetOutputPort())
    writer.Write()


if __name__ == "__main__":
    main(*sys.argv[1:])
