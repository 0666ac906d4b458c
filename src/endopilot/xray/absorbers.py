"""What takes away X-rays: the patient, the lumen with its contrast, the guiding catheter, the wire and its catheters.

Each but the patient is a cloud of small volumes, which `projector.Shadow` turns into line integrals.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from endopilot.devices.catheter import Catheter
from endopilot.lines import length_along, places_on
from endopilot.phantom.chest import is_left
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.types import Anatomy, Volume
from endopilot.xray.carm import Places

WATER_MM = 0.0206
"""Attenuation of water at 60 keV, the mean energy of fluoroscopy's beam, 1/mm (NIST XCOM)."""
STEEL_MM, COIL_MM = 0.95, 3.0
"""Attenuation of a wire's steel shaft, and of the tungsten or platinum coil over its tip, partly filled, 1/mm."""
CATHETER_MM, GUIDE_WALL_MM = 0.23, 0.25
"""Attenuation of a catheter's wall with its barium and its steel braid, 1/mm, and the guiding catheter's thickness,
mm."""
MARKER_MM, MARKER_WALL_MM, MARKER_LENGTH_MM = 9.0, 0.03, 1.0
"""Attenuation of the platinum ring at a microcatheter's tip, 1/mm, its thickness and its length, mm."""
_MARKED_MM = 1.1
"""A catheter up to this wide, mm, is a microcatheter: it has a marker."""
_STRAIGHT_MM, _BEND_MM, _SHOWN_MM = 10.0, 25.0, 180.0
"""Length of the catheter behind the ostium that is straight, radius of its bend into the aorta, and the length that is
shown, mm."""
_BLOOD_HU = 40.0
_POOL_MM, _POOL_HU = 8.0, (150.0, 650.0)
"""Least width of a chamber's or a large vessel's blood, mm, and its range in a CT angiogram, HU."""
_SOFT_SHARE = 0.2
"""Soft tissue without contrast is so much nearer to blood: 45 to 60 HU where a CT angiogram has 80 to 200."""
_LUNG_HU, _LUNG_MM = 80.0, (1.5, 4.0)
"""Standard deviation of the lung's density by its vessels and lobules, HU, at each of two sizes, mm: an assumption."""
_STEP_MM, _RINGS = 0.15, 4
_MARKER_STEP_MM, _SPOKE_MM = 0.05, 0.25
SURROUNDINGS = PhantomConfig(  # without contrast, as the chest is between two injections
    in_plane_mm=1.5, slice_mm=1.5, margin_mm=60.0, lumen_hu=(45.0, 45.0), noise_hu=(0.0, 0.0), calcium=0.0
)


def is_coronary(anatomy: Anatomy) -> bool:
    """Return whether the vessel is a coronary artery by its section names: the phantom knows only these."""
    return is_left(anatomy.tree) or anatomy.tree.section_names[int(anatomy.tree.branches[0].section[0])] == "1"


def surroundings(anatomy: Anatomy) -> Volume | None:
    """Return the CT of a synthetic chest around a coronary artery, HU, without contrast; None for any other vessel."""
    if not is_coronary(anatomy):
        return None
    chest = make_phantom(anatomy, config=SURROUNDINGS, seed=0)
    hu, random = chest.voxels.astype(np.float32), np.random.default_rng(0)
    soft = (hu > -20) & (hu < 210)
    hu[soft] = _BLOOD_HU + _SOFT_SHARE * (hu[soft] - _BLOOD_HU)
    lung, grain = hu < -600, random.standard_normal(hu.shape, dtype=np.float32)
    for size in _LUNG_MM:
        texture = gaussian_filter(grain, size / chest.spacing_mm[0])
        hu[lung] += np.float32(_LUNG_HU / texture.std()) * texture[lung]
    return Volume(hu, chest.spacing_mm, chest.origin_mm, chest.direction)


def without_contrast(ct: Volume, points: Places) -> Volume:
    """Return a CT, HU, with the blood at the points of the vessel's lumen, LPS mm, as it is without contrast. So is all
    blood in chambers and large vessels: what stays contrasted where anything thinner than `_POOL_MM` is opened; bone is
    denser, or thinner."""
    voxels, every = ct.voxels.astype(np.float32), np.maximum((2.0 / ct.spacing_mm[::-1]).astype(int), 1)
    coarse = voxels[:: every[0], :: every[1], :: every[2]]
    size = 2 * (_POOL_MM / 2 / (ct.spacing_mm[::-1] * every)).astype(int) + 1
    blood = (coarse > _POOL_HU[0]) & (coarse < _POOL_HU[1])
    pool = np.asarray(maximum_filter(minimum_filter(blood, tuple(size)), tuple(size + 2)), dtype=bool)
    for axis, count in enumerate(every):
        pool = np.repeat(pool, count, axis)
    pool = pool[tuple(map(slice, voxels.shape))] & (voxels < _POOL_HU[1])
    voxels[pool] = np.minimum(voxels[pool], _BLOOD_HU)
    index = np.rint(ct.world_to_index(points)).astype(int)[:, ::-1]
    index = index[((index >= 0) & (index < voxels.shape)).all(axis=1)]
    at = tuple(index.T)
    voxels[at] = np.minimum(voxels[at], _BLOOD_HU)
    return Volume(voxels, ct.spacing_mm, ct.origin_mm, ct.direction)


def lumen_points(anatomy: Anatomy) -> tuple[Places, Float[np.ndarray, "n"]]:
    """Return the lumen as small volumes: their places, LPS mm, and sizes, mm³; those on the wall count in part. What
    lies behind the ostium is the catheter, which the distance map holds too; it is left out."""
    lumen, start = anatomy.distance_map, anatomy.insertion
    share = np.asarray(lumen.values) / lumen.spacing_mm + 0.5
    within = np.flatnonzero(share > 0)
    index = np.stack(np.unravel_index(within, share.shape)[::-1], axis=-1)
    points = lumen.origin_mm + index * lumen.spacing_mm
    size = np.minimum(share.ravel()[within], 1) * lumen.spacing_mm**3
    behind = (points - start.position) @ start.direction
    aside = np.linalg.norm(points - start.position - behind[:, None] * start.direction, axis=1)
    vessel = (behind >= 0) | (aside > anatomy.catheter_radius_mm + lumen.spacing_mm)
    return points[vessel], size[vessel]


def catheter_line(anatomy: Anatomy) -> tuple[Float[np.ndarray, "n"], Places, Places]:
    """Return the axis of the guiding catheter from the ostium backwards: distance, mm, places, LPS mm, and unit
    vectors. It is straight, and that of a coronary artery bends up into the ascending aorta behind its first 10 mm."""
    start = anatomy.insertion
    distance, back = np.arange(0.0, _SHOWN_MM, 1.0), -np.asarray(start.direction, dtype=float)
    heading = np.tile(back, (len(distance), 1))
    if is_coronary(anatomy):
        up = np.array([0.0, 0.0, 1.0])
        angle = np.arccos(np.clip(back @ up, -1, 1))
        turned = np.clip((distance - _STRAIGHT_MM) / _BEND_MM, 0, angle)[:, None]
        if 1e-6 < angle < np.pi - 1e-6:
            heading = (np.sin(angle - turned) * back + np.sin(turned) * up) / np.sin(angle)
    middle = 0.5 * (heading[1:] + heading[:-1])
    places = start.position + np.concatenate([np.zeros((1, 3)), np.cumsum(middle, axis=0)])
    return distance, places, heading


def in_catheter(
    anatomy: Anatomy,
    nodes: Places,
    line: tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None,
) -> Places:
    """Return the nodes of a wire, LPS mm, with those behind the ostium laid along the guiding catheter's bend: its axis
    is `catheter_line`, if it is not given.

    The rod core's catheter is straight; nothing that it computes depends on what lies behind. Behind the ostium are the
    nodes after the last one in front of its plane: vessels pass that plane too, farther on.
    """
    start = anatomy.insertion
    behind = -((nodes - start.position) @ start.direction)
    inside = np.logical_and.accumulate((behind > 0)[::-1])[::-1]
    distance, places, _ = line or catheter_line(anatomy)
    aside = nodes[inside] - start.position + behind[inside, None] * start.direction
    laid = places_on(places, distance, behind[inside])
    past = np.maximum(behind[inside] - distance[-1], 0.0)[:, None]
    moved = nodes.astype(float).copy()
    moved[inside] = laid + aside + past * (places[-1] - places[-2])
    return moved


def catheter_lumen_points(anatomy: Anatomy) -> tuple[Places, Float[np.ndarray, "n"]]:
    """Return the inside of the guiding catheter, through which contrast is injected, as `lumen_points` does."""
    places, width = catheter_line(anatomy)[1], anatomy.catheter_radius_mm / _RINGS
    tubes = [_tube(places, width * (ring + 0.5), width, _STEP_MM, 1.0) for ring in range(_RINGS)]
    return np.concatenate([tube[0] for tube in tubes]), np.concatenate([tube[1] for tube in tubes])


def catheter_points(anatomy: Anatomy) -> tuple[Places, Float[np.ndarray, "n"]]:
    """Return the wall of the guiding catheter as small volumes: their places, LPS mm, and sizes, mm³."""
    radius = anatomy.catheter_radius_mm + GUIDE_WALL_MM / 2
    return _tube(catheter_line(anatomy)[1], radius, GUIDE_WALL_MM, _STEP_MM, 1.0)


def across(axis: Places) -> tuple[Places, Places]:
    """Return two unit vectors across each axis, and across each other."""
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).max(axis=0).argmin())])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def wire_points(
    nodes: Places, radius_mm: float, opaque_tip_mm: float, step_mm: float = 0.1, coil_mm: float = COIL_MM
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Return a wire as small volumes: their places, so far apart, LPS mm, and sizes times their attenuation, mm². Its
    nodes begin at the tip; the radiopaque coil over it is `opaque_tip_mm` long and takes away `coil_mm`, 1/mm."""
    along = length_along(nodes)
    at = np.arange(step_mm / 2, along[-1], step_mm)
    points = places_on(nodes, along, at)
    per_mm = np.where(at <= opaque_tip_mm, coil_mm, STEEL_MM)
    return points, per_mm * np.pi * radius_mm**2 * step_mm


def driven_catheter_points(
    catheter: Catheter, nodes: Places
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Return a driven catheter as small volumes: their places, LPS mm, and sizes times their attenuation, mm². The
    nodes are those of its axis from the tip on; a microcatheter has a ring of platinum in the wall there."""
    outer, inner = catheter.tip_radius_mm, catheter.inner_diameter_mm / 2
    radius = (outer + inner) / 2
    wall, sizes = _tube(nodes, radius, outer - inner, _STEP_MM, CATHETER_MM)
    if 2 * outer > _MARKED_MM:
        return wall, sizes
    ring, ring_sizes = _tube(nodes, radius, MARKER_WALL_MM, _MARKER_STEP_MM, MARKER_MM, MARKER_LENGTH_MM)
    return np.concatenate([wall, ring]), np.concatenate([sizes, ring_sizes])


def _tube(
    nodes: Places, radius_mm: float, wall_mm: float, step_mm: float, per_mm: float, most_mm: float = np.inf
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
    """Return a tube about a line, from its begin up to a length, as `driven_catheter_points` does."""
    along = length_along(nodes)
    at = np.arange(step_mm / 2, min(along[-1], most_mm), step_mm)
    axis = places_on(nodes, along, at)
    heading = places_on(np.gradient(nodes, along, axis=0), along, at)
    first, second = across(heading)
    spokes = int(np.ceil(2 * np.pi * radius_mm / _SPOKE_MM))
    turn = np.linspace(0, 2 * np.pi, spokes, endpoint=False)[:, None, None]
    points = (axis + radius_mm * (np.cos(turn) * first + np.sin(turn) * second)).reshape(-1, 3)
    return points, np.full(len(points), per_mm * 2 * np.pi * radius_mm * wall_mm * step_mm / spokes)
