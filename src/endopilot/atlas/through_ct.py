"""An atlas patient as a CT's mask shows it: rasterised, and made into an anatomy again as a real mask is.

Whoever draws a mask follows a vessel until it is a few voxels wide, and takes in voxels that the wall cuts. So masks
have rough walls, end early, and are wide at their ends: the ends of seven real patients' masks, with voxels of 0.6 to
0.75 mm in the plane and slices of 0.5 mm, have radii of 1.2 to 1.9 mm, median 1.4.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.distance import sample
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.labels import Scheme, label_tree
from endopilot.errors import InputError
from endopilot.types import Anatomy, Branch, Centerline, DistanceMap, Insertion, LumenMask, VesselTree, Volume

IN_PLANE_MM, SLICE_MM = (0.6, 0.75), (0.5, 0.5)
"""Range of the voxels' edges, mm."""
TAKEN_IN = (0.4, 0.8)
"""Voxels count as lumen up to this share of their edge outside of the wall."""
NARROWEST_MM = (0.6, 0.9)
"""A vessel ends in the mask where it stays narrower than this radius, mm."""
_SCANS = 4
_MARGIN_MM = 3.0


def visible(generator: np.random.Generator, tree: VesselTree) -> VesselTree:
    """Return what of a tree is wide enough to be drawn: each branch up to its last point that is, or whole if what
    leaves its end is.

    The first branch stays whole.
    """
    narrowest = float(generator.uniform(*NARROWEST_MM))
    ends = [int(np.flatnonzero(np.r_[True, b.centerline.radius >= narrowest])[-1]) for b in tree.branches]
    for index in reversed(range(len(tree.branches))):
        own, ahead = tree.branches[index], tree.branches[index].parent
        # A stub within its parent's lumen is no branch.
        if ahead >= 0 and _length_mm(own, ends[index]) > 2.0 * float(own.centerline.radius[0]):
            ends[ahead] = len(tree.branches[ahead].centerline.radius)
    kept, numbers = list[Branch](), {-1: -1}
    for index, branch in enumerate(tree.branches):
        whole = ends[index] == len(branch.centerline.radius) or index == 0
        reaches = whole or _length_mm(branch, ends[index]) > 2.0 * float(branch.centerline.radius[0])
        if branch.parent in numbers and reaches:
            numbers[index] = len(kept)
            kept.append(_cut(branch, len(branch.section) if whole else ends[index], numbers[branch.parent]))
    return VesselTree(tuple(kept), tree.section_names)


def _length_mm(branch: Branch, count: int) -> float:
    along = branch.centerline.abscissa
    return float(along[max(count - 1, 0)] - along[0])


def _cut(branch: Branch, count: int, parent: int) -> Branch:
    line = branch.centerline
    parts = (values[:count] for values in (line.points, line.radius, line.abscissa, line.normals))
    return Branch(Centerline(*parts), parent, branch.section[:count])


def seen_through_ct(
    generator: np.random.Generator,
    vessel: str,
    tree: VesselTree,
    lumen: DistanceMap,
    direction: Float[np.ndarray, "3"],
    name: str,
    catheter_radius_mm: float,
) -> tuple[Anatomy, dict[str, Any]]:
    """Return the anatomy that `endopilot anatomy` makes of a mask of the patient's lumen, and what was drawn for it.

    Args:
        tree: the patient's vessels.
        lumen: distance to the wall, without a catheter.
        direction: the vessel's first direction.
        catheter_radius_mm: inner radius of the guiding catheter, mm.

    Raises:
        InputError: no vessel was found in four masks.
    """
    scheme = vessel if vessel in ("rca", "lca") else "generic"
    config = AnatomyConfig(vessel=scheme, catheter_radius_mm=catheter_radius_mm)  # pyright: ignore[reportArgumentType]
    ostium = Insertion(position=tree.branches[0].centerline.points[0], direction=direction)
    why = ""
    for rejected in range(_SCANS):
        voxel = np.array([*[float(generator.uniform(*IN_PLANE_MM))] * 2, float(generator.uniform(*SLICE_MM))])
        taken_in = float(generator.uniform(*TAKEN_IN))
        volume = rasterised(lumen, voxel, taken_in, generator.uniform(0.0, 1.0, 3))
        try:
            found = extract_anatomy(LumenMask(volume, ostium), name=name, config=config)
        except InputError as error:
            why = str(error)
            continue
        if scheme == "generic":
            found = Anatomy(
                name=found.name,
                tree=label_tree(found.tree, cast(Scheme, vessel)),
                distance_map=found.distance_map,
                insertion=found.insertion,
                catheter_radius_mm=found.catheter_radius_mm,
            )
        return found, {"voxel_mm": voxel.tolist(), "taken_in": taken_in, "scans_rejected": rejected}
    raise InputError(f"{name}: no vessel found in {_SCANS} masks of it ({why}); choose another seed")


def rasterised(
    lumen: DistanceMap, voxel_mm: Float[np.ndarray, "3"], taken_in: float, shift: Float[np.ndarray, "3"]
) -> Volume:
    """Return the voxels whose centre lies in a lumen, or outside by up to a share of their edge in the plane.

    Args:
        lumen: distance to the wall, mm.
        taken_in: that share.
        shift: of the grid, in voxels.
    """
    k, j, i = np.nonzero(lumen.values > -_MARGIN_MM / 2)
    points = np.stack([i, j, k], axis=1) * lumen.spacing_mm + lumen.origin_mm
    origin = points.min(axis=0) - _MARGIN_MM + shift * voxel_mm
    count = np.ceil((points.max(axis=0) + _MARGIN_MM - origin) / voxel_mm).astype(int) + 1
    x, y, z = (origin[axis] + voxel_mm[axis] * np.arange(count[axis]) for axis in range(3))
    voxels = np.zeros((len(z), len(y), len(x)), dtype=bool)
    for index, height in enumerate(z):
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1).reshape(-1, 3)
        voxels[index] = (sample(lumen, grid) > -taken_in * voxel_mm[0]).reshape(len(y), len(x))
    return Volume(voxels, voxel_mm, origin, np.eye(3))
