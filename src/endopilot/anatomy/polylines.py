"""One tree from centerlines that overlap, as VMTK writes them, or that meet end to end, as Slicer writes them.

Lines are resampled and their points made the nodes of a graph: neighbours along a line are joined, and so are points of
different lines that coincide, and line ends that lie inside another line's spheres. The tree is then traced as in a
lumen: farthest end first, each further line from where it leaves what is there.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.sources import Polylines
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.errors import InputError
from endopilot.types import Insertion, VesselTree

STEP_MM = 0.5
"""Distance between the points of the tree, mm."""

PARENT_VESSEL_RATIO = 2.5
"""Where lines start in spheres this many times wider than their own median, they start in a parent vessel."""

TOGETHER = 0.5
"""Lines nearer each other than this share of the local radius run together and become one."""

_SHORTEST_MM = 2.0


def tree_from_polylines(source: Polylines | VesselTree, given: Insertion | None, label: str) -> tuple[VesselTree, str]:
    """Return one tree from centerlines, and the rule by which its root was chosen.

    Where the lines start in a parent vessel (VMTK's coronary centerlines start in the aorta), they are cut at the
    ostium: where they leave the parent's spheres.

    Raises:
        InputError: the spheres of neighbouring points do not touch, or no line is near the given ostium.
    """
    if isinstance(source, VesselTree):
        lines = [branch.centerline for branch in source.branches]
        source = Polylines(tuple(line.points for line in lines), tuple(line.radius for line in lines))
    _refuse_gaps(source, label)
    points, radius, owner = _dense(source)
    keep, cut_at = _outside_parent_vessel(points, radius, owner)
    ends = _line_ends(owner)
    points, radius, owner, ends = points[keep], radius[keep], owner[keep], ends[keep]
    if given is not None:
        gap = np.linalg.norm(points - given.position, axis=1)
        root, rule = int(gap.argmin()), "given"
        if gap[root] > max(5.0, 2 * radius[root]):
            raise InputError(
                f"{label}: the ostium at {np.round(given.position, 1).tolist()} mm is {gap[root]:.1f} mm from the "
                "nearest centerline; check the coordinates (LPS mm)"
            )
    elif cut_at is not None:
        gap = np.linalg.norm(points - cut_at, axis=1)
        root, rule = int(gap.argmin()), "where the lines leave the parent vessel"
    else:
        root, rule = _common_start(points, radius, ends), "end where the lines begin or widest end"
    paths = _trace(points, radius, owner, ends, root)
    return tree_from_lines(_lines(points, radius, paths)), rule


def _refuse_gaps(source: Polylines, label: str) -> None:
    for number, (points, radius) in enumerate(zip(source.points, source.radius, strict=True)):
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        apart = np.flatnonzero(step > radius[1:] + radius[:-1])
        if len(apart):
            place = points[apart[0]].round(1).tolist()
            raise InputError(
                f"{label}: in line {number}, the inscribed spheres of {len(apart)} neighbouring points do not touch "
                f"(first {step[apart[0]]:.2f} mm apart at {place}); resample the line more finely or check the unit"
            )


def _dense(source: Polylines) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    points, radius, owner = [], [], []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        distinct = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])
        line, size = line[distinct], size[distinct]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        wanted = np.linspace(0.0, length[-1], max(2, round(length[-1] / (0.5 * STEP_MM)) + 1))
        points.append(np.stack([np.interp(wanted, length, line[:, axis]) for axis in range(3)], axis=1))
        radius.append(np.interp(wanted, length, size))
        owner.append(np.full(len(wanted), number))
    return np.concatenate(points), np.concatenate(radius), np.concatenate(owner)


def _line_ends(owner: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    change = np.flatnonzero(np.diff(owner))
    ends = np.zeros(len(owner), dtype=bool)
    ends[[0, *change, *(change + 1), len(owner) - 1]] = True
    return ends


def _outside_parent_vessel(
    points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], owner: Int[np.ndarray, "n"]
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "3"] | None]:
    """Return which points lie outside the parent vessel that the lines start in, and where they leave it.

    The parent's spheres are those at the lines' common start that are several times wider than the lines' median.
    """
    everywhere = np.ones(len(points), dtype=bool)
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    usual = float(np.median(radius))
    common = np.linalg.norm(points[starts] - points[starts[0]], axis=1).max() < radius[starts[0]]
    if radius[starts[0]] < PARENT_VESSEL_RATIO * usual or not common:
        return everywhere, None
    big = radius > PARENT_VESSEL_RATIO * usual
    gap = np.full(len(points), np.inf)
    for centre, size in zip(points[big], radius[big], strict=True):
        gap = np.minimum(gap, np.linalg.norm(points - centre, axis=1) - size)
    keep = everywhere.copy()
    first_kept = []
    for start, end in zip(starts, [*starts[1:], len(points)], strict=True):
        inside = np.flatnonzero((gap[start:end] < 0) | big[start:end])
        leave = int(inside[-1]) + 1 if len(inside) else 0
        keep[start : start + leave] = False
        if start + leave < end:
            first_kept.append(start + leave)
    if not first_kept:
        return everywhere, None
    return keep, points[first_kept].mean(axis=0) if _close(points[first_kept]) else points[first_kept[0]]


def _close(points: Float[np.ndarray, "n 3"]) -> bool:
    return bool(np.ptp(points, axis=0).max() < 2.0)


def _common_start(points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], ends: Bool[np.ndarray, "n"]) -> int:
    """Return the widest line end at which the most lines begin or that no other line touches."""
    index = np.flatnonzero(ends)
    return int(index[radius[index].argmax()])


def _trace(
    points: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, "n"],
    owner: Int[np.ndarray, "n"],
    ends: Bool[np.ndarray, "n"],
    root: int,
) -> list[Int[np.ndarray, "_"]]:
    """Return the tree as paths of nodes, the first from the root, each other from a node of an earlier one."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    places = KDTree(points)
    along = np.flatnonzero(owner[:-1] == owner[1:])
    near = places.query_pairs(0.8 * STEP_MM, output_type="ndarray")
    near = near[owner[near[:, 0]] != owner[near[:, 1]]]
    bridges = []
    for end in np.flatnonzero(ends):
        foreign = np.flatnonzero(owner != owner[end])
        if len(foreign):
            gap = np.linalg.norm(points[foreign] - points[end], axis=1)
            best = foreign[gap.argmin()]
            if gap.min() < max(radius[end], radius[best]):
                bridges.append((end, best))
    rows = np.concatenate([along, near[:, 0], [a for a, _ in bridges]]).astype(np.int64)
    columns = np.concatenate([along + 1, near[:, 1], [b for _, b in bridges]]).astype(np.int64)
    length = np.linalg.norm(points[rows] - points[columns], axis=1)
    cost = np.where(np.arange(len(rows)) < len(along), length, 2 * length + 0.1)
    size = len(points)
    distance, before = dijkstra(
        csr_matrix((np.maximum(cost, 1e-6), (rows, columns)), shape=(size, size)),
        directed=False,
        indices=root,
        return_predecessors=True,
    )
    covered = ~np.isfinite(distance)
    paths: list[np.ndarray] = []
    for tip in np.argsort(-np.where(covered, -1.0, distance), kind="stable"):
        if covered[tip]:
            continue
        path = [int(tip)]
        while before[path[-1]] >= 0 and not covered[path[-1]]:
            path.append(int(before[path[-1]]))
        nodes = np.array(path[::-1])
        new = float(distance[nodes[-1]] - distance[nodes[0]])
        if not paths or new > max(_SHORTEST_MM, float(radius[nodes[0]])):
            paths.append(nodes)
        for found in places.query_ball_point(points[nodes], np.maximum(TOGETHER * radius[nodes], STEP_MM)):
            covered[found] = True
    return paths


def _lines(
    points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"], paths: list[Int[np.ndarray, "_"]]
) -> list[Line]:
    """Return the paths as lines, each joined to the earlier line that its start runs together with."""
    lines: list[Line] = []
    for nodes in paths:
        line, size = points[nodes], radius[nodes]
        parent, place = -1, 0
        if lines:
            parent = int(np.argmin([np.linalg.norm(other.points - line[0], axis=1).min() for other in lines]))
            host = lines[parent]
            gap = np.linalg.norm(host.points - line[0], axis=1)
            nearest = int(gap.argmin())
            upstream = round(2.0 * float(gap[nearest]) / STEP_MM)  # meet at about 30°, not at a right angle
            place = int(np.clip(nearest - upstream, 1, len(gap) - 2))
            line = np.concatenate([host.points[place : place + 1], line])
            size = np.concatenate([host.radius[place : place + 1], size])
        line, size = _resampled(line, size)
        lines.append(Line(line, size, parent, place))
    return lines


def _resampled(
    points: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    distinct = np.concatenate([[True], np.diff(length) > 1e-9])
    wanted = np.linspace(0.0, length[-1], max(3, round(length[-1] / STEP_MM) + 1))
    line = np.stack([np.interp(wanted, length[distinct], points[distinct, axis]) for axis in range(3)], axis=1)
    return line, np.interp(wanted, length[distinct], radius[distinct])
