"""Walls given for lumens: a printed phantom's shell, a vessel wall's mask. The lumen is what the wall encloses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import binary_erosion, distance_transform_edt

from endopilot.imaging.grid import connected_components
from endopilot.types import Volume
from endopilot.vessels.surface import filled_box

_MOST_VOXELS = 2_000_000
"""A mask of more is looked at in blocks: 0.5 s."""

_ENCLOSED = 16
"""A void is enclosed where the wall is met in this many of the 26 directions: 16 in the plane of a tube's open end,
13 or fewer between two branches."""

_REACH = 5
"""The wall is looked for within 2 to the power of this many voxels."""

_UNIFORM, _LINING = 0.4, 0.9
"""A wall's thickness varies by at most this share of it (SD), and this share of it lines the lumen: not so a vessel
with a catheter or an island in it."""

_THICKEST = 4.0
"""A wall is at most this many times as thick as its lumen's radius."""


def lumen_in_wall(mask: Volume) -> tuple[Bool[np.ndarray, "nz ny nx"], float] | None:
    """Return the void that a wall encloses, closed or open at the ends, and the wall's thickness, mm; None if none.

    Args:
        mask: a solid that may be a wall.
    """
    box = filled_box(mask.voxels)
    solid = np.asarray(mask.voxels[box], dtype=bool)
    if solid.size == 0:
        return None
    factor = int(np.ceil((solid.size / _MOST_VOXELS) ** (1 / 3)))
    coarse = _blocks(solid, factor)
    edges = mask.spacing_mm[::-1] * factor
    void = enclosed(coarse)
    labels = connected_components(void, corners=False)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    lumen = labels == sizes.argmax()
    if sizes.max(initial=0) == 0:
        return None
    to_lumen = np.asarray(distance_transform_edt(~lumen, sampling=edges))
    outside = ~coarse & ~void
    rim = coarse & ~np.asarray(binary_erosion(~outside, border_value=False), dtype=bool)
    thickness = to_lumen[rim]
    middle = float(np.median(thickness)) if rim.any() else 0.0
    width = float(np.asarray(distance_transform_edt(lumen, sampling=edges)).max())
    lining = float((to_lumen[coarse] <= 1.5 * middle + edges.max()).mean())
    if lining < _LINING or np.std(thickness) > _UNIFORM * middle or middle > _THICKEST * width:
        return None
    whole = np.zeros(mask.voxels.shape, dtype=bool)
    fine = lumen
    for axis in range(3):
        fine = np.repeat(fine, factor, axis=axis)
    whole[box] = fine[tuple(slice(0, size) for size in solid.shape)] & ~solid
    return whole, middle


def without_wall(mask: Volume) -> tuple[Volume, list[str]]:
    """Return the lumen that a mask of a wall encloses, with a remark; any other mask as it is."""
    found = lumen_in_wall(mask)
    if found is None:
        return mask, []
    return replace(mask, voxels=found[0]), [wall_text(found[1])]


def wall_text(thickness_mm: float) -> str:
    """Return the remark on a wall that was given for a lumen."""
    return f"what is given is a wall of {thickness_mm:.1f} mm: the lumen inside it is taken"


def _blocks(solid: Bool[np.ndarray, "nz ny nx"], factor: int) -> Bool[np.ndarray, "a b c"]:
    padded = np.pad(solid, [(0, -size % factor) for size in solid.shape])
    shape = [part for size in padded.shape for part in (size // factor, factor)]
    return np.asarray(padded.reshape(shape).any(axis=(1, 3, 5)))


def enclosed(solid: Bool[np.ndarray, "nz ny nx"]) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the void from which a solid is met in most directions."""
    count = np.zeros(solid.shape, dtype=np.int8)
    for step in np.ndindex(3, 3, 3):
        direction = np.array(step) - 1
        if not direction.any():
            continue
        met = solid.copy()
        for power in range(_REACH):
            _or_shifted(met, direction * 2**power)
        count += met
    return (count >= _ENCLOSED) & ~solid


def _or_shifted(met: Bool[np.ndarray, "nz ny nx"], by: np.ndarray) -> None:
    if (np.abs(by) >= met.shape).any():
        return
    here = tuple(slice(max(0, -step), met.shape[axis] - max(0, step)) for axis, step in enumerate(by))
    there = tuple(slice(max(0, step), met.shape[axis] + min(0, step)) for axis, step in enumerate(by))
    met[here] |= met[there].copy()
