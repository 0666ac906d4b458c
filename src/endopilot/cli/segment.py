"""`endopilot segment`: CT angiogram -> mask of the vessel lumen."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import OutputFile, existing, show
from endopilot.files import input_hash, manifest
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import read_volume, write_mask


def command(
    volume: Positional[Path],
    /,
    *,
    output: OutputFile,
    series: str | None = None,
    json: bool = False,
    config: SegmentConfig = SegmentConfig(),
) -> None:
    """Segment the lumen of a vessel tree in a CT angiogram.

    The ostium that was found, and how, is written beside the mask as JSON.

    Args:
        volume: DICOM folder or file, NIfTI, NRRD or MHA, in HU.
        output: the mask: .nii.gz, .nrrd or .mha.
        series: series instance UID, where a DICOM folder holds several.
        json: print the figures as JSON.
        config: how to segment.
    """
    ct = read_volume(existing(volume), series=series)
    mask = segment(ct, config)
    write_mask(mask, output, manifest=manifest(config=config, inputs=input_hash(volume)))
    volume_ml = float(mask.volume.voxels.sum() * mask.volume.spacing_mm.prod() / 1000)
    ostium = mask.ostium.position.round(2).tolist() if mask.ostium is not None else None
    show(
        {"mask": str(output), "method": mask.method, "lumen_ml": round(volume_ml, 3), "ostium_lps_mm": ostium},
        as_json=json,
    )
