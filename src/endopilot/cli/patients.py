"""`endopilot segment`, `anatomy`, `atlas` and `phantom`: masks, anatomies and synthetic patients."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

from endopilot.anatomy.batch import claim_anatomy, extract_all
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_atlas
from endopilot.cli.arguments import Figures
from endopilot.errors import InputError
from endopilot.files import input_hash, manifest
from endopilot.imaging.grid import check_covers, compare_masks
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import check_output, read_mask, read_volume, write_mask, write_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.progress import progress
from endopilot.runs import Existing, OutputFile, OutputFolder, Picture, check_outside, claiming, existing
from endopilot.settings import Seed
from endopilot.types import Anatomy
from endopilot.vessels.sources import read_source


def segment_command(
    volume: Existing,
    /,
    *,
    output: OutputFile,
    series: str | None = None,
    phase: str | None = None,
    reference: Existing | None = None,
    picture: Picture | None = None,
    config: SegmentConfig = SegmentConfig(),
) -> Figures:
    """Segment the lumen of a vessel tree in a CT angiogram.

    A JSON file beside the mask holds the ostium, the method, the manifest, and warnings of what is doubtful.

    Args:
        output: mask: .nii.gz, .nrrd, .mha, or .dcm for DICOM-SEG (needs the extra dicom-seg).
        reference: another mask of the same vessel; the agreement is printed, and its outline is red in the picture.
        picture: PNG of three slices with the mask's outline in green.
    """
    check_output(output, mask=True)
    other = read_mask(reference) if reference is not None else None
    ct = read_volume(volume, series=series, phase=phase)
    mask = segment(ct, config=config)
    agreement = compare_masks(mask, other) if other is not None else None
    write_mask(mask, output, manifest=manifest(config=config, inputs=input_hash(volume, ct.files)))
    volume_ml = float(mask.volume.voxels.sum() * mask.volume.spacing_mm.prod() / 1000)
    ostium = mask.ostium.position.round(2).tolist() if mask.ostium is not None else None
    figures = {"mask": output, "method": mask.method, "lumen_ml": round(volume_ml, 3), "ostium_lps_mm": ostium}
    figures["warnings"] = list(mask.warnings)
    if agreement is not None:
        figures |= {name: round(value, 4) for name, value in asdict(agreement).items()}
    if picture is not None:
        from endopilot.imaging.overlay_picture import draw_overlay  # matplotlib is slow to import

        draw_overlay(ct, mask, picture, reference=other)
        figures["picture"] = picture
    return figures


def anatomy_command(
    sources: tuple[Path, ...],
    /,
    *,
    output: OutputFolder,
    name: str | None = None,
    label: str | None = None,
    threshold: float | None = None,
    picture: Picture | None = None,
    ct: Existing | None = None,
    config: AnatomyConfig = AnatomyConfig(),
) -> Figures:
    """Make an anatomy: centerline tree with section labels, distance map and ostium.

    The folder holds centerline.vtp, lumen.nrrd (distance to the wall, mm, positive inside) and anatomy.json; 3D Slicer
    and ParaView open them. Given several files, the command makes a folder of each in the output folder, and lists the
    files that cannot be used, each with the reason.

    Args:
        sources: masks (NIfTI, NRRD, MHA, DICOM-SEG), surfaces (STL, OBJ, PLY, VTP), or centerlines with radii (VTP,
            Slicer .mrk.json); a folder of Slicer curves is one tree.
        output: folder of the anatomy; for several files, the folder that takes one of each.
        name: name of the patient in datasets and reports; the folder's name by default.
        label: number or name of the segment to take, where a mask holds several.
        threshold: value at the wall of a mask of grey levels: probabilities, a resampled mask, a signed distance.
        picture: PNG of the tree by section and by radius, its longest path straightened, and cross-sections.
        ct: CT angiogram in HU, shown behind the walls in the picture.
    """
    check_outside(output, sources)
    if len(sources) > 1:
        for option, value in (("name", name), ("picture", picture), ("ct", ct)):
            if value is not None:
                raise InputError(f"--{option} {value}: serves one patient, and {len(sources)} are given; leave it out")
        made, rejected = extract_all(sources, output, label=label, threshold=threshold, config=config)
        for reason in rejected.values():
            print(f"endopilot anatomy: rejected: {reason}", file=sys.stderr)
        return {"anatomies": made, "rejected": rejected}
    if ct is not None and picture is None:
        raise InputError(f"--ct {ct}: is only shown in a picture; give --picture FILE.png too")
    volume = None if ct is None else read_volume(ct)
    source = next(iter(sources))
    reading = {"label": label, "threshold": threshold}
    content = read_source(existing(source), **reading)
    with claim_anatomy(output, content, name=name, config=config, **reading):
        anatomy = extract_anatomy(content, name=name or output.resolve().name, config=config)
        if volume is not None:
            check_covers(volume, anatomy)
        write_anatomy(anatomy, output=output)
    said = anatomy.provenance["notes"][0]
    figures = {"understood": said.partition(": ")[2], "anatomy": output, **describe(anatomy)}
    if picture is not None:
        from endopilot.anatomy.anatomy_picture import draw_anatomy  # matplotlib is slow to import

        draw_anatomy(anatomy, picture, volume=volume)
        figures["picture"] = picture
    if volume is not None and volume.notes:
        figures["ct_notes"] = list(volume.notes)
    return figures


def describe(anatomy: Anatomy) -> dict[str, object]:
    """Return the figures of an anatomy: extent, calibre, ostium, and what was repaired."""
    tree, found = anatomy.tree, anatomy.provenance
    path, lines = tree.longest_path(), [branch.centerline for branch in tree.branches]
    notes = {name: found[name] for name in ("ostium_rule", "ostium_confidence", "notes") if found.get(name)}
    notes["notes"] = found.get("notes", [])[1:]
    return {
        "branches": len(lines),
        "longest_path_mm": round(float(path.abscissa[-1]), 1),
        "total_length_mm": round(float(sum(line.abscissa[-1] - line.abscissa[0] for line in lines)), 1),
        "ostium_radius_mm": round(float(path.radius[0]), 2),
        "smallest_radius_mm": round(float(tree.line.radius.min()), 2),
        "sections": list(tree.sections_present),
        "ostium_lps_mm": anatomy.insertion.position.round(2).tolist(),
        "insertion_direction": anatomy.insertion.direction.round(3).tolist(),
        "map_spacing_mm": round(anatomy.distance_map.spacing_mm, 3),
        **notes,
    }


def atlas_command(*, output: OutputFolder, config: AtlasConfig = AtlasConfig()) -> Figures:
    """Make synthetic patients whose vessels match published statistics: an anatomy folder for each.

    Args:
        output: folder that takes an anatomy folder for each patient.
    """
    rows = []
    with progress("Synthetic patients", config.count) as advance:
        for anatomy in make_atlas(config=config):
            with claiming(output / anatomy.name, "endopilot atlas", patient=anatomy.identity):
                write_anatomy(anatomy, output=output / anatomy.name)
            path = anatomy.tree.longest_path()
            rows.append(
                {
                    "patient": output / anatomy.name,
                    "branches": len(anatomy.tree.branches),
                    "length_mm": round(float(path.abscissa[-1]), 1),
                    "ostium_radius_mm": round(float(path.radius[0]), 2),
                }
            )
            advance()
    return rows


def phantom_command(
    anatomy: Existing, /, *, output: OutputFile, seed: Seed = 0, config: PhantomConfig = PhantomConfig()
) -> Figures:
    """Make a synthetic CT angiogram of an anatomy.

    Args:
        output: the volume in HU: .nii.gz, .nrrd, .mha, or a new folder without suffix for DICOM slices.
        seed: seed of the noise and of the surrounding tissue.
    """
    check_output(output)
    volume = make_phantom(read_anatomy(anatomy), config=config, seed=seed)
    write_volume(volume, output)
    nz, ny, nx = volume.voxels.shape
    return {"volume": output, "voxels": [nx, ny, nz], "spacing_mm": volume.spacing_mm.tolist()}
