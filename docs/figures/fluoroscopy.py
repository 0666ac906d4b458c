"""Make the picture of X-ray images in docs/concepts/images.md: `python docs/figures/fluoroscopy.py`."""

from __future__ import annotations

from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import SimpleITK as sitk

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.xray.take_image import TakeImageConfig, take_image

PICTURE = Path(__file__).parents[1] / "images" / "fluoroscopy.png"

if __name__ == "__main__":
    patient = make_patient(AtlasConfig(vessel="rca", seed=77), 0)
    shown = get_args(get_type_hints(TakeImageConfig)["show"])
    images = [
        take_image(patient, config=TakeImageConfig(show=kind, inserted_length_mm=110.0)).grey[40:450, 60:470]
        for kind in shown
    ]
    grey = np.concatenate([np.concatenate(images[:2], axis=1), np.concatenate(images[2:], axis=1)])
    sitk.WriteImage(sitk.GetImageFromArray(grey), str(PICTURE), useCompression=True)
