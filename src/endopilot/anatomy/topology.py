"""Loops and contacts of a mask: a tree holds neither, so they are cut where they are narrowest, and stated.

The middle of a mask (`medial_lines`) closes a loop for every tunnel through it. A loop whose narrowest place is much
thinner than the vessel is one that touches itself, a hairpin for instance; any other is a loop of the vessel, such as a
bypass. Two vessels that run past each other and touch in between, without a loop, are joined by a short and thin bridge
that leaves both from the side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from endopilot.anatomy.medial_lines import MedialLines, thinned_lines, traced_lines
from endopilot.anatomy.parent_vessel import AORTA_RADIUS_MM
from endopilot.errors import place_text
from endopilot.types import Volume

CONTACT = 0.6
"""A place whose clearance is less than this share of the vessels' on both sides is a contact, not a stenosis."""

SHORTEST_LOOP_MM = 20.0
"""Loops from this length are cut. In shorter ones two branches touch again just behind their fork, or a wall has a
hole: which way a line takes hardly matters."""

SHORTEST_TUNNEL_MM = 6.0
"""Tunnels shorter than this, or no longer than round the vessel itself, are rough voxels."""

_SLIT_VOXELS = 3.0
"""So are those whose opposite sides come as near each other as this, in voxels."""

_SAME_PLACE_MM = 5.0
_SIDE_BY_SIDE_MM = 3.0

_BRIDGE = 1.5
"""A bridge between two vessels that touch is no longer than this many times both their radii and a slit."""

_THROUGH = -0.6
"""Cosine of the smallest angle between a vessel's two directions where it runs past a contact."""

_THICK_VOXELS = 1.0
_ARM_RADII = 4.0
_ROUNDS = 4
_MOST_CUTS = 8
"""A lumen that closes on itself in more places is no tree that touches itself: so are the lumens of a dissection, with
the tears between them. It is left as it is."""


@dataclass(frozen=True, eq=False)
class _Cut:
    """A place where a mask is cut: two neighbouring points of its middle."""

    ends: tuple[int, int]
    kind: Literal["contact", "loop", "bridge"]
    place: Float[np.ndarray, "3"]
    around_mm: float


def parted(mask: Volume) -> tuple[Volume, list[str]]:
    """Return the mask without loops and contacts, each cut at its narrowest place, and remarks on them.

    A lumen that has more than a few of them is returned as it is.
    """
    whole, done = mask, list[_Cut]()
    holes: list[_Cut] = []
    sides: list[str] = []
    for _ in range(_ROUNDS):
        lines = thinned_lines(mask)
        loops = _loops(lines, mask)
        cuts = [loop for loop in loops if loop.around_mm >= SHORTEST_LOOP_MM]
        holes = holes if done else [loop for loop in loops if loop.around_mm < SHORTEST_LOOP_MM]
        if not cuts:
            lines = traced_lines(mask)
            cuts = _contacts(lines, mask)
        if not cuts:
            mask, sides = _without_sides(mask, lines)
            break
        if len(places := _apart(done + cuts)) > _MOST_CUTS:
            return whole, [_porous(places)]
        voxels = mask.voxels.copy()
        for cut in cuts:
            _sever(voxels, lines, cut.ends)
        mask = replace(mask, voxels=voxels)
        done += cuts
    return mask, _remarks(done, holes) + sides


def _apart(cuts: list[_Cut]) -> list[_Cut]:
    """Return those of some cuts that lie at places of their own, that of the longest loop first."""
    found: list[_Cut] = []
    for cut in sorted(cuts, key=lambda cut: -cut.around_mm):
        if all(np.linalg.norm(cut.place - other.place) >= _SAME_PLACE_MM for other in found):
            found.append(cut)
    return found


def _porous(cuts: list[_Cut]) -> str:
    """Say that a lumen closes on itself in many places."""
    return (
        f"the lumen closes on itself in {len(cuts)} places or more, as those of a dissection do at tears: they are "
        f"left open, and the tree takes one way round each; the longest ring has {cuts[0].around_mm:.0f} mm, at "
        f"{place_text(cuts[0].place)}"
    )


def _remarks(cuts: list[_Cut], holes: list[_Cut]) -> list[str]:
    """Say where a mask was cut, one remark for each kind."""
    words = {
        "contact": ("the vessel touches itself and was parted at", " ({:.0f} mm of vessel between the two sides)"),
        "loop": ("a tree holds no loops: cut at the narrowest place", " (loop of {:.0f} mm)"),
        "bridge": ("two vessels touch and were parted at", ""),
    }
    remarks = []
    for kind, (text, size) in words.items():
        cut_here = _apart([cut for cut in cuts if cut.kind == kind])
        places = [place_text(cut.place) + size.format(cut.around_mm) for cut in cut_here]
        if places:
            remarks.append(f"{text} {', '.join(places)}")
    if holes:
        largest = max(holes, key=lambda hole: hole.around_mm)
        remarks.append(
            f"{len(holes)} small tunnels were left as they are, the largest of {largest.around_mm:.0f} mm around at "
            f"{place_text(largest.place)}"
        )
    return remarks


def _loops(lines: MedialLines, mask: Volume) -> list[_Cut]:
    """Return a cut for every loop of the vessel's middle."""
    cuts = []
    for start, end in lines.closing:
        loop = lines.way(int(end), int(start))
        around = float(np.cumsum(lines.lengths(np.column_stack([loop[:0:-1], loop[-2::-1]])))[-1])
        clearance = lines.clearance[loop]
        across = np.linalg.norm(lines.points[loop] - np.roll(lines.points[loop], len(loop) // 2, axis=0), axis=1)
        slit = across.min() < _SLIT_VOXELS * mask.spacing_mm.max()
        if slit or around < max(SHORTEST_TUNNEL_MM, 2 * np.pi * float(np.quantile(clearance, 0.9))):
            continue
        contact = float(lines.clearance[[start, end]].min()) < CONTACT * float(np.median(clearance))
        place = lines.points[[start, end]].mean(axis=0)
        cuts.append(_Cut((int(start), int(end)), "contact" if contact else "loop", place, around))
    return cuts


def _contacts(lines: MedialLines, mask: Volume) -> list[_Cut]:
    """Return a cut for every short and thin bridge between two vessels that run past each other."""
    ways: list[list[int]] = [[] for _ in lines.points]
    for one, two in lines.edges:
        ways[one].append(int(two))
        ways[two].append(int(one))
    thin = [i for i in np.argsort(lines.clearance) if len(ways[i]) == 2]
    done = np.zeros(len(lines.points), dtype=bool)
    cuts = []
    for node in thin:
        if done[node]:
            continue
        sides = [_crossing(ways, int(node), first) for first in ways[node]]
        if any(side is None for side in sides):
            continue
        (one, path_one), (two, path_two) = sides  # pyright: ignore[reportGeneralTypeIssues, reportOptionalIterable]
        done[[*path_one, *path_two]] = True
        radius = lines.clearance[[one, two]]
        gap = float(np.linalg.norm(lines.points[one] - lines.points[two]))
        reach = _BRIDGE * radius.sum() + _SLIT_VOXELS * mask.spacing_mm.max()
        thick = radius.min() > _THICK_VOXELS * mask.spacing_mm.max()
        thin_and_short = lines.clearance[node] < CONTACT * radius.min() and gap < reach
        past = thick and thin_and_short and _runs_past(lines, ways, one, path_one)
        if past and _runs_past(lines, ways, two, path_two):
            cuts.append(_Cut((int(node), path_two[0]), "bridge", lines.points[node], 0.0))
    return cuts


def _without_sides(mask: Volume, lines: MedialLines) -> tuple[Volume, list[str]]:
    """Return the mask with parts that lie far from each other along the vessel parted where they touch over a length.

    Each voxel belongs to the nearest point of the middle; neighbours that belong to distant points are emptied.
    """
    if lines.clearance.max(initial=0.0) > AORTA_RADIUS_MM:  # a branch's first part lies inside the aorta's own middle
        return mask, []
    voxel = float(mask.spacing_mm.max())
    pairs = KDTree(lines.points).query_pairs(2.0 * float(lines.clearance.max()) + voxel, output_type="ndarray")
    gap = np.linalg.norm(lines.points[pairs[:, 0]] - lines.points[pairs[:, 1]], axis=1)
    pairs = pairs[gap < lines.clearance[pairs].sum(axis=1) + voxel]
    sources, own = np.unique(pairs[:, 0], return_inverse=True)
    if len(sources) == 0:
        return mask, []
    along = np.asarray(dijkstra(lines.forest, indices=sources, limit=SHORTEST_LOOP_MM))
    far = pairs[np.isinf(along[own.reshape(-1), pairs[:, 1]])]
    touching = np.unique(far)
    index = np.argwhere(mask.voxels)
    home = np.full(np.array(mask.voxels.shape) + 2, -1)
    local = KDTree(lines.index * mask.spacing_mm[::-1])
    home[tuple((index + 1).T)] = local.query(index * mask.spacing_mm[::-1])[1]
    number = np.full(len(lines.points), -1)
    number[touching] = np.arange(len(touching))
    distant = np.isinf(np.asarray(dijkstra(lines.forest, indices=touching, limit=SHORTEST_LOOP_MM)))
    rim = np.zeros(len(index), dtype=bool)
    own = home[tuple((index + 1).T)]
    asked = np.flatnonzero(number[own] >= 0) if len(touching) else np.empty(0, int)
    for step in np.array(list(np.ndindex(3, 3, 3))) - 1:
        beside = home[tuple((index[asked] + 1 + step).T)]
        rim[asked] |= (beside >= 0) & distant[number[own[asked]], beside]
    length = 0.5 * float(lines.share_mm[np.unique(own[rim])].sum()) if rim.any() else 0.0
    if length < _SIDE_BY_SIDE_MM:
        return mask, []
    voxels = mask.voxels.copy()
    voxels[tuple(index[rim].T)] = False
    place = mask.index_to_world(index[rim][:, ::-1].mean(axis=0))
    text = f"distant parts of the vessel touch over {length:.0f} mm around {place_text(place)} and were parted there"
    return replace(mask, voxels=voxels), [text]


def _crossing(ways: list[list[int]], node: int, first: int) -> tuple[int, list[int]] | None:
    """Return the fork that a bridge leads to from one of its points, and the bridge's points up to it."""
    path, before = [first], node
    while len(ways[path[-1]]) == 2:
        following = next(i for i in ways[path[-1]] if i != before)
        before = path[-1]
        path.append(following)
        if len(path) > 60:
            return None
    return (path[-1], path) if len(ways[path[-1]]) > 2 else None


def _runs_past(lines: MedialLines, ways: list[list[int]], fork: int, bridge: list[int]) -> bool:
    """Return whether the vessel at a fork goes on both ways, nearly straight, apart from the bridge."""
    reach = max(_ARM_RADII * float(lines.clearance[fork]), 5.0)
    came = bridge[-2] if len(bridge) > 1 else -1
    length, before = {fork: 0.0}, {fork: came}
    queue, ends = [fork], []
    while queue:
        node = queue.pop()
        if length[node] > reach:
            ends.append(node)
            continue
        for other in ways[node]:
            if other not in length and other not in bridge and not (node == fork and other == came):
                length[other] = length[node] + float(np.linalg.norm(lines.points[other] - lines.points[node]))
                before[other] = node
                queue.append(other)
    if len(ends) < 2:
        return False
    arms = lines.points[ends] - lines.points[fork]
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    return bool((arms @ arms.T).min() < _THROUGH)


def _sever(voxels: np.ndarray, lines: MedialLines, ends: tuple[int, int]) -> None:
    """Empty the voxels between the two sides of a cut, two layers of them, so that their walls do not run together."""
    one, two = ends
    others = ~np.isin(lines.edges, ends).all(axis=1)
    forest = lines.matrix(lines.edges[others])
    near, far = dijkstra(forest, indices=[one, two])
    centre = 0.5 * (lines.index[one] + lines.index[two])
    reach = 3.0 * lines.clearance[[one, two]].max() / _voxel(lines) + 4.0
    local = np.flatnonzero(np.linalg.norm(lines.index - centre, axis=1) < 3.0 * reach)
    window = tuple(slice(max(0, int(c - reach)), int(c + reach) + 2) for c in centre)
    own = np.argwhere(voxels[window]) + np.array([part.start for part in window])
    nearest = local[np.asarray(KDTree(lines.index[local]).query(own)[1])]
    first = np.zeros(voxels[window].shape, dtype=bool)
    first[tuple((own[near[nearest] <= far[nearest]] - [part.start for part in window]).T)] = True
    second = voxels[window] & ~first
    block = np.ones((3, 3, 3), dtype=bool)
    beside_first, beside_second = (np.asarray(binary_dilation(side, block), dtype=bool) for side in (first, second))
    rim = (first & beside_second) | (second & beside_first)
    voxels[window] &= ~rim


def _voxel(lines: MedialLines) -> float:
    """Return the mean edge of the voxels, mm."""
    apart = np.linalg.norm(lines.index[lines.edges[:, 0]] - lines.index[lines.edges[:, 1]], axis=1)
    return float((lines.lengths(lines.edges) / apart).mean())
