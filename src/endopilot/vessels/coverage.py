"""Nothing of a lumen is lost unsaid: what is too thin to follow is widened, and what the tree does not reach is stated.
The yardstick is the middle of the mask (`traced_lines`), which has every branch of one voxel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.errors import place_text
from endopilot.imaging.grid import connected_components
from endopilot.types import Volume
from endopilot.vessels.medial_lines import MedialLines
from endopilot.vessels.remarks import longest_first
from endopilot.vessels.surface import MAXIMUM_GRID_POINTS, Surface, blur_voxels, smooth_level

_REACH_VOXELS = 1.5  # the tree reaches so many voxels beyond its radius: the mask's middle is not smooth

_NARROWEST, _NARROWEST_STEPS = 0.75, 1.2
"""A stretch is widened to a radius of this many widths of the wall's blur, and grid steps: such a tube has no gap.
Between two wide faces it may have: there the radius grows by a quarter until the wall carries on."""

_MOST_GROWTHS = 4

_MOST_VOXELS, _MOST_INSIDE = 10_000_000, 300_000
"""A wall becomes at most as many voxels, and as many inside it: their middle is found in 4 s. Thin vessels stay whole
in coarser voxels, since all that the wall touches are kept."""

_DIAGONAL = 0.87  # a ball of this many grid steps in radius holds a grid point wherever it lies (√3/2)


@dataclass(frozen=True, eq=False)
class Stretch:
    """A connected part of a mask's middle: its nodes and length, and the length of what lies beyond as seen from the
    widest place, mm. It begins at `place`, LPS mm."""

    nodes: Int[np.ndarray, "_"]
    length_mm: float
    beyond_mm: float
    place: Float[np.ndarray, "3"]


def voxelised(surface: Surface, step_mm: float) -> Volume:
    """Return all voxels (edge `step_mm`, or larger) that a closed wall holds or touches: no thin neck is lost."""
    extent = np.ptp(surface.vertices, axis=0)
    most = max(float(np.prod(extent + 4 * step_mm)) / _MOST_VOXELS, abs(surface.volume) / _MOST_INSIDE)
    shell = touched(surface, max(step_mm, most ** (1 / 3)), 2)
    nz, ny, nx = shell.voxels.shape
    inside = surface.inside((nz, ny, nx), shell.origin_mm, float(shell.spacing_mm[0]))
    return replace(shell, voxels=inside | shell.voxels)


def touched(surface: Surface, step_mm: float, margin: int) -> Volume:
    """Return the voxels of edge `step_mm` that a surface touches, in its box with a margin in voxels."""
    origin = surface.vertices.min(axis=0) - margin * step_mm
    size = np.ceil(np.ptp(surface.vertices, axis=0) / step_mm).astype(int) + 2 * margin + 1
    voxels = np.zeros(tuple(size[::-1]), dtype=bool)
    fine = surface.refined(0.7 * step_mm)
    samples = np.concatenate([fine.vertices, fine.vertices[fine.faces].mean(axis=1)])
    index = np.rint((samples - origin) / step_mm).astype(int)
    voxels[index[:, 2], index[:, 1], index[:, 0]] = True
    return Volume(voxels, np.full(3, step_mm), origin, np.eye(3))


def widened(mask: Volume, lines: MedialLines, minimum_mm: float) -> tuple[Volume, Float[np.ndarray, "n 3"], list[str]]:
    """Return a connected mask with a tube wherever it is too thin for the wall and the grid to carry it on, where, and
    remarks. A thin stretch with less than `minimum_mm` on it and beyond it stays as it is."""
    edges = mask.spacing_mm
    extent = np.array(mask.voxels.shape[::-1]) * edges
    step = max(0.5 * float(edges.min()), float(np.prod(extent + 2) / MAXIMUM_GRID_POINTS) ** (1 / 3))
    enough = max(0.1, _DIAGONAL * step / float(edges.max()) - 0.5)
    thin = _thin(mask, lines, enough)
    wanted = [s for s in stretches(lines, thin) if s.length_mm + s.beyond_mm >= minimum_mm]
    if not wanted:
        return mask, np.empty((0, 3)), []
    result = mask
    narrowest = _NARROWEST * blur_voxels(edges[::-1])
    reach = narrowest = np.maximum(narrowest, _NARROWEST_STEPS * step / edges[::-1])
    asked = np.concatenate([s.nodes for s in wanted])
    touching = lines.edges[np.isin(lines.edges, asked).any(axis=1)]
    nodes = np.unique(np.concatenate([asked, touching.ravel()]))
    for growth in range(_MOST_GROWTHS):
        if growth:
            nodes = asked[_thin(result, lines, enough)[asked]]
            reach = 1.25 * reach
        if len(nodes) == 0:
            break
        result = replace(mask, voxels=result.voxels.copy())
        _draw_balls(result.voxels, lines.index[nodes], reach)
    radius = float((narrowest * edges[::-1]).mean())
    return result, lines.points[asked], _widened_text(wanted, radius)


def unreached(
    lines: MedialLines, points: Float[np.ndarray, "m 3"], radius: Float[np.ndarray, "m"], voxel_mm: float
) -> list[Stretch]:
    """Return the parts of a mask's middle that a tree, given by points close together, does not reach."""
    gap, nearest = map(np.asarray, KDTree(points).query(lines.points))
    return stretches(lines, gap > radius[nearest] + _REACH_VOXELS * voxel_mm, gap)


def stretches(
    lines: MedialLines, chosen: Bool[np.ndarray, "n"], order: Float[np.ndarray, "n"] | None = None
) -> list[Stretch]:
    """Return connected parts of chosen middle points, longest first, from the lowest `order` or the widest place on."""
    length, behind = lines.tree.length, lines.behind_mm
    order = length if order is None else order
    found = []
    for nodes in lines.parts(chosen):
        own = float(lines.share_mm[nodes].sum())
        beyond = max(0.0, float(behind[nodes[length[nodes].argmin()]]) - own)
        found.append(Stretch(nodes, own, beyond, lines.points[nodes[order[nodes].argmin()]]))
    return sorted(found, key=lambda stretch: -(stretch.length_mm + stretch.beyond_mm))


def left_out_text(left: list[Stretch], ostium: Float[np.ndarray, "3"], reach_mm: float) -> list[str]:
    """Return remarks on parts that a tree does not reach; up to `reach_mm` from the ostium they lie behind it."""
    found = []
    for stretch in left:
        behind = " behind the ostium" if np.linalg.norm(stretch.place - ostium) < reach_mm else ""
        text = f"{stretch.length_mm:.0f} mm of the lumen{behind} from {place_text(stretch.place)} are not in the tree"
        found.append((stretch.length_mm, text))
    return longest_first(found, "{} bumps and twigs, {:.0f} mm together, are no branches")


def record(lines: MedialLines, wide: Float[np.ndarray, "m 3"], left: list[Stretch]) -> dict[str, float]:
    """Return the balance that `anatomy.json` keeps, mm: length = reached + widened (at places `wide`) + left out."""
    out = np.zeros(len(lines.points), dtype=bool)
    thin = np.asarray(KDTree(wide).query(lines.points)[0]) < lines.edges_mm.min() if len(wide) else out
    for stretch in left:
        out[stretch.nodes] = True
    share = lines.share_mm
    parts = {
        "reached_mm": share[~out & ~thin].sum(),
        "widened_mm": share[thin & ~out].sum(),
        "left_out_mm": share[out].sum(),
    }
    return {"length_mm": round(float(share.sum()), 1), **{name: round(float(v), 1) for name, v in parts.items()}}


def _draw_balls(
    voxels: Bool[np.ndarray, "nz ny nx"], centres: Int[np.ndarray, "n 3"], reach: Float[np.ndarray, "3"]
) -> None:
    span = np.ceil(reach).astype(int)
    ball = np.array(list(np.ndindex(*(2 * span + 1)))) - span
    ball = ball[(((ball / reach) ** 2).sum(axis=1)) <= 1.0]
    drawn = (centres[:, None, :] + ball).reshape(-1, 3)
    drawn = drawn[((drawn >= 0) & (drawn < voxels.shape)).all(axis=1)]
    voxels[tuple(drawn.T)] = True


def _thin(mask: Volume, lines: MedialLines, enough: float) -> Bool[np.ndarray, "n"]:
    """Return which points of a mask's middle the smooth wall does not carry on. Voxel centres lie up to half a diagonal
    off the axis, so that the deepest one around a point stands for it."""
    level, corner = smooth_level(mask)
    core = connected_components(level > enough, corners=True)
    around = (lines.index[:, None, :] - corner - 1 + np.array(list(np.ndindex(3, 3, 3)))).reshape(-1, 3)
    depth = level[tuple(around.T)].reshape(-1, 27)
    part = core[tuple(around.T)].reshape(-1, 27)[np.arange(len(depth)), depth.argmax(axis=1)]
    thin = part == 0
    apart = lines.edges[part[lines.edges[:, 0]] != part[lines.edges[:, 1]]]
    thin[apart.ravel()] = True
    return thin


def _widened_text(wide: list[Stretch], radius_mm: float) -> list[str]:
    found = []
    for stretch in wide:
        beyond = f", {stretch.beyond_mm:.0f} mm of vessel lie beyond it" if stretch.beyond_mm >= 1.0 else ""
        kind = f"{'neck' if beyond else 'thin branch'} of {stretch.length_mm:.1f} mm from {place_text(stretch.place)}"
        text = f"a {kind} was widened to a radius of {radius_mm:.1f} mm or more{beyond}"
        found.append((stretch.length_mm + stretch.beyond_mm, text))
    return longest_first(found, "{} more thin places, {:.0f} mm together, were widened likewise")
