"""`endopilot xray`: anatomy -> X-ray image of a wire in it, alone or in a catheter."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import OutputFile, existing, show
from endopilot.imaging.volume import read_volume
from endopilot.xray.take_image import TakeImageConfig, take_image


def command(
    anatomy: Positional[Path],
    /,
    *,
    output: OutputFile,
    ct: Path | None = None,
    json: bool = False,
    config: TakeImageConfig = TakeImageConfig(),
) -> None:
    """Push a wire, alone or in a catheter, into a vessel, and take an X-ray image: fluoroscopy, contrast, DSA, roadmap.

    Args:
        anatomy: folder made by `endopilot anatomy` or `endopilot atlas`.
        output: the image, .png.
        ct: CT angiogram of the patient, HU; a synthetic chest around a coronary artery, else water, if not given.
        json: print the figures as JSON.
        config: what is shown, from where, at which dose.
    """
    volume = None if ct is None else read_volume(existing(ct))
    image = take_image(read_anatomy(existing(anatomy)), config, volume)
    image.write(output)
    tip = None if image.tip_pixel is None else [round(float(value), 2) for value in image.tip_pixel]
    figures = {"image": str(output), "tip_row_column": tip, "mm_per_pixel": round(image.mm_per_pixel, 4)}
    if volume is not None and volume.notes:
        figures["ct_notes"] = list(volume.notes)
    show(figures | {"frames": image.frames, "air_kerma_ugy": round(image.air_kerma_ugy, 3)}, as_json=json)
