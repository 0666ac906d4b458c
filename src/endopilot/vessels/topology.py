"""What touches in a mask: one model of contacts, loops, flaps and forks, so that a tree goes on where the vessel does.

The middle of a mask (`medial_lines`) is cut into segments between its junctions. Where four of them leave a junction,
or two that are near each other, two vessels may run past each other: then they pair up to two lines that carry on
straight, about as far apart as both radii together. At a true fork the lines meet. A contact is parted, unless the
lumen would fall apart that way and the two are not certain to be two vessels: then it stays, and is said. What is left
of loops is cut at its narrowest place. Where filling in a wall makes the vessel much wider, that wall is a flap, and
its openings stay.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_closing, binary_dilation, distance_transform_edt
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from endopilot.errors import place_text
from endopilot.imaging.grid import connected_components
from endopilot.lines import length_along
from endopilot.types import Volume
from endopilot.vessels.graph import pieces
from endopilot.vessels.inlet import AORTA_RADIUS_MM
from endopilot.vessels.medial_lines import SMALLEST_PIECE, MedialLines, piece_labels, thinned_lines, traced_lines
from endopilot.vessels.remarks import MOST_LISTED

CONTACT = 0.6  # a place with less clearance than this share of both sides' is a contact, not a stenosis

SHORTEST_LOOP_MM = 20.0
"""Loops from this length are cut. In shorter ones two branches touch again just behind their fork, or a wall has a
hole: which way a line takes hardly matters."""

_SLIT_VOXELS = 3.0  # no loop are tunnels whose opposite sides come as near each other as this, in voxels

_APART, _STRAIGHT = (0.35, 0.5, 0.8), (0.6, 0.8)
"""Axes that stay apart by these shares of both radii together: of one vessel that touches itself, of two that perhaps
touch, of two that certainly do. Each one carries on by the first cosine at least, certainly by the second."""

_FLAP = 1.15
"""Where the wall between two lumens of one vessel is filled in, it is wider than either of them by this factor, unless
the wall lies far off its middle; where two round vessels touch, it never is."""

_SAME_PLACE_MM = 5.0
_SIDE_BY_SIDE_MM = 3.0
_NEAR_RADII, _ARM_RADII = 8.0, 4.0
_ROUNDS = 4

_MOST_RINGS = 8
"""A lumen with more rings is no vessel that touches itself, and is left as it is: a dissection's two lumens have 48
between rough tears, generated flaps have 5 at most."""


@dataclass(frozen=True, eq=False)
class Touch:
    """A place (LPS mm) where a mask touches itself or another vessel, or closes a loop, and if it was parted there;
    `size_mm` is the length of the vessel between the two sides, or of the contact, 0 if unknown."""

    parted: bool
    place: Float[np.ndarray, "3"]
    size_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class _Arm:
    """A segment of the middle as it leaves a junction, outwards: mm along the mask's own axes (z, y, x)."""

    points: Float[np.ndarray, "n 3"]
    direction: Float[np.ndarray, "3"]
    radius: float


@dataclass(frozen=True, eq=False)
class _Crossing:
    """Two lines that run past each other, mm along the mask's own axes: points, radii, and where they are nearest."""

    lines: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]
    radii: tuple[float, float]
    nearest: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
    likely: bool
    certain: bool

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """A place on both walls."""
        share = self.radii[0] / sum(self.radii)
        return (1 - share) * self.nearest[0] + share * self.nearest[1]


@dataclass(frozen=True, eq=False)
class _Ring:
    """A loop of the middle: its points from one side of its narrowest place to the other, and its length, mm."""

    nodes: Int[np.ndarray, "n"]
    around_mm: float


def parted(mask: Volume) -> tuple[Volume, list[Touch], MedialLines]:
    """Return the mask parted where it touches itself, all its contacts and loops, and its middle then. No part loses
    its way to the rest, except one of two vessels that certainly only touch."""
    parting, before = _Parting(mask), traced_lines(mask)
    for _ in range(_ROUNDS):
        thin = thinned_lines(parting.result)  # has all loops, but not all ends
        lines = before if parting.result is mask else traced_lines(parting.result)
        rings = _rings(thin, mask)
        if parting.result is mask and len(rings) > _MOST_RINGS:
            every = _Parting(mask)
            for ring in sorted(rings, key=lambda ring: -ring.around_mm):
                every.say(False, thin.local[ring.nodes[0]], ring.around_mm)
            if len(every.found) > _MOST_RINGS:
                return mask, every.found, before
        crossings = itertools.chain(_crossings(thin, rings), _crossings(lines, []))
        opened = sum([parting.crossing(each, thin, rings) for each in crossings])
        if not (opened or sum([parting.ring(each, thin) for each in rings])):
            break
    result = parting.result
    lines = before if result is mask else traced_lines(result)
    if aside := _without_sides(result, lines):
        result, lines = aside[0], traced_lines(aside[0])
        parting.found.append(aside[1])
    return result, parting.found, lines


def touch_remarks(found: list[Touch], *, parted: bool = True) -> list[str]:
    """Return remarks on where a lumen touches itself: on what was parted, and on what was not, the largest first."""
    remarks = []
    for done, answer in ((True, "was parted"), (False, "was left joined")):
        own = sorted((t for t in found if (t.parted and parted) == done), key=lambda touch: -touch.size_mm)
        places = [place_text(t.place) + f" ({t.size_mm:.0f} mm around)" * (t.size_mm > 0) for t in own]
        if places:
            more = f" and {len(places) - MOST_LISTED} places more" if len(places) > MOST_LISTED else ""
            remarks.append(
                "the lumen touches itself or another vessel, or closes a loop, and "
                f"{answer} at {', '.join(places[:MOST_LISTED])}{more}"
            )
    return remarks


class _Parting:
    """A mask that is being parted, and what was found in it."""

    def __init__(self, mask: Volume) -> None:
        self.mask, self.edges = mask, mask.spacing_mm[::-1]
        self.result, self.found = mask, list[Touch]()

    def say(self, parted: bool, place: Float[np.ndarray, "3"], size_mm: float = 0.0) -> None:
        """Keep what was found at a place, along the mask's own axes, unless something is said of it."""
        at = self.mask.index_to_world((place / self.edges)[::-1])
        if all(np.linalg.norm(at - touch.place) >= _SAME_PLACE_MM for touch in self.found):
            self.found.append(Touch(parted, at, size_mm))

    def crossing(self, crossing: _Crossing, lines: MedialLines, rings: list[_Ring]) -> bool:
        """Part two lines that run past each other, if nothing is lost by it, and return whether that was done."""
        across = np.linspace(*crossing.nearest, 12)
        neck, flap = self._neck(crossing.place, sum(crossing.radii), across)
        if flap:
            self.say(False, crossing.place)
            return False
        rim = _rim(self.result.voxels, self.edges, crossing)
        trial = replace(self.mask, voxels=self.result.voxels & ~rim)
        one, two, whole = self._held(trial, crossing)
        itself = one == two
        if itself:
            part = whole and _count(trial) <= _count(self.result) and _are_apart(trial, self.edges, crossing)
        elif part := whole and crossing.certain and neck < CONTACT * min(crossing.radii):
            one, two, _ = self._held(replace(self.mask, voxels=self.mask.voxels & ~rim), crossing)
            part = one != two
        if not part and not crossing.likely:
            return False
        place = np.argwhere(rim).mean(axis=0) * self.edges if rim.any() else crossing.place
        reach = sum(crossing.radii)
        through = [r.around_mm for r in rings if cdist(lines.local[r.nodes], [place]).min() < reach]
        self.say(part, place, min(through, default=0.0) if part and itself else 0.0)
        if part:
            self.result = trial
        return part

    def _held(self, mask: Volume, crossing: _Crossing) -> tuple[int, int, bool]:
        """Return which pieces two lines lie in, and whether either lies in one piece from end to end."""
        labels = piece_labels(mask)
        ends = np.array([line[at] for line in crossing.lines for at in (0, -1)])
        one, other, two, last = (int(labels[tuple(at)]) for at in np.rint(ends / self.edges).astype(int))
        return one, two, one == other > 0 and two == last > 0

    def ring(self, ring: _Ring, lines: MedialLines) -> bool:
        """Cut a loop at its narrowest place, if nothing is lost by it, and return whether that was done."""
        clearance, ends = lines.radius[ring.nodes], ring.nodes[[0, -1]]
        place = lines.local[ends].mean(axis=0)
        if self._neck(place, 2.0 * float(np.median(clearance)), place[None])[1]:
            self.say(False, place, ring.around_mm)
            return False
        trial = replace(self.mask, voxels=self.result.voxels.copy())
        _sever(trial.voxels, lines, (int(ends[0]), int(ends[1])))
        if _count(trial) > _count(self.result):
            self.say(False, place, ring.around_mm)
            return False
        self.say(True, place, ring.around_mm)
        self.result = trial
        return True

    def _neck(
        self, place: Float[np.ndarray, "3"], reach_mm: float, across: Float[np.ndarray, "n 3"]
    ) -> tuple[float, bool]:
        """Return the least clearance at places across a neck, mm, and whether a flap is at its middle: with its wall
        filled in, the vessel is wider there than any lumen within reach."""
        reach, at = np.ceil(reach_mm / self.edges).astype(int), np.rint(place / self.edges).astype(int)
        window = tuple(slice(max(0, c - 2 * r), c + 2 * r + 1) for c, r in zip(at, reach, strict=True))
        own = np.pad(self.result.voxels[window], 1)
        filled = np.asarray(binary_closing(own, np.ones((3, 3, 3))))  # walls of one or two voxels
        before, after = (np.asarray(distance_transform_edt(each, sampling=self.edges)) for each in (own, filled))
        at = at - [part.start for part in window] + 1
        near, here = (
            tuple(slice(max(0, c - r), c + r + 1) for c, r in zip(at, size, strict=True))
            for size in (reach, np.ones(3, int))
        )
        widest, filled = float(before[near].max(initial=0.0)), float(after[here].max(initial=0.0))
        at = np.rint(across / self.edges).astype(int) - [part.start for part in window] + 1
        return float(before[tuple(np.clip(at, 0, np.array(before.shape) - 1).T)].min()), filled > _FLAP * widest


def _count(mask: Volume) -> int:
    return int((np.bincount(piece_labels(mask)[mask.voxels]) >= SMALLEST_PIECE).sum())


def _rings(lines: MedialLines, mask: Volume) -> list[_Ring]:
    rings = []
    for start, end in lines.closing:
        nodes = np.array(lines.tree.way(int(end), int(start)))
        around = float(lines.lengths(np.column_stack([nodes, np.roll(nodes, 1)])).sum())
        across = np.linalg.norm(lines.points[nodes] - np.roll(lines.points[nodes], len(nodes) // 2, axis=0), axis=1)
        wide = 2 * np.pi * float(np.quantile(lines.radius[nodes], 0.9))
        if across.min() >= _SLIT_VOXELS * mask.spacing_mm.max() and around >= max(SHORTEST_LOOP_MM, wide):
            rings.append(_Ring(nodes, around))
    return rings


def _crossings(lines: MedialLines, rings: list[_Ring]) -> Iterator[_Crossing]:
    """Yield where two vessels may run past each other: four arms of one junction, or of two that are near."""
    segments, count = _segments(lines, rings), len(lines.points)
    ends = np.array([(segment[0], segment[-1]) for segment in segments], dtype=int).reshape(-1, 2)
    length = np.array([length_along(lines.local[segment])[-1] for segment in segments])
    radius = lines.radius[ends].max(axis=1)
    at_fork = (np.bincount(ends.ravel(), minlength=count) > 2)[ends]
    link, inner = at_fork.all(axis=1), at_fork.all(axis=1) & (length <= radius)
    group = pieces(ends[inner], count)[ends]
    arms: dict[int, list[tuple[int, _Arm | None]]] = {}
    for number in np.flatnonzero(~inner).tolist():
        for own, fork, way in zip(group[number].tolist(), at_fork[number], (1, -1), strict=True):
            if fork:
                arms.setdefault(own, []).append((number, _arm(lines, segments[number][::way])))
    link &= ~inner & (group[:, 0] != group[:, 1]) & (length < _NEAR_RADII * radius)
    unions = [(own, -1) for own in arms.values()]
    unions += [(arms[group[number, 0]] + arms[group[number, 1]], number) for number in np.flatnonzero(link)]
    for union, between in unions:
        usable = [arm for number, arm in union if number != between and arm is not None]
        if len(usable) > 3 and (crossing := _crossing(usable)):
            yield crossing


def _segments(lines: MedialLines, rings: list[_Ring]) -> list[list[int]]:
    """Return the paths of the middle between its ends and junctions, without stubs as short as it is wide."""
    ways: dict[int, set[int]] = {}
    for one, two in [*lines.edges.tolist(), *(ring.nodes[[0, -1]].tolist() for ring in rings)]:
        ways.setdefault(one, set()).add(two)
        ways.setdefault(two, set()).add(one)
    while True:
        segments: list[list[int]] = []
        for node in sorted(node for node, others in ways.items() if len(others) != 2):
            for following in sorted(ways[node]):
                path = [node, following]
                while len(ways[path[-1]]) == 2:
                    path.append(next(other for other in ways[path[-1]] if other != path[-2]))
                if (path[-1], path[-2]) > (node, following):
                    segments.append(path)
        stubs = [s for s in segments if (len(ways[s[0]]) == 1) != (len(ways[s[-1]]) == 1)]
        stubs = [s if len(ways[s[0]]) > 1 else s[::-1] for s in stubs]
        stubs = [s for s in stubs if _is_stub(lines, s)]
        if not stubs:
            return segments
        for stub in stubs:
            for one, two in itertools.pairwise(stub):
                ways[one].discard(two)
                ways[two].discard(one)
        ways = {node: others for node, others in ways.items() if others}


def _is_stub(lines: MedialLines, path: list[int]) -> bool:
    length = float(length_along(lines.local[path])[-1])
    around = np.linalg.norm(lines.local - lines.local[path[0]], axis=1) <= length
    return length < max(2.0 * float(lines.radius[around].max()), _SLIT_VOXELS * float(lines.edges_mm.max()))


def _arm(lines: MedialLines, path: list[int]) -> _Arm | None:
    """Return what leaves a junction outside its inscribed sphere; None if that is too short to have a direction."""
    points, wide = lines.local[path], float(lines.radius[path[0]])
    along = length_along(points)
    first = int(np.searchsorted(along, wide))
    last = int(np.searchsorted(along, along[min(first, len(path) - 1)] + _ARM_RADII * wide))
    points = points[first : last + 1]
    if len(points) < 3 or np.linalg.norm(points[-1] - points[0]) < 1.5 * wide:
        return None
    direction = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
    return _Arm(points, direction, float(np.quantile(lines.radius[path[first : last + 1]], 0.75)))


def _crossing(arms: list[_Arm]) -> _Crossing | None:
    """Return two lines that run past each other, of the arms that carry each other on best; None if they are a fork."""
    ways = {
        (i, j): -float(arms[i].direction @ arms[j].direction) for i, j in itertools.combinations(range(len(arms)), 2)
    }
    best, found = 0.0, None
    for couple in itertools.combinations(ways, 2):
        straight = min(ways[pair] for pair in couple)
        if set(couple[0]) & set(couple[1]) or straight < _STRAIGHT[0]:
            continue
        one, two = (_carried_on(arms[i], arms[j]) for i, j in couple)
        radii = tuple((arms[i].radius + arms[j].radius) / 2 for i, j in couple)
        gaps = cdist(one, two)
        at = np.unravel_index(gaps.argmin(), gaps.shape)
        apart = float(gaps.min()) / sum(radii)
        if apart > _APART[0] and straight + min(apart, 1.0) > best:
            best = straight + min(apart, 1.0)
            lines = tuple(
                np.concatenate([arms[i].points[::-1], line, arms[j].points])
                for (i, j), line in zip(couple, (one, two), strict=True)
            )
            certain = straight > _STRAIGHT[1] and apart > _APART[2]
            found = _Crossing(lines, radii, (one[at[0]], two[at[1]]), apart > _APART[1], certain)  # pyright: ignore[reportArgumentType]
    return found


def _carried_on(one: _Arm, two: _Arm) -> Float[np.ndarray, "n 3"]:
    start, end = one.points[0], two.points[0]
    size = float(np.linalg.norm(end - start))
    at = np.linspace(0.0, 1.0, 24)[:, None]
    bend = at * (1 - at) * ((1 - at) * (start - end - size * one.direction) + at * (end - start - size * two.direction))
    return (1 - at) * start + at * end + bend


def _rim(
    voxels: Bool[np.ndarray, "nz ny nx"], edges: Float[np.ndarray, "3"], crossing: _Crossing
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the voxels between two lines that touch, a layer of either, so that their walls stay apart."""
    window = _window(voxels.shape, edges, crossing)
    corner = np.array([part.start for part in window])
    index = np.argwhere(voxels[window])
    local = (index + corner) * edges
    one, two = (
        np.asarray(KDTree(line).query(local)[0]) - radius
        for line, radius in zip(crossing.lines, crossing.radii, strict=True)
    )
    gap = max(0.0, float(np.linalg.norm(np.subtract(*crossing.nearest))) - sum(crossing.radii))
    near = np.maximum(one, two) < gap / 2 + 1.5 * float(edges.max())
    rim = _between(voxels[window], index, one <= two)
    rim[tuple(index[~near].T)] = False
    whole = np.zeros_like(voxels)
    whole[window] = rim
    return whole


def _between(
    voxels: Bool[np.ndarray, "nz ny nx"], index: Int[np.ndarray, "n 3"], chosen: Bool[np.ndarray, "n"]
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the voxels of a mask that lie where two parts of it meet, of both."""
    first = np.zeros(voxels.shape, dtype=bool)
    first[tuple(index[chosen].T)] = True
    second, block = voxels & ~first, np.ones((3, 3, 3), dtype=bool)
    beside_first, beside_second = (np.asarray(binary_dilation(side, block), dtype=bool) for side in (first, second))
    return (first & beside_second) | (second & beside_first)


def _window(shape: tuple[int, ...], edges: Float[np.ndarray, "3"], crossing: _Crossing) -> tuple[slice, ...]:
    points = np.concatenate(crossing.lines)
    margin = max(crossing.radii) + 3.0 * edges
    low, high = (points.min(axis=0) - margin) / edges, (points.max(axis=0) + margin) / edges
    return tuple(slice(max(0, int(a)), min(n, int(b) + 2)) for a, b, n in zip(low, high, shape, strict=True))


def _are_apart(mask: Volume, edges: Float[np.ndarray, "3"], crossing: _Crossing) -> bool:
    window = _window(mask.voxels.shape, edges, crossing)
    labels = connected_components(mask.voxels[window], corners=True)
    index = np.argwhere(labels)
    tree = KDTree((index + [part.start for part in window]) * edges)
    one, two = (labels[tuple(index[tree.query(place)[1]])] for place in crossing.nearest)
    return bool(one != two)


def _sever(voxels: Bool[np.ndarray, "nz ny nx"], lines: MedialLines, ends: tuple[int, int]) -> None:
    """Empty the voxels between the two sides of a cut, a layer of either, so that their walls do not run together."""
    near, far = lines.away(list(ends))
    centre = lines.index[list(ends)].mean(axis=0)
    reach = 3.0 * lines.radius[list(ends)].max() / float(lines.edges_mm.mean()) + 4.0
    local = np.flatnonzero(np.linalg.norm(lines.index - centre, axis=1) < 3.0 * reach)
    window = tuple(slice(max(0, int(c - reach)), int(c + reach) + 2) for c in centre)
    index = np.argwhere(voxels[window])
    corner = np.array([part.start for part in window])
    nearest = local[np.asarray(KDTree(lines.index[local]).query(index + corner)[1])]
    voxels[window] &= ~_between(voxels[window], index, near[nearest] <= far[nearest])


def _without_sides(mask: Volume, lines: MedialLines) -> tuple[Volume, Touch] | None:
    """Return the mask with distant parts parted where they touch over a length, between voxels whose nearest middle
    points are distant; None if there are none, or the lumen fell apart."""
    if lines.radius.max(initial=0.0) > AORTA_RADIUS_MM:  # a branch's first part lies inside the aorta's own middle
        return None
    voxel = float(mask.spacing_mm.max())
    pairs = KDTree(lines.points).query_pairs(2.0 * float(lines.radius.max()) + voxel, output_type="ndarray")
    gap = np.linalg.norm(lines.points[pairs[:, 0]] - lines.points[pairs[:, 1]], axis=1)
    pairs = pairs[gap < lines.radius[pairs].sum(axis=1) + voxel]
    sources, own = np.unique(pairs[:, 0], return_inverse=True)
    if len(sources) == 0:
        return None
    along = lines.away(sources, SHORTEST_LOOP_MM)
    touching = np.unique(pairs[np.isinf(along[own.reshape(-1), pairs[:, 1]])])
    if len(touching) == 0:
        return None
    index = np.argwhere(mask.voxels)
    home = np.full(np.array(mask.voxels.shape) + 2, -1)
    home[tuple((index + 1).T)] = KDTree(lines.local).query(index * lines.edges_mm)[1]
    number = np.full(len(lines.points), -1)
    number[touching] = np.arange(len(touching))
    distant = np.isinf(lines.away(touching, SHORTEST_LOOP_MM))
    own = home[tuple((index + 1).T)]
    rim = np.zeros(len(index), dtype=bool)
    asked = np.flatnonzero(number[own] >= 0)
    for step in np.array(list(np.ndindex(3, 3, 3))) - 1:
        beside = home[tuple((index[asked] + 1 + step).T)]
        rim[asked] |= (beside >= 0) & distant[number[own[asked]], beside]
    length = 0.5 * float(lines.share_mm[np.unique(own[rim])].sum())
    trial = replace(mask, voxels=mask.voxels.copy())
    trial.voxels[tuple(index[rim].T)] = False
    if length < _SIDE_BY_SIDE_MM or _count(trial) > _count(mask):
        return None
    return trial, Touch(True, mask.index_to_world(index[rim][:, ::-1].mean(axis=0)), length)
