"""Checks by the histogram that a CT is in HU and that its blood holds contrast, before a method searches it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from endopilot.errors import InputError
from endopilot.imaging.grid import LEAST_BLOOD_HU
from endopilot.types import Volume

_BLOCK_MM = 2.0
"""Voxels are averaged to blocks of about this size: noise goes, pools of blood stay."""
_CALM_HU = 25.0
"""Tissue is homogeneous where its standard deviation over 3 × 3 × 3 blocks is smaller: blood is, bone is not."""
_NOISE_FACTOR = 1.3
"""In a noisy scan, the limit is this many times the lower quartile of that deviation in fat, muscle and blood."""
_BRIGHTEST_HU = 900.0
"""Metal and dense bone lie above this, no blood does."""
_LEAST_POOL_ML = 4.0
"""Less than the inside of any heart chamber; homogeneous bone of the thorax comes in smaller pieces."""
_POOL_MM = 20.0
"""Diameter of a ball of that volume: a field of view that is shorter holds only a slice of a pool."""


def refuse_other_units(volume: Volume, seeds: Sequence[Sequence[float]] = ()) -> None:
    """Refuse a volume that cannot be in HU.

    A CT that was cut off at 0, or stripped of all but the brain, holds nothing below 0 either. Seeds tell it from one
    whose rescale is lost: at them it has the HU of blood with contrast.

    Args:
        volume: CT in HU.
        seeds: places in the vessel, LPS mm.

    Raises:
        InputError: nothing is below 0, where fat, lung and air are, and no blood at seeds shows that it is CT.
    """
    low, high = float(volume.voxels.min()), float(volume.voxels.max())
    if low < 0:
        return
    if not seeds:
        raise InputError(
            f"the volume's values go from {low:g} to {high:g}, but fat, lung and air are below 0 HU: this is no CT, or "
            "its rescale is lost; export it in HU, or give seeds if it was cut off at 0"
        )
    places = np.rint(volume.world_to_index(np.array(seeds, dtype=float))).astype(int)[:, ::-1]
    around = [volume.voxels[tuple(slice(max(i - 1, 0), i + 2) for i in place)] for place in places]
    blood = float(np.median([np.median(box) for box in around]))
    if not LEAST_BLOOD_HU <= blood <= _BRIGHTEST_HU:
        raise InputError(
            f"the volume's values go from {low:g} to {high:g}, but fat, lung and air are below 0 HU, and blood with "
            f"contrast has {LEAST_BLOOD_HU:g} to {_BRIGHTEST_HU:g} HU, not {blood:g} as at the seeds: the rescale is "
            "lost, or the seeds lie beside the vessel"
        )


def refuse_without_contrast(volume: Volume) -> None:
    """Refuse a CT of the chest or abdomen whose blood holds no contrast.

    The histogram is that of homogeneous tissue. Blood with contrast is the one tissue that fills millilitres there
    above 130 HU; blood without measures 30 to 60 HU, like muscle. Of a field of view shorter than a pool, a
    proportionally smaller pool is asked for.

    Raises:
        InputError: no connected 4 ml of homogeneous tissue are that bright.
    """
    extent_mm = float((volume.spacing_mm * volume.voxels.shape[::-1]).min())
    blocks, size_mm = _blocks(volume)
    mean = ndimage.uniform_filter(blocks, 3)
    variance = ndimage.uniform_filter(blocks**2, 3) - mean**2
    soft = (mean > -120.0) & (mean < LEAST_BLOOD_HU)
    noise_hu = float(np.sqrt(max(np.percentile(variance[soft], 25), 0.0))) if soft.any() else 0.0
    calm = variance < max(_CALM_HU, _NOISE_FACTOR * noise_hu) ** 2
    label, _ = ndimage.label(calm & (mean > LEAST_BLOOD_HU) & (mean < _BRIGHTEST_HU))  # pyright: ignore[reportGeneralTypeIssues]
    largest_ml = float(np.bincount(label.ravel())[1:].max(initial=0) * size_mm.prod() / 1000)
    if largest_ml >= _LEAST_POOL_ML * min(1.0, extent_mm / _POOL_MM):
        return
    if extent_mm < _POOL_MM:
        raise InputError(
            f"the volume is only {extent_mm:.0f} mm thick, and its largest piece of homogeneous tissue above "
            f"{LEAST_BLOOD_HU:.0f} HU has {largest_ml:.1f} ml, too little to recognise blood with contrast; give a CT "
            "angiogram that holds the aortic root, or seeds in the vessel"
        )
    count, edge = np.histogram(mean[calm], bins=np.arange(-20.0, 400.0, 10.0))
    peak = f"peaks at {edge[count.argmax()] + 5.0:.0f} HU" if count.any() else "is absent"
    raise InputError(
        f"no contrast: homogeneous soft tissue {peak}, and its largest piece above {LEAST_BLOOD_HU:.0f} HU, "
        f"as blood with contrast is, has {largest_ml:.1f} ml; give a CT angiogram in the arterial phase"
    )


def _blocks(volume: Volume) -> tuple[Float[np.ndarray, "mz my mx"], Float[np.ndarray, "3"]]:
    """Return the means of blocks of voxels, and the blocks' size along k, j and i, mm."""
    spacing = volume.spacing_mm[::-1]
    factor = np.maximum(np.round(_BLOCK_MM / spacing), 1).astype(int)
    factor = np.minimum(factor, volume.voxels.shape)
    result = volume.voxels
    for axis, step in enumerate(factor.tolist()):
        kept = result.shape[axis] // step * step
        shape = (*result.shape[:axis], kept // step, step, *result.shape[axis + 1 :])
        result = np.take(result, range(kept), axis=axis).reshape(shape).mean(axis=axis + 1, dtype=np.float32)
    return result, spacing * factor
