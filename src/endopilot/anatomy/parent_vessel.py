"""Where a coronary artery leaves the aorta, in lumens that hold a piece of the aorta too, or both coronary arteries."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import center_of_mass, distance_transform_edt

from endopilot.anatomy.lumen_graph import LumenGraph
from endopilot.imaging.grid import connected_components
from endopilot.types import DistanceMap, Insertion

Vessel = Literal["rca", "lca", "generic"]

PARENT_RATIO = 2.5
"""A lumen this many times wider than the tree's median, at its inlet, is the parent vessel."""

PARENT_RADIUS_MM = (3.5, 6.0)
"""The aorta's root is never narrower than the first, a coronary artery never wider than the second (an aneurysm is)."""

AORTA_RADIUS_MM = 7.0
"""A lumen with a coronary artery that is as wide as this somewhere holds the aorta itself."""

GRID_MM = 0.6
"""Grid spacing at which the parent vessel is looked for, mm."""

COMPARABLE = 0.25
"""A piece with at least this share of the largest one's size may be the other coronary artery."""


def piece_on_side(
    sizes: Float[np.ndarray, "n"], centres: Float[np.ndarray, "n 3"], vessel: Vessel
) -> tuple[int, list[int]]:
    """Return which of several separate lumens is the vessel, and which others are nearly as large.

    The right coronary artery lies to the patient's right of the left one (smaller x in LPS), so among pieces of
    comparable size the side decides; for other vessels it is the largest.

    Args:
        sizes: volumes, or anything that grows with them.
        centres: centres of the pieces, LPS mm.
        vessel: which vessel is wanted.
    """
    large = np.flatnonzero(sizes >= COMPARABLE * sizes.max())
    if vessel == "generic":
        chosen = int(sizes.argmax())
    else:
        across = centres[large, 0] if vessel == "rca" else -centres[large, 0]
        chosen = int(large[across.argmin()])
    return chosen, [int(piece) for piece in large if piece != chosen]


def parent_region(
    distance_map: DistanceMap, inside: Bool[np.ndarray, "nz ny nx"], graph: LumenGraph, usual_mm: float
) -> Bool[np.ndarray, "nz ny nx"] | None:
    """Return the grid points of the parent vessel that the graph's root lies in, or None where it lies in none.

    The parent is what spheres of `PARENT_RATIO` times the usual radius reach, connected and around the root; a bulge
    farther along is an aneurysm and stays.

    Args:
        distance_map: distance to the wall.
        inside: which of its grid points belong to the lumen.
        graph: that lumen, with the paths to the inlet as root.
        usual_mm: median radius along the tree, mm.
    """
    spacing = distance_map.spacing_mm
    wide = float(np.clip(PARENT_RATIO * usual_mm, *PARENT_RADIUS_MM))
    core = inside & (distance_map.values > wide)
    if not core.any():
        return None
    root = graph.points[int(np.flatnonzero(graph.predecessor < 0)[0])]
    index = np.argwhere(core)
    points = distance_map.origin_mm + spacing * index[:, ::-1]
    gap = np.linalg.norm(points - root, axis=1)
    # The inlet lies on the parent's own wall, which is not round: at most about its width away from a centre.
    reach = 2.0 * distance_map.values[tuple(index.T)] + 2.0 * spacing
    touching = np.flatnonzero(gap < reach)
    if len(touching) == 0:
        return None
    labels = connected_components(core, corners=True)
    own = labels == labels[tuple(index[touching[gap[touching].argmin()]])]
    return inside & (np.asarray(distance_transform_edt(~own)) * spacing < wide + spacing)


def ostium_beyond(
    distance_map: DistanceMap,
    inside: Bool[np.ndarray, "nz ny nx"],
    parent: Bool[np.ndarray, "nz ny nx"],
    graph: LumenGraph,
    vessel: Vessel,
) -> Insertion | None:
    """Return where the vessel leaves its parent: the largest one, or of both coronary arteries the one wanted.

    Args:
        distance_map: distance to the wall.
        inside: which of its grid points belong to the lumen.
        parent: which belong to the parent vessel.
        graph: the lumen with the paths to the inlet as root.
        vessel: which vessel is wanted.
    """
    origin, spacing = distance_map.origin_mm, distance_map.spacing_mm
    labels = connected_components(inside & ~parent, corners=True)
    if (count := int(labels.max())) == 0:
        return None
    places = np.rint((graph.points - origin) / spacing).astype(int)[:, ::-1]
    piece = labels[tuple(places.T)]
    # How far a piece reaches beyond the parent distinguishes a vessel from a crust of the parent's wall.
    reach = np.array(
        [np.ptp(graph.length[piece == i]) if (piece == i).any() else 0.0 for i in range(1, count + 1)], dtype=float
    )
    centres = np.array(center_of_mass(labels > 0, labels, range(1, count + 1)))[:, ::-1]
    chosen, _ = piece_on_side(reach, origin + spacing * centres, vessel)
    tip = int(np.where(piece == chosen + 1, graph.length, -1.0).argmax())
    path = [tip]
    while graph.predecessor[path[-1]] >= 0 and piece[path[-1]] == chosen + 1:
        path.append(int(graph.predecessor[path[-1]]))
    line = graph.points[path[::-1]]
    # The direction is left open: the refined centerline gives it better than this grid.
    return Insertion(line[0].copy(), np.zeros(3)) if len(line) >= 3 else None
