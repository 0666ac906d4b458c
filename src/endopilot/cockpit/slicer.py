"""A film as a file that 3D Slicer opens: `write_film`."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from endopilot import files
from endopilot.cockpit.film import Film
from endopilot.cockpit.world import Snapshot
from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.vessels.surface import polydata_of

EVERY = 4
"""Frames of a film, of 0.05 s, from one in the file to the next."""
_ONE = """<Model id="vtkMRMLModelNode{0}" name="Wire" references="storage:vtkMRMLModelStorageNode{0};"></Model>
<ModelStorage id="vtkMRMLModelStorageNode{0}" fileName="Data/Wire_{0}.vtp" coordinateSystem="LPS"></ModelStorage>"""
_ALL = """<?xml version="1.0" encoding="UTF-8"?>
<MRML version="Slicer 5.0.0 30822" userTags="">
{models}
<Sequence id="vtkMRMLSequenceNodeSequenceIndex" name="Sequence" singletonTag="SequenceIndex" indexName="time"
 indexUnit="s" indexType="numeric" numericIndexValueTolerance="0.001" indexValues="{times}"></Sequence>
</MRML>
"""


def write_film(film: Film, output: Path) -> None:
    """Write wire and catheters of a film as lines, LPS mm, with the wall's force on each node, N: at its end (.vtp, a
    model), or every 0.2 s (.seq.mrb, a sequence). Raises InputError for another suffix, or a film that fails."""
    whole = output.name.endswith(".seq.mrb")
    if not whole and output.suffix != ".vtp":
        raise InputError(
            f"{output}: no file of 3D Slicer; name it .seq.mrb for the motion, .vtp for the path at its end"
        )
    with progress("Driving again", 1) as advance:
        shown = [frame.snapshot for frame in film.make()]
        advance()
    with files.writing(output) as partial:
        if not whole:
            partial.write_text(_lines(shown[-1]), encoding="utf-8")
            return
        chosen = shown[::EVERY]
        times = ";".join(f"vtkMRMLModelNode{number}:{each.time_s:g}" for number, each in enumerate(chosen))
        models = "\n".join(map(_ONE.format, range(len(chosen))))
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("Wire/Wire.mrml", _ALL.format(models=models, times=times))
            for number, each in enumerate(chosen):
                archive.writestr(f"Wire/Data/Wire_{number}.vtp", _lines(each))


def _lines(shown: Snapshot) -> str:
    """Return the devices at a moment as the text of a VTP file: a line each, with `Force` of each point."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    devices = (shown, *shown.catheters)
    offsets = np.cumsum([0, *(len(each.nodes) for each in devices)])
    polydata = polydata_of(np.concatenate([each.nodes for each in devices]), offsets, np.arange(offsets[-1]), "Lines")
    force = numpy_to_vtk(np.concatenate([each.node_force for each in devices]).astype(float), deep=True)
    force.SetName("Force")
    polydata.GetPointData().AddArray(force)
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata)
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString()
