"""Where a tip lies with respect to the centerline tree: Δtip, γtip, the branch and the lumen's radius there.

A centerline is a polyline, and the nearest place on a polyline jumps: on the inner side of every corner two segments
compete, on the outer side the corner alone is nearest. Therefore a tip is projected along planes instead: at each
vertex the plane across the line's tangent, between two vertices the plane across the tangent that turns linearly from
one to the other. Neighbouring segments share a plane, so the abscissa moves continuously, and faithfully to the smooth
curve that the polyline samples, wherever the planes do not cross: nearer the line than its radius of curvature.

A tip belongs to the branch whose lumen it lies deepest in: the one with the least offset over radius. Only where two
branches come near each other does that differ from the nearest centerline, so the nearest one is found first, and the
others are looked at for the few points that are contested.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from endopilot import _core
from endopilot.anatomy.tree import tangents
from endopilot.types import Insertion, TipProjection, VesselTree

_TAPER = 1.25  # a branch is at most this much wider where a point projects to than at the nearest vertex


def project_tip(tree: VesselTree, insertion: Insertion, points: Float[np.ndarray, "*n 3"]) -> TipProjection:
    """Project tips (LPS mm) onto the centerline tree, continuously inside a branch; into another one the abscissa steps
    by no more than the tip's shortcut. Behind the ostium the line goes on along the catheter's axis, with negative
    abscissa and the ostium's radius."""
    return TipProjector(tree, insertion)(points)


class TipProjector:
    """`project_tip` for one vessel, prepared once: for callers that project a few tips at a time, again and again."""

    def __init__(self, tree: VesselTree, insertion: Insertion) -> None:
        """Prepare the segments of a tree."""
        lines = [branch.centerline for branch in tree.branches]
        whole = tree.line
        points = whole.points
        self._places = KDTree(points)
        counts = np.array([len(line.points) for line in lines])
        branch = np.repeat(np.arange(len(lines)), counts)
        last = np.cumsum(counts) - 1
        first = last - counts + 1
        rival, entry = _rivals(tree, points, first, branch)
        self._core = _core.make_projector(
            point=points,
            tangent=np.concatenate(_shared_tangents(tree, insertion)),
            abscissa=whole.abscissa,
            radius=whole.radius,
            first=first[branch],
            last=last[branch],
            branch=branch,
            rival=rival,
            entry=entry,
            ostium=np.asarray(insertion.position, dtype=float),
            axis=np.asarray(insertion.direction, dtype=float),
            catheter_radius=float(lines[0].radius[0]),
        )

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> TipProjection:
        """Project tips (LPS mm) as `project_tip` does, to the same bits."""
        flat = np.ascontiguousarray(points.reshape(-1, 3), dtype=float)
        distance, nearest = (np.asarray(found) for found in self._places.query(flat))
        found = self._core.project(flat, nearest, distance)
        abscissa, offset, branch, radius = (values.reshape(points.shape[:-1]) for values in found)
        branch = branch.view(np.int64)  # the core's type is C's long long, another one of as many bits
        return TipProjection(abscissa=abscissa, offset=offset, branch=branch, radius=radius)


def _rivals(
    tree: VesselTree, points: Float[np.ndarray, "m 3"], first: Int[np.ndarray, "b"], owner: Int[np.ndarray, "m"]
) -> tuple[Float[np.ndarray, "m b"], Int[np.ndarray, "m b"]]:
    """Return for each nearest vertex how far off a point must lie to lie deeper in each other branch, mm, and that
    branch's nearest vertex. `first` and `owner` are each branch's first vertex and each vertex's branch."""
    lines = [branch.centerline for branch in tree.branches]
    spacing = np.concatenate([_spacing(line.points) for line in lines])
    rival = np.full((len(points), len(lines)), np.inf)
    entry = np.zeros((len(points), len(lines)), dtype=np.int64)
    for index, line in enumerate(lines):
        distance, nearest = (np.asarray(found) for found in KDTree(line.points).query(points))
        entry[:, index] = first[index] + nearest
        # To win, offset < |p − v|·R is needed, with R the ratio of radii; and distance ≤ |p − v| + offset.
        ratio = _TAPER * line.radius[nearest] / tree.line.radius
        wider = (ratio > 1.0) | (distance < 2.0 * spacing)  # the nearest line loses only to a wider one
        rival[wider & (owner != index), index] = ((distance - spacing) / (1.0 + ratio))[wider & (owner != index)]
    return rival, entry


def _spacing(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    if len(points) == 1:
        return np.full(1, 1e-9)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.maximum(np.append(lengths, lengths[-1]), 1e-9)


def _shared_tangents(tree: VesselTree, insertion: Insertion) -> list[Float[np.ndarray, "n 3"]]:
    """Return tangents at all vertices, shared at joints: so the ostium's plane stands across the catheter's axis."""
    result = [tangents(branch.centerline.points) for branch in tree.branches]
    for index in range(len(result)):
        children = [i for i in tree.children(index) if len(result[i]) > 1]
        if children:
            onwards = max(children, key=lambda child: float(result[child][0] @ result[index][-1]))
            mean = result[index][-1] + result[onwards][0]
            mean /= max(float(np.linalg.norm(mean)), 1e-9)
            result[index][-1] = result[onwards][0] = mean
    if result[0][0] @ insertion.direction > 0.5:
        result[0][0] = insertion.direction
    return result


Samples = Float[np.ndarray, "*n"]


def safety_ratio(offset: Samples, radius: Samples, wire_radius_mm: float) -> Samples:
    """Return γ/(r − r_w), mm: 0 on the centerline, 1 where the wire touches a round lumen's wall, or the lumen is no
    wider than the wire; NaN stays NaN. With r_w = 0 it is the paper's ratio γ/r."""
    room = radius - wire_radius_mm
    filled = room <= 0
    return np.where(filled & ~np.isnan(offset), 1.0, offset / np.where(filled, 1.0, room))
