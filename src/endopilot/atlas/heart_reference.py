"""The reference heart: where chambers, great vessels and the right coronary artery lie with respect to each other.

Frame: LPS axes, mm, right coronary ostium at the origin, a normal adult heart in diastole. The artery's course follows
Dodge JT et al., "Intrathoracic spatial location of specified coronary segments on the normal human heart", Circulation
1988;78:1167-80 (mean spherical positions of R1 to R4 from the right ostium). Around the crux the paper's azimuth is a
mean across ±180° and says nothing (its spread is 64°): R3 distal and R4 proximal are interpolated in azimuth. Chambers
are ellipsoids and tubes that leave the artery its fat; all depths are signed distances in mm, positive inside.

The mean courses of the left coronary artery are the same paper's. Around the crux (spread of the azimuth:
39 to 64°) and along the inferior wall only distances and elevations are kept, and the course is interpolated between
the circumflex's C4 and the apex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from endopilot.atlas import curves as shape
from endopilot.atlas.population import frozen
from endopilot.files import read_yaml
from endopilot.lines import length_along, places_on

LEFT_VENTRICLE_AXIS = (38.0, -68.0, -22.0)

Numbers = Sequence[float | int]  # coordinates or sizes, mm

_WARP_WIDTH_MM = 22.0
_GRID_MM = 2.0
_GRID_LOW, _GRID_HIGH = np.array([-70.0, -110.0, -110.0]), np.array([110.0, 90.0, 70.0])


@dataclass(frozen=True, eq=False)
class HeartFit:
    """The map from a patient to the reference heart: a similarity about the ostium, then a smooth warp of the patient's
    artery onto the reference course: `shifts` are missing from `knots` of the artery, mm, none at `anchor`."""

    origin: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    scale: float
    knots: Float[np.ndarray, "n 3"]
    shifts: Float[np.ndarray, "n 3"]
    anchor: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def to_reference(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the reference position of the patient's points, mm."""
        aligned = (points - self.origin) @ self.rotation / self.scale
        # The ostium stays on the aorta's surface: the warp fades out around it.
        fade = np.exp(_square(aligned - self.anchor)[:, None] * (-0.5 / _WARP_WIDTH_MM**2))
        return aligned + self._warp(aligned) - fade * self._warp(self.anchor[None])

    def _warp(self, aligned: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the mean of the knots' shifts, weighted by nearness; it vanishes far from the artery."""
        square = _square(aligned)[:, None] + _square(self.knots) - 2 * aligned @ self.knots.T
        weight = np.exp(square * (-0.5 / _WARP_WIDTH_MM**2))
        return weight @ self.shifts / (weight.sum(axis=1, keepdims=True) + 0.3)

    def from_reference(self, reference: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the patient's position of reference points, mm (fixed-point inverse of `to_reference`)."""
        points = self.origin + self.scale * reference @ self.rotation.T
        for _ in range(8):
            points = points + self.scale * (reference - self.to_reference(points)) @ self.rotation.T
        return points

    def solid_depth(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return how deep the patient's points lie in the heart or the great vessels' walls, approximately, mm."""
        place = (self.to_reference(points) - _GRID_LOW) / _GRID_MM
        return self.scale * map_coordinates(_solid_grid(), place.T[::-1], order=1, mode="nearest")


def fit_heart(main: Float[np.ndarray, "n 3"], crux_mm: float, last_section: str) -> HeartFit:
    """Fit the reference heart to a right coronary artery from the ostium to its farthest tip, LPS mm. What lies beyond
    the crux (abscissa `crux_mm`) counts where the tip lies in section "4" or "16"."""
    along = length_along(main)
    course = places_on(main, along, np.linspace(0.0, crux_mm, 20))
    to_crux = shape.curve_through(TO_CRUX)
    reference = places_on(to_crux, length_along(to_crux), np.linspace(0.0, length_along(to_crux)[-1], 20))
    rotation, scale = _similarity(course - course[0], reference)
    if last_section in BEYOND_CRUX:
        beyond = shape.curve_through(np.concatenate([TO_CRUX, BEYOND_CRUX[last_section]]))
        start = length_along(to_crux)[-1]
        end = min(length_along(beyond)[-1] - start, (along[-1] - crux_mm) / scale)
        steps = np.linspace(0.0, end, 12)[1:]
        course = np.concatenate([course, places_on(main, along, crux_mm + steps * scale)])
        reference = np.concatenate([reference, places_on(beyond, length_along(beyond), start + steps)])
    knots = (course - course[0]) @ rotation / scale
    return HeartFit(main[0], rotation, scale, knots, reference - knots)


def fit_heart_along(lines: Sequence[Float[np.ndarray, "_ 3"]], courses: Sequence[Float[np.ndarray, "_ 3"]]) -> HeartFit:
    """Fit the reference heart to the main vessels of a tree, as far as they go, by equal lengths from the ostium, where
    lines and courses begin, relative to the heart's size."""
    ostium, anchor, scale, rotation = lines[0][0], courses[0][0], 1.0, np.eye(3)
    found = wanted = np.zeros((0, 3))
    for _ in range(4):
        course, reference = [], []
        for line, ideal in zip(lines, courses, strict=True):
            along, ideal_along = length_along(line), length_along(ideal)
            places = np.linspace(0.0, min(ideal_along[-1], along[-1] / scale), 16)
            course.append(places_on(line, along, scale * places))
            reference.append(places_on(ideal, ideal_along, places))
        found, wanted = np.concatenate(course) - ostium, np.concatenate(reference) - anchor
        rotation, scale = _similarity(found, wanted)
    origin = ostium - scale * rotation @ anchor
    knots = anchor + found @ rotation / scale
    return HeartFit(origin, rotation, scale, knots, anchor + wanted - knots, anchor)


def _similarity(
    course: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Return rotation and size that take reference points nearest to the patient's (Umeyama 1991), about the origin."""
    u, s, vt = np.linalg.svd(course.T @ reference)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    return u @ np.diag(sign) @ vt, float(np.clip((s * sign).sum() / (reference**2).sum(), 0.6, 1.6))


def _square(x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    # numpy's own sum over so short an axis takes several times as long
    return x[..., 0] ** 2 + x[..., 1] ** 2 + x[..., 2] ** 2


def ellipsoid(
    x: Float[np.ndarray, "*n 3"], centre: Numbers, semi_axes: Numbers, long_axis: Numbers
) -> Float[np.ndarray, "*n"]:
    """Signed distance to an ellipsoid whose first axis is `long_axis`, exact to first order at the surface."""
    turn = Rotation.align_vectors([[1.0, 0.0, 0.0]], [np.array(long_axis) / np.linalg.norm(long_axis)])[0]
    local = (x - np.array(centre, dtype=x.dtype)) @ turn.as_matrix().T.astype(x.dtype)
    scaled = local / np.array(semi_axes, dtype=x.dtype)
    level = np.sqrt(_square(scaled))
    slope = np.sqrt(_square(scaled / np.array(semi_axes, dtype=x.dtype)))
    return level * (1 - level) / np.maximum(slope, 1e-6)


def tube(x: Float[np.ndarray, "*n 3"], waypoints: Sequence[Numbers], radius: Numbers) -> Float[np.ndarray, "*n"]:
    """Signed distance to a tube through the waypoints, with its radius at each."""
    line, r = np.array(waypoints, dtype=x.dtype), np.array(radius, dtype=x.dtype)
    square = np.einsum("...i,...i", x, x)
    depth = np.full(x.shape[:-1], -np.inf, dtype=x.dtype)
    for a, b, ra, rb in zip(line[:-1], line[1:], r[:-1], r[1:], strict=True):
        step = b - a
        along = x @ step - a @ step
        share = np.clip(along / (step @ step), 0, 1)
        distance = square - 2 * (x @ a) + a @ a + share * (share * (step @ step) - 2 * along)
        np.maximum(depth, ra + share * (rb - ra) - np.sqrt(np.maximum(distance, 0)), out=depth)
    return depth


def chamber(x: Float[np.ndarray, "*n 3"], name: str) -> Float[np.ndarray, "*n"]:
    """Return the depth in a chamber or a great vessel of `heart.yaml`, mm."""
    shapes = {"ellipsoid": ellipsoid, "tube": tube}
    return np.max([shapes[kind](x, *of) for part in _HEART["chambers"][name] for kind, of in part.items()], axis=0)


@cache
def _solid_grid() -> Float32[np.ndarray, "nz ny nx"]:
    axes = [np.arange(low, high, _GRID_MM) for low, high in zip(_GRID_LOW, _GRID_HIGH, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    at = np.stack([x, y, z], axis=-1).astype(np.float32)
    thick = {"left_ventricle_wall": 0, "right_ventricle": 3, "right_atrium": 2, "left_atrium": 2}
    thick |= {"aorta": 1.3, "pulmonary_artery": 1.3}
    return np.max([chamber(at, name) + wall for name, wall in thick.items()], axis=0)


_KNOTS = 16
_HEIGHT_MM = 3.0  # the reference courses lie this far above the reference heart's surface, mm: in epicardial fat


def place_from_ostium(distance_cm: float, azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    """Return the LPS position of a point of Dodge's, mm: azimuth from the front to the left, elevation headward."""
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    flat = np.cos(elevation) * np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return 10.0 * distance_cm * (flat + np.array([0.0, 0.0, np.sin(elevation)]))


_HEART = frozen(read_yaml(Path(__file__).parent / "heart.yaml"))


def _course(name: str) -> Float[np.ndarray, "n 3"]:
    places = (place_from_ostium(*at["dodge"]) if isinstance(at, dict) else at for at in _HEART["courses"][name])
    return np.array(list(places), dtype=float)


TO_CRUX, LAD, LCX, INFERIOR = map(_course, ("to_crux", "lad", "lcx", "inferior"))
BEYOND_CRUX = {section: _course(section) for section in ("4", "16")}
FORK = LAD[0]  # end of the left main artery, mm from the left ostium, as the courses of the left artery are
_REFERENCE_LAD, _REFERENCE_LCX = map(_course, ("reference_lad", "reference_lcx"))
LEFT_OSTIUM = _REFERENCE_LAD[0]  # the left coronary ostium on the reference heart's aortic root, mm


def fit_left_heart(
    lad: Float[np.ndarray, "n 3"], lcx: Float[np.ndarray, "m 3"], inferior: Float[np.ndarray, "k 3"]
) -> HeartFit:
    """Fit the reference heart to a left coronary artery: left main and anterior descending artery, circumflex and what
    would carry it on, and whatever runs along `INFERIOR`, over the whole courses of the reference, LPS mm."""
    course = np.concatenate([_evenly(line) for line in (lad, lcx, inferior)])
    reference = reference_courses()
    ostium = lad[0]
    rotation, scale = _similarity(course - ostium, reference - LEFT_OSTIUM)
    origin = ostium - scale * rotation @ LEFT_OSTIUM
    knots = (course - origin) @ rotation / scale
    return HeartFit(origin, rotation, scale, knots, reference - knots)


@cache
def reference_courses() -> Float[np.ndarray, "n 3"]:
    """Return the courses on the reference heart's surface, mm in its frame: 16 points each of left main and anterior
    descending artery, circumflex artery from the fork, inferior groove.
    """
    heart = HeartFit(np.zeros(3), np.eye(3), 1.0, np.zeros((1, 3)), np.zeros((1, 3)))
    inferior = np.concatenate([TO_CRUX[-1:], BEYOND_CRUX["4"][:4]])
    lines = [_REFERENCE_LAD, np.concatenate([_REFERENCE_LCX, TO_CRUX[-1:]]), inferior]
    points = np.concatenate([_evenly(shape.curve_through(line)) for line in lines])
    for _ in range(20):
        below = np.array([heart.solid_depth(points + shift) for shift in np.vstack([np.zeros(3), np.eye(3)])])
        outward = (below[0] - below[1:]).T
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
        points = points + 0.3 * (below[0] + _HEIGHT_MM)[:, None] * outward
    points[0] = LEFT_OSTIUM
    return points


def _evenly(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    along = length_along(points)
    places = np.linspace(0.0, along[-1], _KNOTS)
    return places_on(points, along, places)
