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

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.tree import tangents
from endopilot.types import Insertion, TipProjection, VesselTree

Found = tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n"]]
"""Abscissa, offset, branch and radius."""

_CHUNK = 8192
"""Points that are projected at once: their intermediate results stay in the processor's cache."""

_TAPER = 1.25
"""A branch is at most this many times wider where a point is projected to than where it is nearest to a vertex."""

_WALK = 4
"""Vertices are corrected at most this often, by the point's distance to the vertex's plane."""


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
    return TipProjector(tree, insertion)(points)


class TipProjector:
    """`project_tip` for one vessel, prepared once: for callers that project a few tips at a time, again and again."""

    def __init__(self, tree: VesselTree, insertion: Insertion) -> None:
        """Prepare the segments of a tree.

        Args:
            tree: centerlines.
            insertion: the ostium and the catheter's axis.
        """
        self._slabs = _Slabs.of(tree, insertion)
        self._catheter = _Catheter(insertion, float(tree.branches[0].centerline.radius[0]))

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> TipProjection:
        """Project tips (LPS mm) as `project_tip` does, to the same bits."""
        shape = points.shape[:-1]
        # an array a coordinate, so that the processor adds several at once
        flat = np.ascontiguousarray(points.reshape(-1, 3).T, dtype=float)
        parts = [
            self._catheter.take(part, self._slabs.project(part))
            for part in (flat[:, start : start + _CHUNK] for start in range(0, max(flat.shape[1], 1), _CHUNK))
        ]
        fields = parts[0] if len(parts) == 1 else (np.concatenate(values) for values in zip(*parts, strict=True))
        abscissa, offset, branch, radius = (values.reshape(shape) for values in fields)
        return TipProjection(abscissa=abscissa, offset=offset, branch=branch, radius=radius)


@dataclass(frozen=True, eq=False)
class _Slabs:
    """All segments of a tree with what their projection needs, one row a vertex; the last of a branch repeats the one
    before, so that every vertex has a segment.

    Attributes:
        vertices: positions of the vertices and their tangents over the length of the segment, (6, m).
        segments: start and edge; tangent at the start and its change along the segment, by turns; edge·tangent and
            edge·change; abscissa and radius, and their changes: (18, m).
        first, last: of every vertex, the first and the last one of its branch.
        behind: of every vertex, the one before it in its branch.
        branch: of every vertex, its branch.
        rival: (m, branches), how far a point must lie from this, its nearest vertex, to lie deeper in another branch,
            mm.
        soonest: the least of `rival`.
        entry: (m, branches), the branch's vertex that is nearest to this one.
        places: the vertices, to search.
    """

    vertices: Float[np.ndarray, "6 m"]
    segments: Float[np.ndarray, "18 m"]
    first: Int[np.ndarray, "m"]
    last: Int[np.ndarray, "m"]
    behind: Int[np.ndarray, "m"]
    branch: Int[np.ndarray, "m"]
    rival: Float[np.ndarray, "m b"]
    soonest: Float[np.ndarray, "m"]
    entry: Int[np.ndarray, "m b"]
    places: KDTree

    @classmethod
    def of(cls, tree: VesselTree, insertion: Insertion) -> _Slabs:
        lines = [branch.centerline for branch in tree.branches]
        counts = np.array([len(line.points) for line in lines])
        last = np.cumsum(counts) - 1
        first = last - counts + 1
        points, radius, abscissa = (
            np.concatenate([getattr(line, name) for line in lines]) for name in ("points", "radius", "abscissa")
        )
        tangent = np.concatenate(_shared_tangents(tree, insertion))
        owner = np.repeat(np.arange(len(lines)), counts)
        start = np.arange(len(points))
        start[last] = np.maximum(last - 1, first)
        end = np.minimum(start + 1, last[owner])
        edge, change = points[end] - points[start], tangent[end] - tangent[start]
        spacing = np.maximum(np.linalg.norm(edge, axis=1), 1e-9)
        products = [np.einsum("ij,ij->i", edge, other) for other in (tangent[start], change)]
        turning = np.stack([tangent[start], change], axis=-1).reshape(-1, 6)
        scalars = [abscissa[start], radius[start], abscissa[end] - abscissa[start], radius[end] - radius[start]]
        segments = np.column_stack([points[start], edge, turning, *products, *scalars])
        rival = np.full((len(points), len(lines)), np.inf)
        entry = np.zeros((len(points), len(lines)), dtype=np.int64)
        for index, line in enumerate(lines):
            distance, nearest = (np.asarray(found) for found in KDTree(line.points).query(points))
            entry[:, index] = first[index] + nearest
            # To win, offset < |p − v|·R is needed, with R the ratio of radii; and distance ≤ |p − v| + offset.
            ratio = _TAPER * line.radius[nearest] / radius
            wider = (ratio > 1.0) | (distance < 2.0 * spacing)  # the nearest line loses only to a wider one
            rival[wider & (owner != index), index] = ((distance - spacing) / (1.0 + ratio))[wider & (owner != index)]
        index = np.arange(len(points))
        return cls(
            vertices=np.ascontiguousarray(np.column_stack([points, tangent / spacing[:, None]]).T),
            segments=np.ascontiguousarray(segments.T),
            first=first[owner],
            last=last[owner],
            behind=np.maximum(index - 1, first[owner]),
            branch=owner,
            rival=rival,
            soonest=rival.min(axis=1),
            entry=entry,
            places=KDTree(points),
        )

    def project(self, points: Float[np.ndarray, "3 n"]) -> Found:
        """Project points onto the branches whose lumens they lie deepest in."""
        distance, nearest = (np.asarray(found) for found in self.places.query(points.T))
        branch = self.branch[nearest]
        abscissa, offset, radius = self._onto(points, nearest)
        doubtful = np.flatnonzero(self.soonest[nearest] < distance)
        if len(doubtful) == 0:
            return abscissa, offset, branch, radius
        row, rival = np.nonzero(self.rival[nearest[doubtful]] < distance[doubtful, None])
        contested = doubtful[row]
        asked = np.take(points, contested, axis=1)
        found = self._onto(asked, self._walked(asked, self.entry[nearest[contested], rival]))
        better = np.flatnonzero(found[1] * radius[contested] < offset[contested] * found[2])
        # of a point's rivals the best comes last, and stays
        best = better[np.argsort(found[1][better] / found[2][better], kind="stable")[::-1]]
        chosen = contested[best]
        abscissa[chosen], offset[chosen], radius[chosen] = (value[best] for value in found)
        branch[chosen] = rival[best]
        return abscissa, offset, branch, radius

    def _walked(self, points: Float[np.ndarray, "3 n"], vertex: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        """Walk along a branch from a vertex to the one that is nearest to each point."""
        first, last = self.first[vertex], self.last[vertex]
        for _ in range(_WALK):
            step = np.rint(self._ahead(points, vertex)).astype(np.int64)
            moved = np.minimum(np.maximum(vertex + step, first), last)
            if np.array_equal(moved, vertex):
                break
            vertex = moved
        return vertex

    def _ahead(self, points: Float[np.ndarray, "3 n"], vertex: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return how far points lie before the planes of vertices, in segments."""
        row = np.take(self.vertices, vertex, axis=1, mode="clip")
        return _dot(points - row[:3], row[3:])

    def _onto(
        self, points: Float[np.ndarray, "3 n"], vertex: Int[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Project points onto the segment before or behind a vertex, by the side of its plane that they lie on.

        With q = p − a, edge e, tangent T at a and its change D, the share u solves (q − ue)·(T + uD) = 0:
        q·T − u(e·T − q·D) − u² e·D = 0, of whose roots the one that stays finite as D vanishes is wanted.
        """
        segment = np.where(self._ahead(points, vertex) < 0, self.behind[vertex], vertex)
        row = np.take(self.segments, segment, axis=1, mode="clip")
        relative = points - row[:3]
        depth, turn = _dot(relative[:, None], row[6:12].reshape(3, 2, -1))
        slope = row[12] - turn
        root = np.sqrt(np.maximum(slope * slope + 4.0 * row[13] * depth, 0.0))
        share = 2.0 * depth / np.maximum(slope + root, 1e-12)
        np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
        relative -= share * row[3:6]
        abscissa, radius = row[14:16] + share * row[16:]
        return abscissa, np.sqrt(_dot(relative, relative)), radius


def _dot(one: Float[np.ndarray, "3 *#n"], other: Float[np.ndarray, "3 *#n"]) -> Float[np.ndarray, "*#n"]:
    x, y, z = one * other
    return x + y + z


@dataclass(frozen=True, eq=False)
class _Catheter:
    """The catheter's lumen behind the ostium.

    Attributes:
        insertion: the ostium and the catheter's axis.
        radius: at the ostium, mm.
    """

    insertion: Insertion
    radius: float

    def take(self, points: Float[np.ndarray, "3 n"], found: Found) -> Found:
        """Give points behind the ostium to the catheter's axis, where its lumen holds them better than the vessel's."""
        abscissa, offset, branch, radius = found
        relative = points - self.insertion.position[:, None]
        depth = _dot(relative, self.insertion.direction[:, None])
        behind = np.flatnonzero(depth < 0)
        if len(behind) == 0:
            return found
        depth = depth[behind]
        across = relative[:, behind] - depth * self.insertion.direction[:, None]
        distance = np.sqrt(_dot(across, across))
        chosen = distance * radius[behind] <= offset[behind] * self.radius
        abscissa[behind[chosen]] = depth[chosen]
        offset[behind[chosen]] = distance[chosen]
        branch[behind[chosen]] = 0
        radius[behind[chosen]] = self.radius
        return abscissa, offset, branch, radius


def _shared_tangents(tree: VesselTree, insertion: Insertion) -> list[Float[np.ndarray, "n 3"]]:
    """Return the tangents at all vertices; a branch and the child that carries it on share that at the joint.

    So do the catheter and the first branch: the plane through the ostium stands across the catheter's axis.
    """
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
