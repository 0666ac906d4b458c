"""The left coronary artery's mean course, and the reference heart fitted to a patient's left coronary artery.

Courses: Dodge JT et al., "Intrathoracic spatial location of specified coronary segments on the normal human heart",
Circulation 1988;78:1167-80: mean spherical positions from the left ostium. Around the crux the paper's azimuth is an
average across ±180° and means nothing (its spread is 39 to 64°): there and along the inferior wall only its distances
and elevations are kept, and the course is interpolated between the circumflex's C4 and the apex.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float

from endopilot.atlas import curves as shape
from endopilot.atlas.heart_reference import BEYOND_CRUX, TO_CRUX, HeartFit
from endopilot.lines import length_along, places_on

LEFT_OSTIUM = np.array([26.0, 14.0, 2.0])
"""The left coronary ostium on the reference heart's aortic root, mm in the frame of `heart_reference`."""

_KNOTS = 16
_HEIGHT_MM = 3.0
"""The reference courses lie this far above the reference heart's surface, mm: in epicardial fat."""


def place_from_ostium(distance_cm: float, azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    """Return the LPS position of one of Dodge's points with respect to its ostium, mm.

    Azimuth counts from the front to the patient's left, elevation towards the head.
    """
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    flat = np.cos(elevation) * np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return 10.0 * distance_cm * (flat + np.array([0.0, 0.0, np.sin(elevation)]))


FORK = np.array([13.0, -3.0, -1.2])
"""End of the left main artery: halfway between the first points of LAD (L1p) and circumflex (C1p), mm."""

LAD = np.array(
    [
        FORK,
        place_from_ostium(2.3, 63.0, -5.0),
        place_from_ostium(3.25, 59.0, -8.5),
        place_from_ostium(5.15, 44.0, -12.0),
        place_from_ostium(6.8, 38.5, -18.5),
        place_from_ostium(10.1, 30.0, -32.0),
        place_from_ostium(12.2, 32.0, -46.0),
        place_from_ostium(11.8, 33.0, -49.0),
        [26.0, -44.0, -84.0],
    ]
)
"""Anterior descending artery: fork, L1m, first and second diagonal and septal, third, L3m, apex (L4p), L4m, and on
along the inferior interventricular groove, mm from the left ostium."""

LCX = np.array(
    [
        FORK,
        place_from_ostium(1.8, 94.0, -24.0),
        place_from_ostium(2.2, 102.0, -31.0),
        place_from_ostium(3.25, 117.0, -39.0),
        place_from_ostium(4.75, 132.0, -50.0),
        place_from_ostium(6.0, 156.0, -66.0),
        [-16.0, 9.0, -64.4],
    ]
)
"""Circumflex artery: fork, C1m, first, second and third marginal, posterior branch and C4m, crux, mm from the left
ostium."""

INFERIOR = np.array([LCX[-1], [0.0, -5.0, -72.0], [17.0, -24.0, -80.0], [32.0, -46.0, -87.0]])
"""Left posterior descending artery from the crux along the inferior interventricular groove, mm from the left ostium;
elevations and distances of CDo, CDp and CDm, azimuth interpolated."""

_REFERENCE_LAD = np.array(
    [LEFT_OSTIUM, [31, 12, 2.5], [40, 3, 0], [45, -6, -4], [50, -17, -8], [54, -29, -13], [57, -42, -20],
     [61, -54, -30], [65, -61, -45], [63, -59, -58], [50, -45, -67]]
)  # fmt: skip
_REFERENCE_LCX = np.array(
    [[40, 3, 0], [45.5, 4, -5], [50, 10, -11], [53, 17, -20], [52, 23, -31], [46, 28, -41], [33, 33, -45],
     [18, 31, -49], [2, 23, -56.0]]
)  # fmt: skip
"""Both courses around the reference heart, mm in its frame; they are laid onto its surface."""


def fit_left_heart(
    lad: Float[np.ndarray, "n 3"], lcx: Float[np.ndarray, "m 3"], inferior: Float[np.ndarray, "k 3"]
) -> HeartFit:
    """Fit the reference heart to a left coronary artery.

    Args:
        lad: the patient's left main and anterior descending artery over the whole course of `LAD`, LPS mm.
        lcx: circumflex artery and what would carry it on over the whole course of `LCX`.
        inferior: the course of `INFERIOR` in this patient, whatever runs there.
    """
    course = np.concatenate([_evenly(line) for line in (lad, lcx, inferior)])
    reference = reference_courses()
    ostium = lad[0]
    u, s, vt = np.linalg.svd((course - ostium).T @ (reference - LEFT_OSTIUM))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ np.diag(sign) @ vt
    scale = float(np.clip((s * sign).sum() / ((reference - LEFT_OSTIUM) ** 2).sum(), 0.6, 1.6))
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
