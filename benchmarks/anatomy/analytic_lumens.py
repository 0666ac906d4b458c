"""Lumens whose axis, radius and wall are known in closed form: what extraction is measured and tested on."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from endopilot.anatomy.tree import make_centerline
from endopilot.types import Branch, LumenMask, VesselTree, Volume

TUBE_MM = 1.5
"""Radius of a tube without a branch, mm."""
BEND_MM = 20.0
"""Radius of the bend of `torus_distance` and of the bent tube, mm."""

Distance = Callable[[np.ndarray], np.ndarray]
"""Signed distance to a wall at positions (..., 3), mm, positive inside."""


def torus_distance(points: Float[np.ndarray, "*n 3"], radius: float) -> Float[np.ndarray, "*n"]:
    """Return the signed distance to a torus around z with bend radius `BEND_MM`, positive inside, mm."""
    return radius - np.hypot(np.hypot(points[..., 0], points[..., 1]) - BEND_MM, points[..., 2])


def mask_of(
    distance: Distance,
    half_mm: Sequence[float | int],
    spacing: Sequence[float | int],
    rotation: Float[np.ndarray, "3 3"] | None = None,
) -> LumenMask:
    """Sample a signed distance on voxels centred at the origin, perhaps on rotated axes.

    Args:
        distance: positive inside the lumen.
        half_mm: half the edges of the volume, mm.
        spacing: voxel edges, mm.
        rotation: columns are the voxel axes; those of LPS if None.
    """
    rotation = np.eye(3) if rotation is None else rotation
    size = np.array(spacing, dtype=float)
    count = np.ceil(2 * np.array(half_mm) / size).astype(int)
    origin = -rotation @ (size * (count - 1) / 2)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1).transpose(2, 1, 0, 3)
    empty = Volume(np.zeros(count[::-1], dtype=bool), size, origin, rotation)
    voxels = distance(empty.index_to_world(index.astype(float))) > 0
    return LumenMask(Volume(voxels, size, origin, rotation))


def tree_of(*lines: tuple[Float[np.ndarray, "_ 3"], float, int]) -> VesselTree:
    """Return a tree of tubes of constant radius, each given by its axis, its radius in mm and its parent's index."""
    branches: list[Branch] = []
    for points, radius, parent in lines:
        size = np.full(len(points), float(radius))
        before = branches[parent].centerline if parent >= 0 else None
        if before is not None:
            size[0] = before.radius[-1]
        centerline = make_centerline(points, size, 0.0 if before is None else float(before.abscissa[-1]))
        branches.append(Branch(centerline, parent, np.zeros(len(points), dtype=np.int64)))
    return VesselTree(tuple(branches), ("vessel",))


def straight_tree() -> VesselTree:
    """Return a straight tube of 40 mm along z, its middle at the origin."""
    return tree_of((np.outer(np.linspace(-0.5, 0.5, 81) * 40.0, [0.0, 0.0, 1.0]), TUBE_MM, -1))


def torus_tree() -> VesselTree:
    """Return five sixths of a torus around z."""
    angle = np.linspace(np.pi / 6, 11 * np.pi / 6, 400)
    return tree_of((BEND_MM * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), TUBE_MM, -1))


def helix_tree() -> VesselTree:
    """Return one and a half turns of a helix around z: curvature 0.118 /mm and torsion 0.028 /mm."""
    angle = np.linspace(0.0, 3 * np.pi, 400)
    height = 12.0 * (angle / (2 * np.pi) - 0.75)
    return tree_of((np.stack([8.0 * np.cos(angle), 8.0 * np.sin(angle), height], axis=1), TUBE_MM, -1))


def forked_tree(angle_deg: float = 60.0, radius: tuple[float, float] = (2.0, 1.3)) -> VesselTree:
    """Return a straight vessel of 40 mm along z whose branch of 20 mm leaves at (0, 0, 20) mm in the xz plane."""
    angle = np.deg2rad(angle_deg)
    along = np.linspace(0.0, 20.0, 41)
    fork = np.array([0.0, 0.0, 20.0])
    return tree_of(
        (np.outer(along, [0, 0, 1.0]), radius[0], -1),
        (fork + np.outer(along, [0, 0, 1.0]), radius[0], 0),
        (fork + np.outer(along, [np.sin(angle), 0, np.cos(angle)]), radius[1], 0),
    )


def moved(tree: VesselTree, rotation: Float[np.ndarray, "3 3"], shift_mm: Float[np.ndarray, "3"]) -> VesselTree:
    """Return a tree of tubes turned about the origin and then shifted."""
    return tree_of(
        *(
            (branch.centerline.points @ rotation.T + shift_mm, float(branch.centerline.radius[-1]), branch.parent)
            for branch in tree.branches
        )
    )


def tree_distance(tree: VesselTree, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Return the signed distance to the union of a tree's tubes of constant radius, positive inside, mm.

    The tubes end in half spheres. Outside the union, and inside it where its tubes do not overlap, it is exact for
    axes that are straight between their points.
    """
    asked = points.reshape(-1, 3)
    result = np.full(len(asked), -np.inf)
    for branch in tree.branches:
        line = branch.centerline
        np.maximum(result, line.radius[-1] - distance_to_line(line.points, asked), out=result)
    return result.reshape(points.shape[:-1])


def beyond_ends(tree: VesselTree, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Return how far points lie beyond the nearest flat cut through an end of the tree, mm; negative before it.

    Only points within 1.5 radii of an end's centre ask that end; all others get −inf.
    """
    asked = points.reshape(-1, 3)
    result = np.full(len(asked), -np.inf)
    first = tree.branches[0].centerline
    ends = [(first.points[0], first.points[0] - first.points[1], first.radius[0])]
    for leaf in tree.leaves():
        line = tree.branches[leaf].centerline
        ends.append((line.points[-1], line.points[-1] - line.points[-2], line.radius[-1]))
    for centre, outwards, radius in ends:
        relative = asked - centre
        near = np.linalg.norm(relative, axis=1) < 1.5 * radius
        result[near] = relative[near] @ (outwards / np.linalg.norm(outwards))
    return result.reshape(points.shape[:-1])


def cut_flat(tree: VesselTree) -> Distance:
    """Return the lumen of a tree of tubes whose ends are cut flat: positive inside, exact away from the cuts."""
    return lambda points: np.where(beyond_ends(tree, points) > 0, -1.0, tree_distance(tree, points))


def half_extent(tree: VesselTree, margin_mm: float = 2.0) -> tuple[float, float, float]:
    """Return half the edges of a box around the origin that holds a tree of tubes and a margin, mm."""
    reach = [np.abs(b.centerline.points).max(axis=0) + b.centerline.radius.max() + margin_mm for b in tree.branches]
    x, y, z = np.max(reach, axis=0)
    return float(x), float(y), float(z)


def distance_to_line(line: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the distance of points to a polyline, mm."""
    shares = max(1, round(float(np.linalg.norm(np.diff(line, axis=0), axis=1).max()) / 0.25))
    dense = np.concatenate([np.linspace(a, b, shares, endpoint=False) for a, b in itertools.pairwise(line)])
    nearest = np.asarray(KDTree(dense).query(points)[1]) // shares
    best = np.full(len(points), np.inf)
    for start in (np.maximum(nearest - 1, 0), nearest, np.minimum(nearest + 1, len(line) - 2)):
        along = line[start + 1] - line[start]
        relative = points - line[start]
        share = np.clip(np.einsum("ij,ij->i", relative, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
        np.minimum(best, np.linalg.norm(relative - share[:, None] * along, axis=1), out=best)
    return best
