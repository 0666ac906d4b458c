"""`endopilot xray` and `angiograms`: X-ray images of devices in vessels."""

from __future__ import annotations

from endopilot.anatomy.io import read_anatomy
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.cli.arguments import Figures
from endopilot.devices.stack import Stack
from endopilot.files import read_json
from endopilot.imaging.volume import read_volume
from endopilot.runs import Existing, OutputFolder, Picture
from endopilot.xray.take_image import TakeImageConfig, take_image


def xray_command(
    anatomy: Existing,
    /,
    *,
    output: Picture,
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


def angiograms_command(
    patients: tuple[Existing, ...],
    /,
    *,
    output: OutputFolder,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    scheduler: str | None = None,
    config: AngiogramsConfig = AngiogramsConfig(),
) -> Figures:
    """Make X-ray cines of patients' vessels, with contrast, motion and devices, and the truth of each frame.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        patients: folders made by `endopilot anatomy` or `endopilot atlas`, or CT angiograms, which are segmented.
        output: folder of the data set.
    """
    from endopilot.angiograms.config import MANIFEST_FILE, SAMPLES_FILE  # slow to import; --help needs none
    from endopilot.angiograms.make import make_angiograms

    make_angiograms(patients, output=output, device=Stack.of(device, *catheter), config=config, scheduler=scheduler)
    splits = read_json(output / MANIFEST_FILE)["splits"]
    return {
        "data_set": output,
        **{f"{split}_{what}": count for split, counts in splits.items() for what, count in counts.items()},
        "samples": output / SAMPLES_FILE,
    }
