"""How well a segmented and extracted vessel matches a known one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy import ndimage
from scipy.spatial import KDTree

from endopilot.anatomy.projection import project_tip
from endopilot.anatomy.tree import SAMPLE_STEP_MM, sampled
from endopilot.imaging.grid import interpolate_like
from endopilot.types import Anatomy, LumenMask, VesselTree, Volume
from endopilot.vessels.graph import groups

SMALLEST_RADIUS_MM = 0.75  # thinner vessels are not scored: two voxels of a coronary CTA, as CAT08 does


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Agreement of two centerline trees, after CAT08 (Schaap et al. 2009).

    A true point is found (TPR) if an extracted point lies within the true radius there, missed (FN) otherwise; an
    extracted point is right (TPM) if it lies within the true radius of the true point nearest to it, false (FP)
    otherwise. CAT08 pairs the points of one vessel by dynamic programming; here, in trees, each is paired with the
    nearest. Points whose true radius is below `SMALLEST_RADIUS_MM` are not counted.

    Attributes:
        overlap: OV = (TPR + TPM) / (TPR + TPM + FN + FP).
        inside_accuracy_mm: AI, mean distance over the pairs of points that are found or right, mm.
        radius_mae_mm: mean absolute difference of the radii over the pairs that are right, mm.
        false_length_mm: length of the longest connected piece of extracted line that is false, whatever the radius, mm.
    """

    overlap: float
    inside_accuracy_mm: float
    radius_mae_mm: float
    false_length_mm: float


@dataclass(frozen=True, kw_only=True)
class AnatomyScore(Agreement):
    """Agreement of an extracted vessel with the true one, over true vessels of radius 0.75 mm or more; besides, Dice of
    the lumen's voxels beyond the ostium, and `cl_dice`."""

    dice: float
    cldice: float
    ostium_error_mm: float


def score_anatomy(mask: LumenMask, extracted: Anatomy, truth: Anatomy) -> AnatomyScore:
    """Compare a mask and the anatomy extracted from it with the anatomy that the volume was made of."""
    dice, cldice = _mask_scores(mask, truth)
    ostium_error_mm = float(np.linalg.norm(extracted.insertion.position - truth.insertion.position))
    agreement = vars(compare_trees(extracted.tree, truth.tree))
    return AnatomyScore(dice=dice, cldice=cldice, ostium_error_mm=ostium_error_mm, **agreement)


def compare_trees(
    extracted: VesselTree, truth: VesselTree, *, smallest_radius_mm: float = SMALLEST_RADIUS_MM
) -> Agreement:
    """Return how a centerline tree agrees with the true one, without the true one's points of a smaller radius."""
    true_points, true_radius = sampled(truth)
    points, radius = sampled(extracted)
    distance, nearest = KDTree(true_points).query(points)
    follows, scored = distance <= true_radius[nearest], true_radius[nearest] >= smallest_radius_mm
    large = true_radius >= smallest_radius_mm
    to_extracted, _ = KDTree(points).query(true_points[large])
    found, right = to_extracted <= true_radius[large], follows & scored
    agreeing = int(found.sum() + right.sum())
    pairs = np.concatenate([to_extracted[found], distance[right]])
    astray = points[~follows]
    pieces = np.bincount(groups(astray, 2.5 * SAMPLE_STEP_MM)) if len(astray) else np.zeros(0)
    return Agreement(
        overlap=agreeing / max(len(found) + int(scored.sum()), 1),
        inside_accuracy_mm=float(pairs.mean()) if len(pairs) else float("nan"),
        radius_mae_mm=float(np.abs(radius - true_radius[nearest])[right].mean()) if right.any() else float("nan"),
        false_length_mm=float(pieces.max(initial=0) * SAMPLE_STEP_MM),
    )


def cl_dice(
    mask: Bool[np.ndarray, "nz ny nx"],
    truth: Bool[np.ndarray, "nz ny nx"],
    mask_skeleton: Bool[np.ndarray, "nz ny nx"],
    truth_skeleton: Bool[np.ndarray, "nz ny nx"],
) -> float:
    """Return the centerline Dice of two masks V with skeletons S (Shit et al., "clDice", CVPR 2021): 2·T_prec·T_sens /
    (T_prec + T_sens) of T_prec = |S_mask ∩ V_truth| / |S_mask| and T_sens = |S_truth ∩ V_mask| / |S_truth|."""
    precision = (mask_skeleton & truth).sum() / max(mask_skeleton.sum(), 1)
    sensitivity = (truth_skeleton & mask).sum() / max(truth_skeleton.sum(), 1)
    return float(2 * precision * sensitivity / max(precision + sensitivity, 1e-12))


def _mask_scores(mask: LumenMask, truth: Anatomy) -> tuple[float, float]:
    """Return Dice and clDice over voxels beyond the ostium whose nearest true vessel is large enough. The true skeleton
    is the true centerline; the mask's is thinned out of it (Lee et al. 1994)."""
    from skimage.morphology import skeletonize

    wall = truth.distance_map
    whole = Volume(wall.values, np.full(3, wall.spacing_mm), wall.origin_mm, np.eye(3))
    true = interpolate_like(whole, mask.volume, outside=-1.0) > 0
    box = ndimage.find_objects((mask.volume.voxels | true).astype(np.uint8))[0]
    ours, true = np.pad(mask.volume.voxels[box], 1), np.pad(true[box], 1)
    corner = np.array([part.start - 1 for part in box])
    indices = np.argwhere(ours | true)
    places = mask.volume.index_to_world((indices + corner)[:, ::-1].astype(float))
    projection = project_tip(truth.tree, truth.insertion, places)
    scored = np.zeros(ours.shape, dtype=bool)
    scored[tuple(indices[(projection.abscissa > 0) & (projection.radius >= SMALLEST_RADIUS_MM)].T)] = True
    points, _ = sampled(truth.tree)
    line = np.zeros(ours.shape, dtype=bool)
    line[tuple((np.rint(mask.volume.world_to_index(points)).astype(int)[:, ::-1] - corner).T)] = True
    dice = 2 * (true & ours & scored).sum() / max((true & scored).sum() + (ours & scored).sum(), 1)
    return float(dice), cl_dice(ours, true, skeletonize(ours) & scored, line & true & scored)
