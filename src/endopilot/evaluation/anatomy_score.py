"""How well a segmented and extracted vessel matches a known one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from jaxtyping import Float
from scipy.spatial import KDTree

from endopilot.anatomy.projection import project_tip
from endopilot.types import Anatomy, DistanceMap, LumenMask, VesselTree, Volume

SMALLEST_RADIUS_MM = 0.75
"""Vessels thinner than this are not scored: two voxels of a coronary CTA across, CAT08 scores from 0.75 mm up too."""

SAMPLE_STEP_MM = 0.1


@dataclass(frozen=True, kw_only=True)
class AnatomyScore:
    """Agreement of an extracted vessel with the true one, over true vessels of radius 0.75 mm or more.

    Overlap and inside accuracy are those of Schaap et al., Med. Image Anal. 2009 (CAT08).

    Attributes:
        dice: Dice coefficient of the lumen's voxels.
        overlap: OV, share of both centerlines that lies within the true radius of the other.
        inside_accuracy_mm: AI, mean distance between the centerlines where they overlap, mm.
        radius_mae_mm: mean absolute error of the radius where the centerlines overlap, mm.
        ostium_error_mm: distance between the ostia, mm.
        false_length_mm: length of extracted centerline that follows no true vessel of any radius, mm.
    """

    dice: float
    overlap: float
    inside_accuracy_mm: float
    radius_mae_mm: float
    ostium_error_mm: float
    false_length_mm: float


def score_anatomy(mask: LumenMask, extracted: Anatomy, truth: Anatomy) -> AnatomyScore:
    """Compare a mask and the anatomy extracted from it with the anatomy that the volume was made of."""
    true_points, true_radius = _sample(truth.tree)
    points, radius = _sample(extracted.tree)
    distance, nearest = KDTree(true_points).query(points)
    follows = distance <= true_radius[nearest]
    scored = true_radius[nearest] >= SMALLEST_RADIUS_MM
    large = true_radius >= SMALLEST_RADIUS_MM
    reached = KDTree(points).query(true_points[large])[0] <= true_radius[large]
    found, missed = reached.sum() + (follows & scored).sum(), (~reached).sum() + (~follows & scored).sum()
    inside = follows & scored
    return AnatomyScore(
        dice=_dice(mask, truth),
        overlap=float(found / max(found + missed, 1)),
        inside_accuracy_mm=float(distance[inside].mean()) if inside.any() else float("nan"),
        radius_mae_mm=float(np.abs(radius - true_radius[nearest])[inside].mean()) if inside.any() else float("nan"),
        ostium_error_mm=float(np.linalg.norm(extracted.insertion.position - truth.insertion.position)),
        false_length_mm=float((~follows).sum() * SAMPLE_STEP_MM),
    )


def _sample(tree: VesselTree) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return points and radii every 0.1 mm along all branches."""
    points, radius = [], []
    for branch in tree.branches:
        line = branch.centerline
        at = np.arange(line.abscissa[0], line.abscissa[-1], SAMPLE_STEP_MM)
        points.append(np.stack([np.interp(at, line.abscissa, line.points[:, axis]) for axis in range(3)], axis=-1))
        radius.append(np.interp(at, line.abscissa, line.radius))
    return np.concatenate(points), np.concatenate(radius)


def _dice(mask: LumenMask, truth: Anatomy) -> float:
    """Return Dice over voxels beyond the ostium whose nearest true vessel is large enough."""
    ours, true = mask.volume.voxels.astype(bool), _resample(truth.distance_map, mask.volume) > 0
    indices = np.argwhere(ours | true)
    projection = project_tip(truth.tree, truth.insertion, mask.volume.index_to_world(indices[:, ::-1].astype(float)))
    scored = indices[(projection.abscissa > 0) & (projection.radius >= SMALLEST_RADIUS_MM)]
    ours, true = ours[tuple(scored.T)], true[tuple(scored.T)]
    return float(2 * (true & ours).sum() / max(true.sum() + ours.sum(), 1))


def _resample(distance_map: DistanceMap, grid: Volume) -> Float[np.ndarray, "nz ny nx"]:
    """Return the distance map at the voxel centres of `grid`, and a negative number outside the map, mm."""
    image = sitk.GetImageFromArray(np.asarray(distance_map.values, dtype=np.float32))
    image.SetSpacing([distance_map.spacing_mm] * 3)
    image.SetOrigin(distance_map.origin_mm.tolist())
    resample = sitk.ResampleImageFilter()
    resample.SetSize(grid.voxels.shape[::-1])
    resample.SetOutputSpacing(grid.spacing_mm.tolist())
    resample.SetOutputOrigin(grid.origin_mm.tolist())
    resample.SetOutputDirection(grid.direction.ravel().tolist())
    resample.SetDefaultPixelValue(-1.0)
    return sitk.GetArrayFromImage(resample.Execute(image))
