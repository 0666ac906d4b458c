"""What surrounds a right coronary artery in the chest: signed distances of organs on a coarse grid.

Organs are placed in the reference frame of the atlas (LPS axes, right ostium at the origin, mm) and carried to the patient by
the similarity that fits the reference course of the artery to the patient's. Sizes are those of a normal adult in diastole.
All distances are in mm, positive inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation

from endopilot.anatomy import atlas_shape as shape
from endopilot.anatomy.atlas_rca import REFERENCE_TO_CRUX
from endopilot.types import Centerline, VesselTree

AORTIC_RADIUS_MM = 15.5
"""Inner radius of the aortic root at the ostia, mm."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The similarity from the reference frame to the patient: x = origin + scale · rotation · X."""

    origin: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    scale: float

    def points(self, reference: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the patient's position of reference points, mm."""
        return self.origin + self.scale * np.asarray(reference) @ self.rotation.T

    def inverse(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return the reference position of the patient's points, mm."""
        return (points - self.origin) @ self.rotation / self.scale


@dataclass(frozen=True, eq=False)
class Organ:
    """One organ on the coarse grid.

    Attributes:
        name: of which tissue.
        depth: signed distance to its surface, mm, positive inside, indexed [k, j, i].
        clearance_mm: the organ keeps this distance from coronary lumens; None where it may touch them.
    """

    name: str
    depth: Float[np.ndarray, "nz ny nx"]
    clearance_mm: float | None = None


def place(tree: VesselTree) -> Placement:
    """Fit the reference course of the artery, ostium to crux, to the tree's (Kabsch, about the ostium)."""
    line = tree.longest_path()
    along = np.linspace(0.0, _crux_abscissa(tree), 24)
    course = np.stack([np.interp(along, line.abscissa, line.points[:, axis]) for axis in range(3)], axis=1)
    reference = shape.curve_through(REFERENCE_TO_CRUX)
    reference = reference[np.linspace(0, len(reference) - 1, len(along)).round().astype(int)]
    moved = course - course[0]
    u, s, vt = np.linalg.svd(moved.T @ reference)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = float((s * sign).sum() / (reference**2).sum())
    return Placement(course[0], u @ np.diag(sign) @ vt, float(np.clip(scale, 0.6, 1.6)))


def organs(
    placement: Placement,
    grid: Float32[np.ndarray, "nz ny nx 3"],
    around_vessels: Float[np.ndarray, "nz ny nx"],
    generator: np.random.Generator,
) -> tuple[Organ, ...]:
    """Return the organs in painting order, from the chest wall to the blood pools.

    Args:
        placement: from `place`.
        grid: the patient's positions of the coarse grid, mm.
        around_vessels: signed distance to the surface of the fat that the coronaries need, mm.
        generator: random stream of the surfaces' unevenness.
    """
    x = placement.inverse(grid).astype(np.float32)
    spacing_mm = float(grid[0, 0, 1, 0] - grid[0, 0, 0, 0])

    def uneven(amplitude_mm: float, extent_mm: float) -> Float32[np.ndarray, "nz ny nx"]:
        noise = gaussian_filter(generator.standard_normal(x.shape[:3], dtype=np.float32), extent_mm / spacing_mm)
        return amplitude_mm * noise / noise.std()

    rough, wavy = uneven(0.9, 3.5), uneven(1.0, 10.0)
    lv_wall = _ellipsoid(x, (44, -21, -37), (47, 28, 28), _LV_AXIS) + wavy
    lv = _ellipsoid(x, (42, -17, -36), (38, 18.5, 18.5), _LV_AXIS) + rough
    rv_wall = np.maximum(_ellipsoid(x, (10, -25, -42), (41, 25, 22), _RV_AXIS), _tube(x, _RVOT, (15, 14, 14))) + wavy
    rv = np.maximum(_ellipsoid(x, (10, -25, -42), (38, 22, 19), _RV_AXIS), _tube(x, _RVOT, (12, 11, 12))) + rough
    ra = _ellipsoid(x, (-19, 18, -29), (27, 21, 22), (0.1, 0.2, 1.0)) + 0.7 * rough
    la = _ellipsoid(x, (24, 41, -9), (27, 17, 22), (1.0, 0.1, 0.1)) + 0.5 * wavy
    aorta, pulmonary = _tube(x, _AORTA, _AORTA_RADIUS), _tube(x, _PULMONARY, (12, 13, 12))
    cava, lower_cava = _tube(x, _UPPER_CAVA, (8, 8.5, 9)), _tube(x, _LOWER_CAVA, (10, 11, 11))
    veins = np.max([_tube(x, line, (6, 5, 3)) for line in _PULMONARY_VEINS], axis=0)
    epicardium = np.max([lv_wall, rv_wall, ra + 2, la + 2], axis=0)
    large_vessels = np.max([aorta, pulmonary, cava, lower_cava], axis=0)
    pericardium = _close(np.max([epicardium + 2.5, large_vessels + 3, around_vessels], axis=0), 16.0, spacing_mm)
    bone = _bone(x)
    found = (
        Organ("chest wall", 0.6 * wavy - _chest(x)),
        Organ("lung vessels", veins),
        Organ("liver", _ellipsoid(x, (-55, -5, -148), (110, 95, 66), (1.0, 0.0, 0.0)) + wavy),
        Organ("stomach", _ellipsoid(x, (75, -5, -128), (55, 60, 42), (1.0, 0.0, 0.0)) + wavy),
        Organ("cortical bone", bone),
        Organ("spongy bone", bone - 1.6 + 0.4 * rough),
        Organ("fat", pericardium + 0.5 * wavy),
        Organ("descending aorta", _tube(x, _DESCENDING_AORTA, (11, 11, 10.5))),
        Organ("myocardium", epicardium, 0.9),
        Organ("vessel wall", np.maximum(aorta, pulmonary) + 1.3),
        Organ("right atrium", np.maximum(ra, lower_cava), 2.2),
        Organ("vena cava", cava, 2.2),
        Organ("right ventricle", np.maximum(np.minimum(rv, -1.0 - lv_wall), pulmonary), 2.2),
        Organ("left atrium", np.maximum(la, veins), 2.2),
        Organ("left ventricle", lv, 2.2),
        Organ("aorta", aorta),
    )
    return tuple(Organ(o.name, (placement.scale * o.depth).astype(np.float32), o.clearance_mm) for o in found)


def left_coronary(placement: Placement) -> tuple[Centerline, ...]:
    """Return the left main with the beginnings of LAD and LCx, after Dodge 1988 and 1992 (diameters 4.5, 3.7, 3.4 mm)."""
    lines = []
    for waypoints, begin, end in _LEFT_CORONARY:
        points = placement.points(shape.curve_through(np.array(waypoints)))
        along = shape.abscissa(points)
        radius = np.interp(along, [0.0, along[-1]], [begin, end])
        lines.append(Centerline(points, radius, along, shape.parallel_normals(shape.tangents(points))))
    return tuple(lines)


def cardiac_veins(placement: Placement, tree: VesselTree) -> tuple[Centerline, ...]:
    """Return veins: the small cardiac vein beside segments 2 and 3, a vein beside the distal artery, the coronary sinus."""
    line, crux = tree.longest_path(), _crux_abscissa(tree)
    lines = []
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
        points = points + (line.radius[inside] + radius + gap)[:, None] * across
        lines.append(_vein(points, radius, radius))
    sinus = placement.points(shape.curve_through(np.array(_CORONARY_SINUS)))
    lines.append(_vein(sinus, 4.2, 2.2))
    return tuple(lines)


def _vein(points: Float[np.ndarray, "n 3"], begin_mm: float, end_mm: float) -> Centerline:
    along = shape.abscissa(points)
    radius = np.linspace(begin_mm, end_mm, len(points))
    return Centerline(points, radius, along, shape.parallel_normals(shape.tangents(points)))


def _crux_abscissa(tree: VesselTree) -> float:
    """Return the abscissa where segment 3 ends, or 60 % of the way where there are no such labels, mm."""
    if "3" in tree.section_names:
        third = tree.section_names.index("3")
        ends = [b.centerline.abscissa[b.section == third].max() for b in tree.branches if np.any(b.section == third)]
        if ends:
            return float(max(ends))
    return 0.6 * float(tree.longest_path().abscissa[-1])


_LV_AXIS, _RV_AXIS = (38.0, -68.0, -22.0), (46.0, -36.0, -16.0)
_UPPER_CAVA = [(-16, 20, -12), (-14, 20, 15), (-12, 17, 60)]
_LOWER_CAVA = [(-19, 26, -42), (-24, 30, -70), (-26, 31, -110)]
_DESCENDING_AORTA = [(36, 62, 80), (34, 62, -10), (26, 64, -120)]
_AORTA = [(22, 6, -26), (17, 5.5, -12), (14.5, 5, 0), (12.5, 4, 14), (9, 2, 40), (8, 3, 90)]
_AORTA_RADIUS = (9.0, 13.0, AORTIC_RADIUS_MM, 14.5, 15.0, 15.0)
_RVOT = [(8, -28, -30), (16, -29, -12), (24, -27, 4)]
_PULMONARY = [(24, -27, 4), (32, -19, 22), (36, 0, 36)]
_PULMONARY_VEINS = [
    [(6, 48, -4), (-15, 54, 0), (-45, 48, 6)],
    [(8, 48, -16), (-12, 58, -22), (-42, 66, -32)],
    [(44, 46, -2), (62, 54, 4), (90, 50, 14)],
    [(44, 46, -16), (60, 58, -24), (88, 64, -36)],
]
_CORONARY_SINUS = [(-6, 20, -47), (4, 29, -48), (18, 36, -44), (33, 37, -38), (48, 27, -28)]
_LEFT_CORONARY = (
    ([(26, 14, 2), (31, 12, 2.5), (36, 8, 2), (40, 3, 0)], 2.25, 2.1),
    ([(40, 3, 0), (45, -6, -4), (50, -17, -8), (54, -29, -13), (57, -42, -20), (60, -54, -30)], 1.85, 1.0),
    ([(40, 3, 0), (45.5, 4, -5), (50, 10, -11), (53, 17, -20), (52, 23, -31), (48, 28, -42)], 1.7, 0.9),
)


def _ellipsoid(
    x: Float[np.ndarray, "nz ny nx 3"],
    centre: Sequence[float],
    semi_axes: Sequence[float],
    long_axis: Sequence[float],
) -> Float[np.ndarray, "nz ny nx"]:
    """Signed distance to an ellipsoid whose first axis is `long_axis`, exact to first order at the surface."""
    turn, _ = Rotation.align_vectors([[1.0, 0.0, 0.0]], [np.array(long_axis) / np.linalg.norm(long_axis)])
    local = (x - np.array(centre)) @ turn.as_matrix().T
    level = np.linalg.norm(local / np.array(semi_axes), axis=-1)
    slope = np.linalg.norm(local / np.array(semi_axes) ** 2, axis=-1)
    return level * (1 - level) / np.maximum(slope, 1e-6)


def _tube(
    x: Float32[np.ndarray, "nz ny nx 3"], waypoints: Sequence[Sequence[float]], radius: Sequence[float]
) -> Float32[np.ndarray, "nz ny nx"]:
    """Signed distance to a tube through the waypoints, with its radius at each."""
    line, r = np.array(waypoints, dtype=np.float32), np.array(radius, dtype=np.float32)
    square = np.einsum("...i,...i", x, x)
    depth = np.full(x.shape[:3], -np.inf, dtype=np.float32)
    for a, b, ra, rb in zip(line[:-1], line[1:], r[:-1], r[1:], strict=True):
        step = b - a
        along = x @ step - a @ step
        share = np.clip(along / (step @ step), 0, 1)
        distance = square - 2 * (x @ a) + a @ a + share * (share * (step @ step) - 2 * along)
        np.maximum(depth, ra + share * (rb - ra) - np.sqrt(np.maximum(distance, 0)), out=depth)
    return depth


def _close(depth: Float[np.ndarray, "nz ny nx"], width_mm: float, spacing_mm: float) -> Float[np.ndarray, "nz ny nx"]:
    """Return a shape with its gaps and grooves filled up to `width_mm` (morphological closing), as signed distance."""
    half = 0.5 * width_mm
    grown = np.where(depth > 0, half, half - distance_transform_edt(depth <= 0) * spacing_mm)
    shrunk = distance_transform_edt(grown > 0) * spacing_mm - half
    # The transforms count whole voxels: smooth their steps.
    return gaussian_filter(np.maximum(shrunk, np.clip(depth, -width_mm, width_mm)), 0.8)


def _chest(x: Float[np.ndarray, "nz ny nx 3"]) -> Float[np.ndarray, "nz ny nx"]:
    """Signed distance to the inside of the chest: an elliptical cylinder."""
    local = (x[..., :2] - np.array([12.0, 12.0])) / np.array([135.0, 76.0])
    return (1 - np.linalg.norm(local, axis=-1)) * 76.0


def _bone(x: Float[np.ndarray, "nz ny nx 3"]) -> Float[np.ndarray, "nz ny nx"]:
    """Signed distance to sternum, ribs and spine."""
    sternum = 4.5 - np.linalg.norm(
        np.stack([np.maximum(np.abs(x[..., 0] - 8) - 11, 0), x[..., 1] + 71 + 0.08 * x[..., 2]], axis=-1), axis=-1
    )
    spine = 19 - np.linalg.norm(x[..., :2] - np.array([6.0, 85.0]), axis=-1)
    disc = np.abs((x[..., 2] + 10) % 28 - 14) - 11
    spine = np.minimum(spine, -disc)
    turn = np.linspace(0.15 * np.pi, 0.85 * np.pi, 9)
    ribs = [
        _tube(
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
