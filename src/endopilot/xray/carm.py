"""A C-arm's geometry: where its source stands, and where points of the patient lie in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.settings import Positive, settings


@settings
class CArmGeometry:
    """Distances and pixels of a C-arm."""

    source_to_isocenter_mm: Positive = 765.0
    """Distance of the X-ray source from the isocenter, mm."""
    source_to_detector_mm: Positive = 1100.0
    """Distance of the X-ray source from the detector, mm."""
    pixel_mm: Positive = 0.308
    """Pixel pitch of the detector in fluoroscopy, mm."""


@dataclass(frozen=True, eq=False)
class View:
    """One source and its detector.

    Attributes:
        source: LPS mm.
        axes: rows: along the image's columns, upwards in the image, and from the source to the detector; unit vectors.
        scale: of a point at distance 1 from the source, pixels.
    """

    source: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    scale: float

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return the pixels of points, LPS mm: to the right of the image's middle, and up from it."""
        in_view = (points - self.source) @ self.axes.T
        return self.scale * in_view[..., :2] / in_view[..., 2:]

    def slope(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
        """Return the derivative of the pixel by the point, pixels/mm."""
        in_view = self.axes @ (point - self.source)
        return self.scale / in_view[2] * (self.axes[:2] - np.outer(in_view[:2] / in_view[2], self.axes[2]))


def view_at(angles_deg: tuple[float, float], isocenter: Float[np.ndarray, "3"], geometry: CArmGeometry) -> View:
    """Return the view under an LAO and a cranial angle: at 0, 0 the beam goes from the back to the front, along −y.

    Args:
        angles_deg: LAO (positive) or RAO (negative), and cranial (positive) or caudal (negative), degrees.
        isocenter: the point about which the C-arm turns, LPS mm.
        geometry: distances and pixels.
    """
    lao, cranial = np.deg2rad(angles_deg)
    beam = np.array([np.sin(lao) * np.cos(cranial), -np.cos(lao) * np.cos(cranial), np.sin(cranial)])
    across = np.array([np.cos(lao), np.sin(lao), 0.0])
    return View(
        source=isocenter - geometry.source_to_isocenter_mm * beam,
        axes=np.stack([across, np.cross(beam, across), beam]),
        scale=geometry.source_to_detector_mm / geometry.pixel_mm,
    )
