"""How far two masks of one vessel agree: `compare_masks`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from endopilot.errors import InputError
from endopilot.imaging.grid import interpolate_like
from endopilot.types import LumenMask, Volume


@dataclass(frozen=True)
class MaskOverlap:
    """Agreement of a mask with a reference, on the mask's grid.

    Attributes:
        dice: 2 |both| / (|mask| + |reference|).
        share_inside_reference: share of the mask that lies in the reference.
        cut_off_ml: volume of the reference that the mask lacks, ml.
        beyond_ml: volume of the mask outside the reference, ml.
    """

    dice: float
    share_inside_reference: float
    cut_off_ml: float
    beyond_ml: float


def compare_masks(mask: LumenMask, reference: LumenMask) -> MaskOverlap:
    """Return how far a mask agrees with a reference on any grid.

    Raises:
        InputError: the reference is empty, or lies wholly outside the mask's volume.
    """
    ours, theirs = mask.volume.voxels, mask_like(reference, mask.volume)
    if not theirs.any():
        raise InputError("reference: has no voxel set inside the volume; give a mask of the same scan")
    ml = float(mask.volume.spacing_mm.prod()) / 1000
    both = float((ours & theirs).sum())
    return MaskOverlap(
        dice=2 * both / float(ours.sum() + theirs.sum()),
        share_inside_reference=both / float(ours.sum()),
        cut_off_ml=float((theirs & ~ours).sum()) * ml,
        beyond_ml=float((ours & ~theirs).sum()) * ml,
    )


def mask_like(mask: LumenMask, like: Volume) -> Bool[np.ndarray, "nz ny nx"]:
    """Return a mask at the voxels of a volume on any grid."""
    inside = mask.volume
    values = Volume(inside.voxels.astype(np.float32), inside.spacing_mm, inside.origin_mm, inside.direction)
    return interpolate_like(values, like, outside=0.0) > 0.5
