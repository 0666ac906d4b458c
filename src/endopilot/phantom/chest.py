"""What surrounds a coronary artery in the chest: organs on a coarse grid, and small vessels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import distance_transform_edt, gaussian_filter

from endopilot.atlas import curves as shape
from endopilot.atlas import heart_reference as reference
from endopilot.atlas.heart_reference import HeartFit, chamber, ellipsoid, reference_courses, tube
from endopilot.lines import length_along
from endopilot.types import Centerline, VesselTree

_KNOTS = 16  # points of each of the left reference courses
_SLAB = 8  # slices of the coarse grid whose depths are computed at once: they stay in the processor's cache


@dataclass(frozen=True, eq=False)
class Organ:
    """One organ of a tissue on the coarse grid, by its `depth`, mm, positive inside, indexed [k, j, i]; it keeps
    `clearance_mm` from coronary lumens, None where it may touch them."""

    name: str
    depth: Float[np.ndarray, "nz ny nx"]
    clearance_mm: float | None = None


def is_left(tree: VesselTree) -> bool:
    """Return whether this is a left coronary tree by its section names: it begins in the left main artery."""
    return tree.section_names[tree.branches[0].section[0]] == "5"


def place(tree: VesselTree) -> HeartFit:
    """Fit the reference heart to the tree; without section labels it is a right one, its crux at 60 % of the path."""
    if is_left(tree):
        courses = reference_courses().copy()
        # Onto the aorta's surface, away from its axis, which passes here at the ostium's height and is nearly z.
        outward = courses[0] - [14.5, 5.0, 0.0]
        outward[2] = 0.0
        courses[0] += chamber(courses[:1], "aorta")[0] * outward / np.linalg.norm(outward)
        lad, lcx = courses[:_KNOTS], courses[_KNOTS : 2 * _KNOTS]
        fork = int(np.linalg.norm(lad - lcx[0], axis=1).argmin())
        lcx = np.concatenate([lad[: fork + 1], lcx[1:]])
        lines = [line.points for line in main_paths(tree)]
        return reference.fit_heart_along(lines, [shape.curve_through(course) for course in (lad, lcx)])
    line = tree.longest_path()
    last = tree.section_names[tree.branches[tree.longest_leaf()].section[-1]]
    return reference.fit_heart(line.points, _crux_abscissa(tree), last)


def main_paths(tree: VesselTree) -> tuple[Centerline, ...]:
    """Return the paths from the ostium along the main vessels: of a left tree LAD and LCx, of another the longest."""
    if not is_left(tree):
        return (tree.longest_path(),)
    ends = {leaf: tree.section_names[tree.branches[leaf].section[-1]] for leaf in tree.leaves()}
    paths = []
    for sections in (("8", "7", "6"), ("15", "13", "11")):
        found = next((name for name in sections if name in ends.values()), None)
        leaves = [leaf for leaf, name in ends.items() if found in (name, None)]
        paths.append(tree.path(max(leaves, key=lambda leaf: tree.branches[leaf].centerline.abscissa[-1])))
    return tuple(paths)


def organs(
    heart: HeartFit,
    grid: Float32[np.ndarray, "nz ny nx 3"],
    around_vessels: Float[np.ndarray, "nz ny nx"],
    generator: np.random.Generator,
    appendage_mm: float = 0.0,
) -> tuple[Organ, ...]:
    """Return the organs in painting order, their surfaces uneven at random. `around_vessels` is the signed distance to
    the surface of the fat that the coronaries need; the left atrial appendage, wider by `appendage_mm` but at 0,
    touches their walls."""
    slabs = [
        heart.to_reference(slab.reshape(-1, 3)).reshape(slab.shape).astype(np.float32)
        for slab in np.split(grid, range(_SLAB, len(grid), _SLAB))
    ]
    spacing_mm = float(grid[0, 0, 1, 0] - grid[0, 0, 0, 0])

    def shaped(depth: Callable[..., np.ndarray], *of: Any) -> Float[np.ndarray, "nz ny nx"]:
        return np.concatenate([depth(slab, *of) for slab in slabs])

    def uneven(amplitude_mm: float, extent_mm: float) -> Float32[np.ndarray, "nz ny nx"]:
        noise = gaussian_filter(generator.standard_normal(grid.shape[:3], dtype=np.float32), extent_mm / spacing_mm)
        return amplitude_mm * noise / noise.std()

    rough, wavy = uneven(0.7, 3.0), uneven(0.8, 10.0)
    lv_wall, lv = shaped(chamber, "left_ventricle_wall") + wavy, shaped(chamber, "left_ventricle") + 1.3 * rough
    rv, ra, la = shaped(chamber, "right_ventricle"), shaped(chamber, "right_atrium"), shaped(chamber, "left_atrium")
    rv_wall, rv, ra, la = rv + 3 + wavy, rv + wavy + rough, ra + 0.7 * rough, la + 0.5 * wavy
    aorta, pulmonary = shaped(chamber, "aorta"), shaped(chamber, "pulmonary_artery")
    cava, lower_cava = shaped(tube, _UPPER_CAVA, (8, 8.5, 9)), shaped(tube, _LOWER_CAVA, (10, 11, 11))
    veins = np.max([shaped(tube, line, (6, 5, 3)) for line in _PULMONARY_VEINS], axis=0)
    appendage = shaped(chamber, "left_appendage") + appendage_mm + 0.5 * wavy if appendage_mm > 0 else la
    epicardium = np.max([lv_wall, rv_wall, ra + 2, np.maximum(la, appendage) + 2], axis=0)
    large_vessels = np.max([aorta, pulmonary, cava, lower_cava], axis=0)
    pericardium = _close(np.max([epicardium + 2.5, large_vessels + 3, around_vessels], axis=0), 26.0, spacing_mm)
    bone = shaped(_bone)
    found = (
        Organ("chest wall", 0.6 * wavy - shaped(_chest)),
        Organ("lung vessels", veins),
        Organ("liver", shaped(ellipsoid, (-45, -5, -141), (120, 95, 66), (1.0, 0.0, 0.0)) + wavy),
        Organ("stomach", shaped(ellipsoid, (80, -5, -122), (55, 60, 42), (1.0, 0.0, 0.0)) + wavy),
        Organ("cortical bone", bone),
        Organ("spongy bone", bone - 1.6 + 0.4 * rough),
        Organ("fat", pericardium + 0.5 * wavy),
        Organ("descending aorta", shaped(tube, _DESCENDING_AORTA, (11, 11, 10.5))),
        Organ("myocardium", epicardium, 0.9),
        Organ("vessel wall", np.maximum(aorta, pulmonary) + 1.3),
        Organ("right atrium", np.maximum(ra, lower_cava), 2.2),
        Organ("vena cava", cava, 2.2),
        Organ("right ventricle", np.maximum(np.minimum(rv, -1.0 - lv_wall), pulmonary), 2.2),
        Organ("left atrium", np.maximum(la, veins), 2.2),
        *([Organ("left atrium", np.minimum(appendage, -1.3 - large_vessels), 0.8)] if appendage_mm > 0 else []),
        Organ("left ventricle", lv, 2.2),
        Organ("aorta", aorta),
    )
    return tuple(Organ(o.name, (heart.scale * o.depth).astype(np.float32), o.clearance_mm) for o in found)


def other_coronary(heart: HeartFit, tree: VesselTree) -> tuple[Centerline, ...]:
    """Return the first part of the other coronary artery, by mean diameters of Dodge 1992: left main (4.5 mm), LAD (3.7
    mm) and LCx (3.4 mm), or the right one (4.0 mm) nearly to the acute margin."""
    lines = []
    for waypoints, begin, end in _RIGHT_CORONARY if is_left(tree) else _LEFT_CORONARY:
        points = heart.from_reference(shape.curve_through(np.array(waypoints, dtype=float)))
        along = length_along(points)
        radius = np.interp(along, [0.0, along[-1]], [begin, end])
        lines.append(Centerline(points, radius, along, shape.parallel_normals(shape.tangents(points))))
    return tuple(lines)


def cardiac_veins(heart: HeartFit, tree: VesselTree, *, touching: bool = False) -> tuple[Centerline, ...]:
    """Return veins that touch the artery: beside segments 2 and 3, beside the distal artery, the coronary sinus."""
    line, crux = tree.longest_path(), _crux_abscissa(tree)
    lines = []
    if is_left(tree):
        # The great cardiac vein climbs beside the anterior descending artery, from 25 to 60 % of its course.
        crux = 0.6 * float(line.abscissa[-1])
    for begin, end, angle, gap, radius in (
        (0.35 * crux, 0.97 * crux, 2.2, 2.3, 1.1),
        (1.06 * crux, 1.6 * crux, 0.6, 1.8, 1.3),
    ):
        inside = (line.abscissa >= begin) & (line.abscissa <= min(end, line.abscissa[-1] - 10.0))
        if inside.sum() < 20:
            continue
        points, tangent = line.points[inside], shape.tangents(line.points[inside])
        side = np.cross(tangent, line.normals[inside])
        across = np.cos(angle) * line.normals[inside] + np.sin(angle) * side
        points = points + (line.radius[inside] + radius + (_TOUCHING_MM if touching else gap))[:, None] * across
        lines.append(_vein(points, radius, radius))
    sinus = heart.from_reference(shape.curve_through(np.array(_CORONARY_SINUS, dtype=float)))
    lines.append(_vein(sinus, 4.2, 2.2))
    return tuple(lines)


def bypass_graft(heart: HeartFit, tree: VesselTree) -> Centerline:
    """Return a saphenous vein graft of 4 mm from the ascending aorta: to the middle of the LAD or to the distal RCA."""
    line = main_paths(tree)[0]
    anastomosis = 0.5 * float(line.abscissa[-1]) if is_left(tree) else 0.85 * _crux_abscissa(tree)
    target = line.points[int(np.searchsorted(line.abscissa, anastomosis))]
    course = heart.from_reference(np.array(_LEFT_GRAFT if is_left(tree) else _RIGHT_GRAFT, dtype=float))
    return _vein(shape.curve_through(np.concatenate([course, target[None]])), 2.1, 1.5)


def _vein(points: Float[np.ndarray, "n 3"], begin_mm: float, end_mm: float) -> Centerline:
    along = length_along(points)
    radius = np.linspace(begin_mm, end_mm, len(points))
    return Centerline(points, radius, along, shape.parallel_normals(shape.tangents(points)))


def _crux_abscissa(tree: VesselTree) -> float:
    """Return the abscissa where segment 3 ends, or 60 % of the path where there are no such labels, mm."""
    if "3" in tree.section_names:
        third = tree.section_names.index("3")
        ends = [b.centerline.abscissa[b.section == third].max() for b in tree.branches if np.any(b.section == third)]
        if ends:
            return float(max(ends))
    return 0.6 * float(tree.longest_path().abscissa[-1])


_UPPER_CAVA = [(-16, 20, -12), (-14, 20, 15), (-12, 17, 60)]
_LOWER_CAVA = [(-19, 26, -42), (-24, 30, -70), (-26, 31, -110)]
_DESCENDING_AORTA = [(36, 62, 80), (34, 62, -10), (26, 64, -120)]
_PULMONARY_VEINS = [
    [(6, 48, -4), (-15, 54, 0), (-45, 48, 6)],
    [(8, 48, -16), (-12, 58, -22), (-42, 66, -32)],
    [(44, 46, -2), (62, 54, 4), (90, 50, 14)],
    [(44, 46, -16), (60, 58, -24), (88, 64, -36)],
]
_TOUCHING_MM = 0.7  # gap between the lumens of an artery and a vein that touches it, mm
_LEFT_GRAFT = [(9, -9, 22), (9, -20, 27), (16, -36, 21), (28, -44, 10), (44, -48, -6)]
_RIGHT_GRAFT = [(2, -8, 20), (-6, -19, 20), (-26, -22, 6), (-38, -20, -14), (-41, -14, -36)]
"""From within the aorta's front wall over the pulmonary trunk, and beside the right atrium."""
_CORONARY_SINUS = [(-6, 20, -47), (4, 29, -48), (18, 36, -44), (33, 37, -38), (48, 27, -28)]
_RIGHT_CORONARY = ((reference.TO_CRUX[:7].tolist(), 2.0, 1.8),)
_LEFT_CORONARY = (
    ([(26, 14, 2), (31, 12, 2.5), (36, 8, 2), (40, 3, 0)], 2.25, 2.1),
    ([(40, 3, 0), (45, -6, -4), (50, -17, -8), (54, -29, -13), (57, -42, -20), (60, -54, -30)], 1.85, 1.0),
    ([(40, 3, 0), (45.5, 4, -5), (50, 10, -11), (53, 17, -20), (52, 23, -31), (48, 28, -42)], 1.7, 0.9),
)


def _close(depth: Float[np.ndarray, "nz ny nx"], width_mm: float, spacing_mm: float) -> Float[np.ndarray, "nz ny nx"]:
    """Return a shape with its gaps and grooves filled up to `width_mm` (morphological closing), as signed distance."""
    half = 0.5 * width_mm
    grown = np.where(depth > 0, half, half - spacing_mm * np.asarray(distance_transform_edt(depth <= 0)))
    shrunk = spacing_mm * np.asarray(distance_transform_edt(grown > 0)) - half
    # The transforms count whole voxels: smooth their steps.
    return gaussian_filter(np.maximum(shrunk, np.clip(depth, -width_mm, width_mm)), 0.8)


def _chest(x: Float[np.ndarray, "nz ny nx 3"]) -> Float[np.ndarray, "nz ny nx"]:
    across, deep = (x[..., 0] - 12) / 135, (x[..., 1] - 12) / 76
    return 76 * (1 - np.sqrt(across**2 + deep**2))


def _bone(x: Float[np.ndarray, "nz ny nx 3"]) -> Float[np.ndarray, "nz ny nx"]:
    sternum = 4.5 - np.linalg.norm(
        np.stack([np.maximum(np.abs(x[..., 0] - 8) - 11, 0), x[..., 1] + 71 + 0.08 * x[..., 2]], axis=-1), axis=-1
    )
    spine = 19 - np.linalg.norm(x[..., :2] - np.array([6.0, 85.0]), axis=-1)
    disc = np.abs((x[..., 2] + 10) % 28 - 14) - 11
    spine = np.minimum(spine, -disc)
    turn = np.linspace(0.15 * np.pi, 0.85 * np.pi, 9)
    ribs = [
        tube(
            x,
            np.stack(
                [12 + side * 128 * np.sin(turn), 12 - 79 * np.cos(turn), level + 16 * np.cos(turn)], axis=1
            ).tolist(),
            [4.5] * len(turn),
        )
        for level in (20.0, -8.0, -36.0, -64.0, -92.0)
        for side in (-1, 1)
    ]
    return np.max([sternum, spine, *ribs], axis=0)
