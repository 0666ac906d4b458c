"""Lines as files hold them, made fit to follow: points in order, steps that the spheres bridge, one line a piece."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import KDTree

from endopilot.anatomy.sources import Polylines
from endopilot.errors import InputError, place_text

_NEIGHBOURS = 6
"""Points of a line are compared with this many nearest ones."""

_DISORDER = 2.0
"""A line this many times as long as the shortest tree through its points is in no order."""

_JUMP_STEPS, _JUMP_RADII = 8.0, 5.0
"""A step of more than this many usual ones, and of both radii this many times, leads to another vessel."""


def in_order(source: Polylines, label: str) -> tuple[Polylines, list[str]]:
    """Return lines that follow their vessels, and what was done, a sentence each.

    Points that repeat are dropped. Points in another order than along the vessel are sorted where only one order is the
    shortest. Where neighbouring spheres do not touch, a line is joined by a straight piece, or cut if it jumps to
    another vessel.

    Args:
        source: lines as read, mm.
        label: name of the source, for messages.

    Raises:
        InputError: the points of a line are in no order.
    """
    points, radii, notes = [], [], []
    for number, (line, size) in enumerate(zip(source.points, source.radius, strict=True)):
        name = source.name(number)
        distinct = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])
        line, size = line[distinct], size[distinct]
        if len(line) < 2:
            notes.append(f"{name}: all its points coincide at {place_text(line[0])}: left out")
            continue
        order = _order(line, f"{label}: {name}")
        if order is not None:
            before, after = _length(line), _length(line[order])
            line, size = line[order], size[order]
            notes.append(
                f"{name}: its points were in another order than along the vessel, and are sorted "
                f"({before:.0f} mm became {after:.0f} mm)"
            )
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        reach = size[1:] + size[:-1]
        apart = step > reach
        jump = apart & (step > _JUMP_RADII * reach) & (step > _JUMP_STEPS * np.median(step))
        notes += [f"{name} jumps by {step[i]:.1f} mm at {place_text(line[i])}: cut there" for i in np.flatnonzero(jump)]
        coarse = np.flatnonzero(apart & ~jump)
        if len(coarse):
            longest = int(coarse[step[coarse].argmax()])
            notes.append(
                f"{name}: the spheres of {len(coarse)} neighbouring points do not touch (the longest step, "
                f"{step[longest]:.1f} mm, is at {place_text(line[longest])}): joined by straight pieces of "
                f"{step[coarse].sum():.1f} mm in all"
            )
        for part in np.split(np.arange(len(line)), np.flatnonzero(jump) + 1):
            if len(part) > 1:
                points.append(line[part])
                radii.append(size[part])
            else:
                notes.append(f"{name}: the single point at {place_text(line[part[0]])} is left out")
    if not points:
        raise InputError(f"{label}: holds no line of at least two distinct points; export the centerline again")
    return Polylines(tuple(points), tuple(radii)), notes


def _order(line: Float[np.ndarray, "n 3"], label: str) -> Int[np.ndarray, "n"] | None:
    """Return the order of points along the vessel where it is another than they are in, or None where it is not.

    The shortest tree through the points, where it has no fork, is the order along a vessel.
    """
    count = len(line)
    if count < 4:
        return None
    near = np.asarray(KDTree(line).query(line, k=min(_NEIGHBOURS, count - 1) + 1)[1])
    rows = np.concatenate([np.repeat(np.arange(count), near.shape[1]), np.arange(count - 1)])
    columns = np.concatenate([near.ravel(), np.arange(1, count)])
    pairs = np.unique(np.sort(np.stack([rows, columns], axis=1)[rows != columns], axis=1), axis=0)
    gap = np.linalg.norm(line[pairs[:, 0]] - line[pairs[:, 1]], axis=1) + 1e-9
    shortest = minimum_spanning_tree(csr_matrix((gap, (pairs[:, 0], pairs[:, 1])), shape=(count, count))).tocoo()
    given, least = _length(line), float(shortest.data.sum())
    if given < least + 1.5 * float(np.median(shortest.data)):
        return None
    degree = np.bincount(np.concatenate([shortest.row, shortest.col]), minlength=count)
    turns = _turns(line)
    if degree.max() <= 2:
        order = breadth_first_order(shortest.tocsr(), int(np.flatnonzero(degree == 1)[0]), directed=False)[0]
        order = order if order[0] < order[-1] else order[::-1]
        if turns > _turns(line[order]):
            return order
    elif given > _DISORDER * least and turns > max(3, count // 4):
        raise InputError(
            f"{label}: its points are not in order along a vessel (they turn back {turns} times; {given:.0f} mm as "
            f"they stand, {least:.0f} mm from each to its nearest); sort them along the vessel"
        )
    return None


def _turns(line: Float[np.ndarray, "n 3"]) -> int:
    """Return at how many points a line turns by more than 90°."""
    step = np.diff(line, axis=0)
    return int((np.einsum("ij,ij->i", step[1:], step[:-1]) < 0).sum())


def _length(line: Float[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
