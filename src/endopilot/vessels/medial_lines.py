"""The middle of a mask as a graph of single voxels, with every thin branch and tunnel: independent of the smooth wall
and the centerlines' grid, it is the yardstick of what these show and reach."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_erosion, distance_transform_edt, find_objects
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import KDTree

from endopilot.imaging.grid import connected_components
from endopilot.types import Volume
from endopilot.vessels.graph import RootedGraph, VesselGraph, lumen_graph

SMALLEST_PIECE = 12  # a piece of fewer voxels is noise
_NEIGHBOURS_APART = 1.8  # voxels that share a corner lie this near each other, in voxels

_NEAR_VOXELS, _MOSTLY_DEEP = 5.0, 0.5
"""A search for the nearest border takes long from voxels deeper than this. Where this share of them is, as in an aorta
of fine voxels (33 against 3 s), distances are swept over the whole box instead."""

_STUB_VOXELS, _SLENDER = 4.0, 1.5  # a side branch reaches so far out of its parent, in voxels and own radii


@dataclass(frozen=True, eq=False)
class MedialLines(VesselGraph):
    """The middle of a mask: a forest of widest ways, whose radius is the distance to the mask's border, costs lengths,
    mm.

    Attributes:
        index: voxel indices (z, y, x).
        closing: edges that are left out, of every loop one at its narrowest place.
        edges_mm: edges of the voxels along their own axes (z, y, x), mm.
    """

    columns = ("points", "radius", "index")
    index: Int[np.ndarray, "n 3"]
    closing: Int[np.ndarray, "k 2"]
    edges_mm: Float[np.ndarray, "3"]

    @cached_property
    def local(self) -> Float[np.ndarray, "n 3"]:
        """Positions along the mask's own axes (z, y, x), mm."""
        return self.index * self.edges_mm

    @cached_property
    def tree(self) -> RootedGraph:
        """The ways from each piece's widest place."""
        order = np.lexsort((-self.radius, self.pieces))
        return self.shortest(order[np.unique(self.pieces[order], return_index=True)[1]])

    @cached_property
    def behind_mm(self) -> Float[np.ndarray, "n"]:
        """Length of all at and beyond each point, as seen from the widest place, mm."""
        behind, before = self.share_mm.copy(), self.tree.before
        for node in np.argsort(-self.tree.length):
            if before[node] >= 0:
                behind[before[node]] += behind[node]
        return behind

    def within(self, kept: Bool[np.ndarray, "n"], corner: Int[np.ndarray, "3"]) -> MedialLines:
        """Return some of the points with what joins them, in a mask that begins at the voxel `corner` of this one."""
        closing = (np.cumsum(kept) - 1)[self.closing[kept[self.closing].all(axis=1)]]
        part = self.part(kept)
        return replace(part, closing=closing, index=part.index - corner)


def _lines(
    mask: Volume,
    index: Int[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    edges: Int[np.ndarray, "m 2"],
    closing: Int[np.ndarray, "k 2"],
) -> MedialLines:
    points = mask.index_to_world(index[:, ::-1].astype(float))
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    costs = csr_matrix((lengths, edges.T), shape=(len(points),) * 2)
    steps = mask.spacing_mm[::-1]
    return MedialLines(points, radius, costs, float(steps.max()), index, closing, steps)


@lru_cache(maxsize=2)
def piece_labels(mask: Volume) -> Int[np.ndarray, "nz ny nx"]:
    """Return the number of the connected piece of a mask that each voxel lies in, 0 outside; kept for later stages."""
    return connected_components(mask.voxels, corners=True)


def thinned_lines(mask: Volume) -> MedialLines:
    """Return the middle of a mask by Lee's thinning (CVGIP 56:462, 1994): all tunnels, but not all ends."""
    voxels = np.asarray(mask.voxels, dtype=bool)
    labels = piece_labels(mask)
    found = [np.empty((0, 3), int)]
    for number, box in enumerate(find_objects(labels), start=1):
        found.append(_thinned_piece(*_packed(labels[box] == number)) + [part.start for part in box])
    index = np.concatenate(found)
    clearance = _clearance(voxels, index, mask.spacing_mm)
    pairs = KDTree(index).query_pairs(_NEIGHBOURS_APART, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    apart = np.linalg.norm(index[pairs[:, 0]] - index[pairs[:, 1]], axis=1)
    return _lines(mask, index, clearance, *_widest_forest(pairs, clearance, apart))


def traced_lines(mask: Volume) -> MedialLines:
    """Return the middle of a mask as paths between the ends of each piece: every end, but no tunnel."""
    labels = piece_labels(mask)
    index, clearance, edges = [np.empty((0, 3), int)], [np.empty(0)], [np.empty((0, 2), int)]
    for number, box in enumerate(find_objects(labels), start=1):
        own = np.pad(labels[box] == number, 1)
        corner = np.array([part.start for part in box]) - 1
        nodes, width, pairs = _traced_piece(*_packed(own), tuple(mask.spacing_mm.tolist()))
        edges.append(pairs + sum(len(part) for part in index))
        index.append(nodes + corner)
        clearance.append(width)
    joined = np.concatenate(edges)
    return _lines(mask, np.concatenate(index), np.concatenate(clearance), joined, joined[:0])


def _packed(voxels: Bool[np.ndarray, "nz ny nx"]) -> tuple[bytes, tuple[int, ...]]:
    """Return voxels as bits with their shape: a piece that a cut elsewhere left alone is known again by them."""
    return np.packbits(voxels).tobytes(), voxels.shape


def _unpacked(bits: bytes, shape: tuple[int, ...]) -> Bool[np.ndarray, "nz ny nx"]:
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=math.prod(shape)).reshape(shape).astype(bool)


@lru_cache(maxsize=8)
def _thinned_piece(bits: bytes, shape: tuple[int, ...]) -> Int[np.ndarray, "n 3"]:
    from skimage.morphology import skeletonize

    return np.argwhere(skeletonize(_unpacked(bits, shape), method="lee"))


@lru_cache(maxsize=8)
def _traced_piece(
    bits: bytes, shape: tuple[int, ...], steps_mm: tuple[float, float, float]
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n"], Int[np.ndarray, "m 2"]]:
    """Return the voxels of the middle of one piece, their clearance, mm, and their edges."""
    voxels, edges_mm = _unpacked(bits, shape), np.array(steps_mm)
    index = np.argwhere(voxels)
    clearance = _clearance(voxels, index, edges_mm)
    if len(index) < SMALLEST_PIECE:
        return index[:1], clearance[:1], np.empty((0, 2), int)
    graph = lumen_graph(index[:, ::-1] * edges_mm, clearance, edges_mm)
    paths = graph.traced(_STUB_VOXELS * float(edges_mm.max()), slenderness=_SLENDER)
    places = np.rint(graph.points / edges_mm).astype(int)[:, ::-1]
    nodes: list[int] = []
    pairs: list[tuple[int, int]] = []
    for path in paths:
        # Where a vessel is an even number of voxels wide, two paths may run side by side: they are one from there.
        start, joint = 0, -1
        if nodes:
            gap, nearest = map(np.asarray, KDTree(places[nodes]).query(places[path]))
            start = int(np.flatnonzero(gap < _NEIGHBOURS_APART)[-1])
            joint = int(nearest[start])
            start += int(gap[start] == 0)
        new = range(len(nodes), len(nodes) + len(path) - start)
        pairs += itertools.pairwise(new if joint < 0 else [joint, *new])
        nodes += path[start:].tolist()
    return places[nodes], graph.radius[nodes], np.array(pairs, dtype=int).reshape(-1, 2)


def _clearance(
    voxels: Bool[np.ndarray, "nz ny nx"], index: Int[np.ndarray, "n 3"], edges_mm: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    border, edges = voxels & ~np.asarray(binary_erosion(voxels), dtype=bool), edges_mm[::-1]
    tree, places = KDTree(np.argwhere(border) * edges), index * edges
    gap = np.asarray(tree.query(places, distance_upper_bound=_NEAR_VOXELS * float(edges.max()))[0])
    deep = np.isinf(gap)
    if deep.sum() > _MOSTLY_DEEP * len(index):
        gap = np.asarray(distance_transform_edt(~border, sampling=edges))[tuple(index.T)]
    elif deep.any():
        gap[deep] = tree.query(places[deep])[0]
    return gap + 0.5 * float(edges.min())


def _widest_forest(
    pairs: Int[np.ndarray, "m 2"], clearance: Float[np.ndarray, "n"], apart: Float[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "k 2"]]:
    """Return the forest whose paths are as wide as they can be, and the edges that would close a loop."""
    # Of equally wide edges the shorter is kept, so that the corners of the voxels' steps are not cut.
    cost = 1.0 + clearance.max(initial=0.0) - clearance[pairs].min(axis=1) + 1e-3 * apart
    costs = csr_matrix((cost, pairs.T), shape=(len(clearance),) * 2)
    tree = minimum_spanning_tree(costs).tocoo()
    kept = np.isin(pairs[:, 0] * len(clearance) + pairs[:, 1], tree.row.astype(np.int64) * len(clearance) + tree.col)
    return pairs[kept], pairs[~kept]
