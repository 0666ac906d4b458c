"""Where vessels open into the aorta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.imaging.grid import connected_components, distance_to_outside

TO_WALL_MM = 3.5
"""Vesselness fades where an artery opens into the aorta: a tree starts within this distance of the wall."""
_OPENING_MM = 5.0
"""Blood that joins a vessel to the aorta is looked for this far around the vessel's voxel nearest the wall."""


@dataclass(frozen=True, eq=False)
class Opening:
    """Where a vessel comes to the aortic wall.

    Attributes:
        voxel: the vessel's voxel nearest the wall (k, j, i).
        vessel: number of the connected vessel among all.
    """

    voxel: Int[np.ndarray, "3"]
    vessel: int


def box_around(index: np.ndarray, margin: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the slices (k, j, i) around some voxel indices with a margin, clipped to the volume."""
    low = np.maximum(np.floor(index.min(axis=0) - margin).astype(int), 0)
    high = np.minimum(np.ceil(index.max(axis=0) + margin).astype(int) + 1, shape)
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def opens_into(
    hu: Float[np.ndarray, "nz ny nx"],
    blood_hu: float,
    aorta: Bool[np.ndarray, "nz ny nx"],
    vessel: Bool[np.ndarray, "nz ny nx"],
    start: Int[np.ndarray, "3"],
    spacing_mm: float,
) -> bool:
    """Return whether blood joins a vessel to the aorta around the vessel's voxel nearest to it."""
    box = box_around(start[None], np.full(3, _OPENING_MM / spacing_mm), vessel.shape)
    blood = hu[box] > blood_hu
    label = connected_components(blood)
    return bool(np.intersect1d(label[vessel[box] & blood], label[aorta[box] & blood]).size)


def openings(
    hu: Float[np.ndarray, "nz ny nx"],
    blood_hu: float,
    aorta: Bool[np.ndarray, "nz ny nx"],
    vessels: Int[np.ndarray, "nz ny nx"],
    spacing_mm: float,
) -> list[Opening]:
    """Return all places where blood joins a vessel to the aorta; `vessels` numbers connected vessels, 0 is none."""
    if not aorta.any():
        return []
    box = box_around(np.argwhere(aorta), np.full(3, TO_WALL_MM / spacing_mm + 1), aorta.shape)
    gap = distance_to_outside(~aorta[box], spacing_mm)
    patches = connected_components((gap <= TO_WALL_MM) & (vessels[box] > 0), corners=True)
    corner = np.array([part.start for part in box])
    found = []
    for patch in range(1, int(patches.max()) + 1):
        voxels = np.argwhere(patches == patch)
        nearest = voxels[gap[tuple(voxels.T)].argmin()] + corner
        number = int(vessels[tuple(nearest)])
        if opens_into(hu, blood_hu, aorta, vessels == number, nearest, spacing_mm):
            found.append(Opening(nearest, number))
    return found
