"""Volumes on other grids and as SimpleITK's images, distances and components on a grid, and agreement of two masks."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import SimpleITK as sitk
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from endopilot.errors import InputError, Remark, box_text
from endopilot.types import Anatomy, LumenMask, Volume

LEAST_BLOOD_HU = 130.0  # without contrast blood measures 30-60 HU; below this no method here separates lumen from wall


def to_image(volume: Volume) -> sitk.Image:
    """Return a volume as a SimpleITK image; booleans become uint8."""
    voxels = volume.voxels.astype(np.uint8) if volume.voxels.dtype == bool else volume.voxels
    image = sitk.GetImageFromArray(voxels)
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetOrigin(volume.origin_mm.tolist())
    image.SetDirection(volume.direction.ravel().tolist())
    return image


def from_image(image: sitk.Image) -> Volume:
    """Return a SimpleITK image as a volume, its voxels of the image's own type."""
    return Volume(
        voxels=sitk.GetArrayFromImage(image),
        spacing_mm=np.array(image.GetSpacing(), dtype=float),
        origin_mm=np.array(image.GetOrigin(), dtype=float),
        direction=np.array(image.GetDirection(), dtype=float).reshape(3, 3),
    )


def check_covers(ct: Volume, anatomy: Anatomy) -> None:
    """Raise InputError where a CT shows less than half of a vessel; a `Remark` says what else lies beyond its edges."""
    points = anatomy.tree.line.points
    shape = np.array(ct.voxels.shape[::-1])
    index = ct.world_to_index(points)
    outside = ((index < -1) | (index > shape)).any(axis=1).mean()  # a voxel beyond: a surface may end there
    if outside:
        corners = ct.index_to_world(np.indices((2, 2, 2)).reshape(3, -1).T * shape - 0.5)
        where = f"{outside:.0%} of the vessel {anatomy.name} ({box_text(points)}) lies outside it"
        said = f"{ct.files[0] if ct.files else 'ct'}: the CT spans {box_text(corners)}; {where}"
        if outside > 0.5:
            raise InputError(f"{said}; give the CT that the vessel was found in")
        warnings.warn(said, Remark, stacklevel=3)


def resample(volume: Volume, spacing_mm: float) -> Volume:
    """Return a volume on an isotropic grid, its axes in the order and sense nearest to LPS, as float32. Axes that
    become coarser are smoothed first, so that fine structures are averaged and not skipped."""
    oriented = from_image(sitk.DICOMOrient(to_image(volume), "LPS"))
    voxels = oriented.voxels.astype(np.float32)
    # A Gaussian of this width turns one sampling aperture (taken as Gaussian, σ half a voxel) into the other.
    sigma = 0.5 * np.sqrt(np.maximum(spacing_mm**2 - oriented.spacing_mm**2, 0)) / oriented.spacing_mm
    if sigma.max() > 0.2:
        voxels = ndimage.gaussian_filter(voxels, sigma[::-1], truncate=3.0)
    image = to_image(Volume(voxels, oriented.spacing_mm, oriented.origin_mm, oriented.direction))
    if np.allclose(oriented.spacing_mm, spacing_mm):
        return from_image(image)
    extent = (np.array(image.GetSize()) - 1) * oriented.spacing_mm
    size = (np.floor(extent / spacing_mm + 1e-6).astype(int) + 1).tolist()
    return from_image(
        sitk.Resample(
            image, size, sitk.Transform(), sitk.sitkLinear, image.GetOrigin(), [spacing_mm] * 3, image.GetDirection()
        )
    )


def interpolate_like(volume: Volume, like: Volume, outside: float) -> Float[np.ndarray, "nz ny nx"]:
    """Return a volume's values at the voxels of another, interpolated linearly, `outside` beyond its edge."""
    image = sitk.Cast(to_image(volume), sitk.sitkFloat32)
    return sitk.GetArrayFromImage(sitk.Resample(image, to_image(like), sitk.Transform(), sitk.sitkLinear, outside))


def distance_to_outside(
    mask: Bool[np.ndarray, "nz ny nx"], spacing_mm: float | tuple[float, float, float]
) -> Float[np.ndarray, "nz ny nx"]:
    """Return each voxel's distance to the nearest centre outside, mm; `spacing_mm` is along k, j, i, or one for all."""
    outside = sitk.GetImageFromArray((~mask).astype(np.uint8))
    outside.SetSpacing([float(step) for step in np.broadcast_to(spacing_mm, 3)[::-1]])
    signed = sitk.SignedMaurerDistanceMap(outside, insideIsPositive=False, squaredDistance=False, useImageSpacing=True)
    return np.maximum(sitk.GetArrayFromImage(signed), np.float32(0))


def connected_components(mask: Bool[np.ndarray, "nz ny nx"], *, corners: bool = False) -> Int[np.ndarray, "nz ny nx"]:
    """Return numbers from 1 of a mask's connected parts, 0 outside; `corners` connects at edges and corners too."""
    structure = ndimage.generate_binary_structure(3, 3 if corners else 1)
    return ndimage.label(mask, structure)[0]  # pyright: ignore[reportIndexIssue]


@dataclass(frozen=True)
class MaskOverlap:
    """Agreement of a mask with a reference on the mask's grid: Dice 2 |both| / (|mask| + |reference|), the mask's share
    inside, and the volumes of either beyond the other, ml."""

    dice: float
    share_inside_reference: float
    cut_off_ml: float
    beyond_ml: float


def compare_masks(mask: LumenMask, reference: LumenMask) -> MaskOverlap:
    """Return how far a mask agrees with a reference on any grid; InputError if that is empty or outside the volume."""
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
    values = replace(mask.volume, voxels=mask.volume.voxels.astype(np.float32))
    return interpolate_like(values, like, outside=0.0) > 0.5
