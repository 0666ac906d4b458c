"""`endopilot xray`: anatomy -> X-ray image of a wire in it, alone or in a catheter."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Existing, Figures, OutputFile
from endopilot.imaging.volume import read_volume
from endopilot.xray.take_image import TakeImageConfig, take_image


def xray_command(
    anatomy: Positional[Existing],
    /,
    *,
    output: OutputFile,
    ct: Existing | None = None,
    config: TakeImageConfig = TakeImageConfig(),
) -> Figures:
    """Push a wire, alone or in a catheter, into a vessel, and take an X-ray image: fluoroscopy, contrast, DSA, roadmap.

    Args:
        output: the image, .png.
        ct: CT angiogram of the patient, HU; a synthetic chest around a coronary artery, else water, if not given.
    """
    volume = None if ct is None else read_volume(ct)
    image = take_image(read_anatomy(anatomy), config=config, ct=volume)
    image.write(output)
    tip = None if image.tip_pixel is None else [round(float(value), 2) for value in image.tip_pixel]
    figures = {"image": output, "tip_row_column": tip, "mm_per_pixel": round(image.mm_per_pixel, 4)}
    if volume is not None and volume.notes:
        figures["ct_notes"] = list(volume.notes)
    return figures | {"frames": image.frames, "air_kerma_ugy": round(image.air_kerma_ugy, 3)}
