"""An anatomy on disk: one folder that 3D Slicer and ParaView open, and that reads back exactly.

=================  ================================================================================================
file               content
=================  ================================================================================================
`centerline.vtp`   one polyline a branch, LPS mm; point data MaximumInscribedSphereRadius (mm), Abscissa (mm), Normals,
                   Section (index into the section names); cell data Branch and Parent
`lumen.nrrd`       signed distance to the wall, mm, positive inside, guiding catheter included; compressed float32
`anatomy.json`     schema version, name, insertion with φ's zero, catheter radius, section names, provenance, identity
                   (SHA-256 of the vessel itself, `Anatomy.identity`), SHA-256 of both files
=================  ================================================================================================

Anatomies of schema version 1 hold no zero of φ: it is that of the world's axes, as when they were written, so that
recorded controls mean the same in them.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from endopilot import files
from endopilot.errors import InputError
from endopilot.imaging.text_headers import read_nrrd
from endopilot.settings import public
from endopilot.types import Anatomy, Branch, Centerline, DistanceMap, Insertion, VesselTree
from endopilot.vessels import mesh_process
from endopilot.vessels.surface import polydata_of

SCHEMA_VERSION = 2

_CENTERLINE, _LUMEN, _RECORD = "centerline.vtp", "lumen.nrrd", "anatomy.json"
_RADIUS = "MaximumInscribedSphereRadius"


@public
def write_anatomy(anatomy: Anatomy, *, output: str | Path) -> None:
    """Write an anatomy as a folder, whole or not at all; an anatomy in it is replaced, and what else it holds stays.
    Raises InputError where the folder cannot be written, or holds something that is not an anatomy."""
    with files.writing_folder(Path(output), _RECORD) as partial:
        _write_tree(anatomy.tree, partial / _CENTERLINE)
        _write_distance_map(anatomy.distance_map, partial / _LUMEN)
        record = {
            "schema_version": SCHEMA_VERSION,
            "name": anatomy.name,
            "insertion": {
                "position_mm": anatomy.insertion.position,
                "direction": anatomy.insertion.direction,
                "rotation_zero": anatomy.insertion.rotation_zero,
            },
            "catheter_radius_mm": float(anatomy.catheter_radius_mm),
            "identity": anatomy.identity,
            "section_names": list(anatomy.tree.section_names),
            "coordinates": "LPS, mm",
            "sha256": {name: files.sha256(partial / name) for name in (_CENTERLINE, _LUMEN)},
            "provenance": anatomy.provenance,
        }
        (partial / _RECORD).write_text(files.json_text(record) + "\n", encoding="utf-8")


@public
def read_anatomy(folder: str | Path) -> Anatomy:
    """Read an anatomy; InputError if the folder or a file of it is missing, damaged or of another version."""
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder}: is a file; make an anatomy of it first: `endopilot anatomy {folder} -o FOLDER`")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give an anatomy made by `endopilot anatomy` or `endopilot atlas`")
    if not (folder / _RECORD).exists():
        held = any(folder.glob(f"*/{_RECORD}"))
        mend = f"it holds anatomies, so give {folder}/*" if held else "make one with `endopilot anatomy`"
        raise InputError(f"{folder}: holds no {_RECORD}, so it is not an anatomy; {mend}")
    record = files.read_json(folder / _RECORD)
    version = record.get("schema_version") if isinstance(record, dict) else None
    if version not in (1, SCHEMA_VERSION):
        raise InputError(
            f"{folder / _RECORD}: schema_version is {version}, not 1 or {SCHEMA_VERSION}; make the anatomy again"
        )
    with files.reading(folder / _RECORD, "make the anatomy again"):
        insertion = _insertion(record["insertion"], version)
        names, radius = tuple(map(str, record["section_names"])), float(record["catheter_radius_mm"])
        name, provenance, hashes = str(record["name"]), dict(record["provenance"]), dict(record["sha256"])
    for file in (_CENTERLINE, _LUMEN):
        if not (folder / file).exists():
            raise InputError(f"{folder / file}: is missing; make the anatomy again")
        if files.sha256(folder / file) != hashes.get(file):
            raise InputError(f"{folder / file}: differs from what anatomy.json records; make the anatomy again")
    anatomy = Anatomy(
        name=name,
        tree=_read_tree(folder / _CENTERLINE, names),
        distance_map=_read_distance_map(folder / _LUMEN),
        insertion=insertion,
        catheter_radius_mm=radius,
        provenance=provenance,
    )
    if record.get("identity", anatomy.identity) != anatomy.identity:
        raise InputError(f"{folder / _RECORD}: identity is not that of the vessel in it; make the anatomy again")
    return anatomy


def _insertion(record: Any, version: int) -> Insertion:
    zero = record["rotation_zero"] if version > 1 else "world axes"
    vectors = (record["position_mm"], record["direction"], *([zero] if zero != "world axes" else []))
    position, direction, *given = (np.array(vector, dtype=float) for vector in vectors)
    if any(vector.shape != (3,) or not np.isfinite(vector).all() for vector in (position, direction, *given)):
        raise ValueError("insertion: a vector without three finite numbers")
    return Insertion(position, direction, given[0] if given else "world axes")


def _write_tree(tree: VesselTree, path: Path) -> None:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    whole, counts = tree.line, [len(branch.section) for branch in tree.branches]
    offsets = np.concatenate([[0], np.cumsum(counts)])
    polydata = polydata_of(whole.points, offsets, np.arange(offsets[-1]), "Lines")
    columns: dict[str, tuple[Any, np.ndarray]] = {
        _RADIUS: (polydata.GetPointData(), whole.radius),
        "Abscissa": (polydata.GetPointData(), whole.abscissa),
        "Normals": (polydata.GetPointData(), whole.normals),
        "Section": (polydata.GetPointData(), np.concatenate([branch.section for branch in tree.branches])),
        "Branch": (polydata.GetCellData(), np.arange(len(counts))),
        "Parent": (polydata.GetCellData(), np.array([branch.parent for branch in tree.branches])),
    }
    for name, (attributes, values) in columns.items():
        kind = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float64
        array = numpy_to_vtk(np.ascontiguousarray(values, dtype=kind), deep=True)
        array.SetName(name)
        attributes.AddArray(array)
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(polydata)
    if not writer.Write():
        raise OSError(f"{path}: could not be written")


def _read_tree(path: Path, section_names: tuple[str, ...]) -> VesselTree:
    with files.reading(path, "make the anatomy again"):
        data, branches = mesh_process.read(str(path)), list[Branch]()
        section = data["point:Section"].astype(np.int64)
        if section.max() >= len(section_names):
            raise ValueError("some sections are not among those that anatomy.json names")
        columns = data["points"], *(data[f"point:{name}"] for name in (_RADIUS, "Abscissa", "Normals"))
        for (start, end), parent in zip(itertools.pairwise(data["line_offsets"]), data["cell:Parent"], strict=True):
            line = Centerline(*(values[start:end].copy() for values in columns))
            branches.append(Branch(line, int(parent), section[start:end]))
    return VesselTree(tuple(branches), section_names)


def _write_distance_map(distance_map: DistanceMap, path: Path) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(distance_map.values.astype(np.float32))
    image.SetSpacing([float(distance_map.spacing_mm)] * 3)
    image.SetOrigin([float(value) for value in distance_map.origin_mm])
    SimpleITK.WriteImage(image, str(path), useCompression=True)


def _read_distance_map(path: Path) -> DistanceMap:
    with files.reading(path, "make the anatomy again"):
        volume = read_nrrd(path).volume
    return DistanceMap(volume.voxels.astype(np.float32), float(volume.spacing_mm[0]), volume.origin_mm)
