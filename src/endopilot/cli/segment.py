"""`endopilot segment`: CT angiogram -> mask of the vessel lumen."""

from __future__ import annotations

from dataclasses import asdict

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFile, Picture
from endopilot.files import input_hash, manifest
from endopilot.imaging.grid import compare_masks
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import check_output, read_mask, read_volume, write_mask


def segment_command(
    volume: Positional[Existing],
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
