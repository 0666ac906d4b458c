"""Where a tip lies with respect to the centerline tree: Δtip, γtip, the branch and the lumen's radius there.

A tip belongs to the branch whose lumen it lies deepest in: the one with the least offset over radius. Only where two
branches come near each other does that differ from the nearest centerline, so the nearest one is found first, for all
points at once, and the others are looked at for the few points that are contested.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from endopilot.types import Centerline, Insertion, TipProjection, VesselTree

Candidate = tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]
"""Abscissa, offset and radius of the projections onto one line."""


def project_tip(tree: VesselTree, insertion: Insertion, points: Float[np.ndarray, "*n 3"]) -> TipProjection:
    """Project tips onto the centerline tree.

    Along a motion inside one branch, abscissa and offset are continuous; from one branch into another the abscissa
    may step by no more than the shortcut that the tip takes across the bifurcation. Behind the ostium the line goes
    on along the catheter's axis, with negative abscissa and the radius at the ostium.

    Args:
        tree: centerlines.
        insertion: the ostium and the catheter's axis.
        points: tip positions, LPS mm.
    """
    shape = points.shape[:-1]
    flat = np.ascontiguousarray(points.reshape(-1, 3), dtype=float)
    abscissa, offset, branch, radius = _project(tree, insertion, flat)
    return TipProjection(
        abscissa=abscissa.reshape(shape),
        offset=offset.reshape(shape),
        branch=branch.reshape(shape),
        radius=radius.reshape(shape),
    )


def _project(
    tree: VesselTree, insertion: Insertion, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    lines = [branch.centerline for branch in tree.branches]
    first = np.concatenate([[0], np.cumsum([len(line.points) for line in lines])])
    everything = Centerline(*(np.concatenate([getattr(line, name) for line in lines]) for name in _FIELDS))
    owner = np.repeat(np.arange(len(lines)), np.diff(first))
    nearest = np.asarray(KDTree(everything.points).query(points)[1])
    branch = owner[nearest]
    abscissa, offset, radius = _onto_polyline(everything, first[branch], first[branch + 1] - 1, nearest, points)
    contested = _contested(lines, everything, owner)[nearest]
    for index in np.unique(owner) if contested.any() else ():
        others = np.flatnonzero(contested & (branch != index))
        others = others[_near_box(lines[index], points[others])]
        if len(others) == 0:
            continue
        line, asked = lines[index], points[others]
        start = np.asarray(KDTree(line.points).query(asked)[1])
        zero = np.zeros(len(others), dtype=int)
        candidate = _onto_polyline(line, zero, zero + len(line.points) - 1, start, asked)
        better = candidate[1] * radius[others] < offset[others] * candidate[2]
        chosen = others[better]
        abscissa[chosen], offset[chosen], radius[chosen] = (value[better] for value in candidate)
        branch[chosen] = index
    return _behind_ostium(insertion, float(lines[0].radius[0]), points, (abscissa, offset, branch, radius))


_FIELDS = ("points", "radius", "abscissa", "normals")


def _onto_polyline(
    line: Centerline,
    first: Int[np.ndarray, "n"],
    last: Int[np.ndarray, "n"],
    nearest: Int[np.ndarray, "n"],
    points: Float[np.ndarray, "n 3"],
) -> Candidate:
    """Project points onto the two segments that meet at their nearest vertex, and keep the nearer projection."""
    best: Candidate | None = None
    for start in (np.maximum(nearest - 1, first), np.minimum(nearest, np.maximum(last - 1, first))):
        end = np.minimum(start + 1, last)
        origin = line.points[start]
        along = line.points[end] - origin
        relative = points - origin
        square = np.einsum("ij,ij->i", along, along)
        share = np.clip(np.einsum("ij,ij->i", relative, along) / np.maximum(square, 1e-24), 0.0, 1.0)
        relative -= share[:, None] * along
        offset = np.sqrt(np.einsum("ij,ij->i", relative, relative))
        abscissa = line.abscissa[start] + share * (line.abscissa[end] - line.abscissa[start])
        radius = line.radius[start] + share * (line.radius[end] - line.radius[start])
        if best is None:
            best = (abscissa, offset, radius)
        else:
            nearer = offset < best[1]
            best = (
                np.where(nearer, abscissa, best[0]),
                np.where(nearer, offset, best[1]),
                np.where(nearer, radius, best[2]),
            )
    assert best is not None
    return best


def _contested(lines: list[Centerline], everything: Centerline, owner: Int[np.ndarray, "n"]) -> np.ndarray:
    """Return for every centerline point whether another branch's lumen reaches near it."""
    contested = np.zeros(len(everything.points), dtype=bool)
    if len(lines) == 1:
        return contested
    for index, line in enumerate(lines):
        foreign = np.flatnonzero(owner != index)
        distance, start = KDTree(line.points).query(everything.points[foreign])
        contested[foreign] |= distance < 1.5 * (everything.radius[foreign] + line.radius[start])
    return contested


def _near_box(line: Centerline, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Return which points lie in the box around a line's lumen: outside it, offset over radius exceeds one."""
    margin = 1.5 * line.radius[:, None]
    inside = (points >= (line.points - margin).min(axis=0)) & (points <= (line.points + margin).max(axis=0))
    return inside.all(axis=1)


def _behind_ostium(
    insertion: Insertion,
    ostium_radius: float,
    points: Float[np.ndarray, "n 3"],
    found: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n"]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Give points behind the ostium to the catheter's axis, where its lumen holds them better than the vessel's."""
    abscissa, offset, branch, radius = found
    relative = points - insertion.position
    depth = relative @ insertion.direction
    behind = np.flatnonzero(depth < 0)
    across = relative[behind] - depth[behind, None] * insertion.direction
    distance = np.linalg.norm(across, axis=1)
    chosen = behind[distance * radius[behind] <= offset[behind] * ostium_radius]
    abscissa[chosen] = depth[chosen]
    offset[chosen] = np.linalg.norm(relative[chosen] - depth[chosen, None] * insertion.direction, axis=1)
    branch[chosen] = 0
    radius[chosen] = ostium_radius
    return abscissa, offset, branch, radius
