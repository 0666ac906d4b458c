"""A segmentation method of one's own: everything brighter than a threshold that is connected to the first seed.

    python examples/my_segmentation.py
    cd examples && endopilot segment ct.nii.gz --method my_segmentation:threshold --options above=200 \
        --seeds 2 -143 543 -o mask.nii.gz

A method is a function that takes the CT in HU and the settings, and returns a `LumenMask` on the CT's grid. To give it
settings of its own, wrap it into a `SegmentationMethod`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

import endopilot

OPTIONS = {"above": "200"}


def above_threshold(volume: endopilot.Volume, config: endopilot.SegmentConfig) -> endopilot.LumenMask:
    if not config.seeds:
        raise endopilot.InputError("seeds: none given; give a point inside the lumen, LPS mm")
    bright = volume.voxels > float(config.settings(OPTIONS)["above"])
    label, _ = ndimage.label(bright)
    x, y, z = np.rint(volume.world_to_index(np.array(config.seeds[0]))).astype(int)
    inside = bright & (label == label[z, y, x])
    return endopilot.LumenMask(endopilot.Volume(inside, volume.spacing_mm, volume.origin_mm, volume.direction))


threshold = endopilot.SegmentationMethod(segment_lumen=above_threshold, options=OPTIONS)


def main() -> None:
    # A tube of blood with a radius of 4 mm along z, in fat, and another one that it does not touch.
    _, y, x = np.indices((60, 50, 50))
    tube, other = np.hypot(x - 15, y - 25) < 8, np.hypot(x - 38, y - 25) < 6
    hu = np.where(tube | other, 350.0, -90.0)
    volume = endopilot.Volume(hu, spacing_mm=np.full(3, 0.5), origin_mm=np.zeros(3), direction=np.eye(3))
    config = endopilot.SegmentConfig(
        method="my_segmentation:threshold",  # as `endopilot segment --method` finds it
        seeds=((7.5, 12.5, 15.0),),
        options=("above=250",),
    )
    mask = endopilot.segment(volume, config=config)
    found_ml = mask.volume.voxels.sum() * 0.5**3 / 1000
    true_ml = np.pi * 4.0**2 * 30.0 / 1000
    print(f"found {found_ml:.3f} ml, the tube holds {true_ml:.3f} ml")
    assert np.array_equal(mask.volume.voxels, tube) and abs(found_ml / true_ml - 1) < 0.05


if __name__ == "__main__":
    main()
