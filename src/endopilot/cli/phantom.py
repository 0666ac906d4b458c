"""`endopilot phantom`: anatomy -> synthetic CT angiogram."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import OutputFile, existing, show
from endopilot.imaging.volume import check_output, write_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.settings import Seed


def command(
    anatomy: Positional[Path],
    /,
    *,
    output: OutputFile,
    seed: Seed = 0,
    json: bool = False,
    config: PhantomConfig = PhantomConfig(),
) -> None:
    """Make a synthetic CT angiogram of an anatomy.

    Args:
        anatomy: folder made by `endopilot anatomy` or `endopilot atlas`.
        output: the volume in HU: .nii.gz, .nrrd, .mha, or a new folder without suffix for DICOM slices.
        seed: seed of the noise and of the surrounding tissue.
        json: print the figures as JSON.
        config: scanner and contrast.
    """
    check_output(output)
    volume = make_phantom(read_anatomy(existing(anatomy)), config, seed)
    write_volume(volume, output)
    nz, ny, nx = volume.voxels.shape
    show({"volume": str(output), "voxels": [nx, ny, nz], "spacing_mm": volume.spacing_mm.tolist()}, as_json=json)
