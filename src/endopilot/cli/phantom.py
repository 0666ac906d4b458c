"""`endopilot phantom`: anatomy -> synthetic CT angiogram."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Existing, Figures, OutputFile
from endopilot.imaging.volume import check_output, write_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.settings import Seed


def command(
    anatomy: Positional[Existing], /, *, output: OutputFile, seed: Seed = 0, config: PhantomConfig = PhantomConfig()
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
