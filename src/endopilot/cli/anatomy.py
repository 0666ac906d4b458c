"""`endopilot anatomy`: mask, mesh or centerline -> anatomy on disk."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy, read_source
from endopilot.anatomy.io import write_anatomy
from endopilot.cli.arguments import OutputFolder, existing, show
from endopilot.types import Anatomy


def command(
    source: Positional[Path],
    /,
    *,
    output: OutputFolder,
    name: str | None = None,
    label: int | None = None,
    json: bool = False,
    config: AnatomyConfig = AnatomyConfig(),
) -> None:
    """Make an anatomy: centerline tree with section labels, distance map, ostium.

    The folder holds centerline.vtp, lumen.nrrd (distance to the wall, mm, positive inside) and anatomy.json; 3D Slicer
    and ParaView open them.

    Args:
        source: mask (NIfTI, NRRD, MHA, DICOM-SEG), surface (STL, OBJ, PLY, VTP), or centerline with radii (VTP, Slicer
            .mrk.json).
        output: folder of the anatomy.
        name: name of the patient in datasets and reports; that of the folder by default.
        label: which label of a mask with several to take.
        json: print the figures as JSON.
        config: how to extract.
    """
    content = read_source(existing(source), label=label)
    anatomy = extract_anatomy(content, name=name or output.resolve().name, config=config)
    write_anatomy(anatomy, output)
    show({"anatomy": str(output), **describe(anatomy)}, as_json=json)


def describe(anatomy: Anatomy) -> dict[str, object]:
    """Return the figures by which an anatomy is recognised: extent, calibre, ostium, and what was repaired."""
    path, found = anatomy.tree.longest_path(), anatomy.provenance
    told = {name: found[name] for name in ("ostium_rule", "notes") if found.get(name)}
    return {
        "branches": len(anatomy.tree.branches),
        "longest_path_mm": round(float(path.abscissa[-1]), 1),
        "total_length_mm": round(
            float(sum(b.centerline.abscissa[-1] - b.centerline.abscissa[0] for b in anatomy.tree.branches)), 1
        ),
        "ostium_radius_mm": round(float(path.radius[0]), 2),
        "smallest_radius_mm": round(float(min(b.centerline.radius.min() for b in anatomy.tree.branches)), 2),
        "sections": list(anatomy.tree.section_names),
        "ostium_lps_mm": anatomy.insertion.position.round(2).tolist(),
        "insertion_direction": anatomy.insertion.direction.round(3).tolist(),
        "map_spacing_mm": round(anatomy.distance_map.spacing_mm, 3),
        **told,
    }
