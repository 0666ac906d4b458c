"""The shape of a vessel tree in figures: bends, twists, forks, calibre, and how the catheter meets the vessel.

Curvature and torsion are those of the main path (ostium to the farthest tip), resampled every `STEP_MM` and blurred
with a Gaussian of `SIGMA_MM`; its first and last `END_MM` are left out, where the blur has one side only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from endopilot.anatomy.distance import sample
from endopilot.anatomy.tree import cross_axes, smoothed, tangents
from endopilot.types import Anatomy, Centerline, VesselTree

STEP_MM, SIGMA_MM, END_MM = 0.5, 2.0, 3.0
SHARP_PER_MM, BENDS_APART_MM = 0.2, 3.0
"""A bend is sharp from this curvature on, 1/mm; two peaks of curvature nearer than this count once, mm."""
WINDOW_MM, CATHETER_MM = 20.0, 10.0
"""Length over which tortuosity is taken; abscissa at which the vessel is compared with the catheter's axis, mm."""
BRANCH_MM, STUB_MM = 10.0, 4.0
"""Ends farther than this from where they leave count as branches; stubs shorter than the second make no fork, mm."""
FORK_RADII = 2.0
"""Length before and beyond a fork over which directions are taken, in radii of the parent at the fork."""
DIRECTIONS = 32
"""Directions in which a cross-section is measured."""


@dataclass(frozen=True, eq=False)
class _Fork:
    """A fork: index of the arriving branch, of the one that carries it on, and of the others."""

    arriving: int
    onwards: int
    sides: tuple[int, ...]


def vessel_shape(anatomy: Anatomy) -> dict[str, list[float]]:
    """Return every quantity of an anatomy; a list holds one value, or one for each fork, and is empty where it is not
    defined.

    Lengths are in mm, curvature and torsion in 1/mm, angles in degrees; κ·r is curvature times lumen radius.
    """
    tree = anatomy.tree
    path = tree.longest_path()
    bends, twists, radius, whole = curvature_and_torsion(path)
    peaks = find_peaks(bends, height=SHARP_PER_MM, distance=round(BENDS_APART_MM / STEP_MM))[0]
    forks = list(_forks(tree))
    return {
        "curvature p95, 1/mm": [float(np.quantile(bends, 0.95))],
        "curvature peaks > 0.2 in 100 mm": [100.0 * len(peaks) / (STEP_MM * len(bends))],
        "largest κ·r": [float((bends * radius).max())],
        "median absolute torsion, 1/mm": [float(np.median(np.abs(twists)))],
        "total turn, °": [float(np.rad2deg(STEP_MM * bends.sum()))],
        "tortuosity in 20 mm, p95": tortuosity_p95(whole),
        "side-branch angle, °": [angle(tree, fork.arriving, side) for fork in forks for side in fork.sides],
        "parent's deflection at branches, °": [angle(tree, fork.arriving, fork.onwards) for fork in forks],
        "side / parent radius": [_calibre(tree, fork, side) for fork in forks for side in fork.sides],
        "non-circularity": non_circularity(anatomy, path),
        "catheter against vessel at 10 mm, °": _catheter_angle(anatomy, path),
        "branches > 10 mm": [float(len(_long_ends(tree)))],
        **_left_main_fork(tree),
    }


def curvature_and_torsion(
    path: Centerline,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "m 3"]]:
    """Return curvature and torsion (1/mm) and radius (mm) every `STEP_MM` along a path without its ends, and the whole
    resampled and blurred path.
    """
    at = np.arange(path.abscissa[0], path.abscissa[-1], STEP_MM)
    even = np.stack([np.interp(at, path.abscissa, axis) for axis in path.points.T], axis=1)
    line = smoothed(even, SIGMA_MM / STEP_MM)
    first = np.gradient(line, STEP_MM, axis=0)
    second = np.gradient(first, STEP_MM, axis=0)
    third = np.gradient(second, STEP_MM, axis=0)
    cross = np.cross(first, second)
    size = np.linalg.norm(cross, axis=1)
    bends = size / np.maximum(np.linalg.norm(first, axis=1), 1e-9) ** 3
    twists = np.einsum("ij,ij->i", cross, third) / np.maximum(size, 1e-9) ** 2
    inner = slice(round(END_MM / STEP_MM), -round(END_MM / STEP_MM) or None)
    return bends[inner], twists[inner], np.interp(at, path.abscissa, path.radius)[inner], line


def tortuosity_p95(line: Float[np.ndarray, "n 3"]) -> list[float]:
    """Return the 95th percentile of length over chord in windows of `WINDOW_MM`; empty for a shorter line."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = round(WINDOW_MM / STEP_MM)
    if len(line) <= count:
        return []
    chord = np.linalg.norm(line[count:] - line[:-count], axis=1)
    return [float(np.quantile((along[count:] - along[:-count]) / np.maximum(chord, 1e-9), 0.95))]


def _forks(tree: VesselTree) -> Iterator[_Fork]:
    """Return the forks; the branch with the longest way on to an end carries its parent on."""
    reach = _reach(tree)
    for index, branch in enumerate(tree.branches):
        end = float(branch.centerline.abscissa[-1])
        children = [child for child in tree.children(index) if reach[child] - end > STUB_MM]
        if len(children) > 1:
            onwards = max(children, key=lambda child: reach[child])
            yield _Fork(index, onwards, tuple(child for child in children if child != onwards))


def _reach(tree: VesselTree) -> list[float]:
    """Return the farthest abscissa behind each branch, mm."""
    reach = [float(branch.centerline.abscissa[-1]) for branch in tree.branches]
    for index in reversed(range(len(tree.branches))):
        parent = tree.branches[index].parent
        if parent >= 0:
            reach[parent] = max(reach[parent], reach[index])
    return reach


def _long_ends(tree: VesselTree) -> list[int]:
    """Return the ends whose own course, from where it leaves the branch that goes on, is longer than `BRANCH_MM`."""
    reach = _reach(tree)
    found = []
    for leaf in tree.leaves():
        start = leaf
        while tree.branches[start].parent >= 0 and reach[tree.branches[start].parent] == reach[leaf]:
            start = tree.branches[start].parent
        if reach[leaf] - float(tree.branches[start].centerline.abscissa[0]) > BRANCH_MM:
            found.append(leaf)
    return found


def _at(line: Centerline, abscissa: float) -> Float[np.ndarray, "3"]:
    return np.array([np.interp(abscissa, line.abscissa, axis) for axis in line.points.T])


def angle(tree: VesselTree, arriving: int, branch: int) -> float:
    """Return the angle between a parent's direction before a fork and a branch's beyond it, degrees.

    Both are chords over `FORK_RADII` radii of the parent at the fork; where less is there, over what there is.
    """
    parent = tree.path(arriving)
    end, reach = float(parent.abscissa[-1]), FORK_RADII * float(parent.radius[-1])
    return angle_between(parent.points[-1] - _at(parent, end - reach), _beyond(tree, branch, reach))


def _beyond(tree: VesselTree, branch: int, reach: float) -> Float[np.ndarray, "3"]:
    line = tree.branches[branch].centerline
    return _at(line, float(line.abscissa[0]) + reach) - line.points[0]


def angle_between(one: Float[np.ndarray, "3"], two: Float[np.ndarray, "3"]) -> float:
    """Return the angle between two directions, degrees."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)))


def _calibre(tree: VesselTree, fork: _Fork, side: int) -> float:
    """Return a branch's median radius over 6 mm beyond the parent's lumen, over the parent's before the fork."""
    parent, line = tree.path(fork.arriving), tree.branches[side].centerline
    end, wide = float(parent.abscissa[-1]), float(parent.radius[-1])
    own = (line.abscissa >= end + 1.5 * wide) & (line.abscissa <= end + 1.5 * wide + 6.0)
    before = (parent.abscissa >= end - 4.0) & (parent.abscissa <= end - 1.0)
    if not own.any() or not before.any():
        return float(line.radius[-1] / wide)
    return float(np.median(line.radius[own]) / np.median(parent.radius[before]))


def non_circularity(anatomy: Anatomy, path: Centerline) -> list[float]:
    """Return the median over cross-sections of the relative spread of the wall's distance from their centre.

    Every 2 mm a plane across the path is cut in `DIRECTIONS`; the section's centre is its mean. Sections near a fork or
    an end, where the wall is open, are left out.
    """
    tree, lumen = anatomy.tree, anatomy.distance_map
    places = [float(b.centerline.abscissa[-1]) for b in tree.branches] + [0.0]
    at = np.arange(path.abscissa[0] + 4.0, path.abscissa[-1] - 4.0, 2.0)
    radius = np.interp(at, path.abscissa, path.radius)
    on_path = np.array([np.abs(at - place) for place in places]).min(axis=0)
    at, radius = at[on_path > 2.5 * radius], radius[on_path > 2.5 * radius]
    if len(at) == 0:
        return []
    centre = np.stack([np.interp(at, path.abscissa, axis) for axis in path.points.T], axis=1)
    direction = np.stack([np.interp(at, path.abscissa, axis) for axis in tangents(path.points).T], axis=1)
    one, two = cross_axes(direction / np.linalg.norm(direction, axis=1, keepdims=True))
    turn = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.cos(turn)[:, None] * one[:, None, :] + np.sin(turn)[:, None] * two[:, None, :]
    reach = np.linspace(0.0, 2.0, 41)
    points = centre[:, None, None, :] + reach[:, None] * radius[:, None, None, None] * rays[:, :, None, :]
    depth = sample(lumen, points.reshape(-1, 3)).reshape(points.shape[:3])
    outside = depth < 0
    last = np.argmax(outside, axis=2)
    closed = np.asarray(outside.any(axis=2)) & (last > 0)
    whole = np.asarray(closed.all(axis=1))
    i, j = np.indices(last.shape)
    inner, outer = depth[i, j, np.maximum(last - 1, 0)], depth[i, j, last]
    share = np.maximum(last - 1, 0) + inner / np.maximum(inner - outer, 1e-9)
    wall = (share * reach[1] * radius[:, None])[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    size = np.linalg.norm(wall - wall.mean(axis=1, keepdims=True), axis=2)
    spread = (size.std(axis=1) / size.mean(axis=1))[whole]
    return [float(np.median(spread))] if len(spread) else []


def _catheter_angle(anatomy: Anatomy, path: Centerline) -> list[float]:
    if path.abscissa[-1] < CATHETER_MM + 2.0:
        return []
    along = _at(path, CATHETER_MM + 1.0) - _at(path, CATHETER_MM - 1.0)
    return [angle_between(anatomy.insertion.direction, along)]


def _left_main_fork(tree: VesselTree) -> dict[str, list[float]]:
    """Return the shape of the left main's fork into LAD and LCx; nothing where the tree names none."""
    names = tree.section_names
    first = {
        name: next((i for i, b in enumerate(tree.branches) if len(b.section) > 1 and names[b.section[1]] == name), None)
        for name in ("6", "11")
    }
    lad, lcx = first["6"], first["11"]
    if lad is None or lcx is None or tree.branches[lad].parent != tree.branches[lcx].parent:
        return {}
    main = tree.branches[lad].parent
    if main < 0:
        return {}
    path = tree.path(main)
    reach = FORK_RADII * float(path.radius[-1])
    return {
        "LM→LCx turn, °": [angle(tree, main, lcx)],
        "LM→LAD turn, °": [angle(tree, main, lad)],
        "LAD–LCx angle, °": [angle_between(_beyond(tree, lad, reach), _beyond(tree, lcx, reach))],
        "left main's length, mm": [float(path.abscissa[-1])],
        "radius at the left main's fork, mm": [float(path.radius[-1])],
    }
