"""A C-arm's geometry: where its source stands, how the patient lies, and where their points are in the image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from endopilot.settings import Within, settings
from endopilot.simulation.motion import place

Vector = Float[np.ndarray, "3"]
Places = Float[np.ndarray, "n 3"]
Affine = Float[np.ndarray, "3 4"]
Image = Float32[np.ndarray, "rows columns"]
"""A point or a direction, LPS; points, LPS mm; a map of points; and what there is at each pixel: light, attenuation."""
_Distance = Annotated[float, Within(100, 5000, unit="mm", mistaken=(("m", 1000.0), ("cm", 10.0)))]


@settings
class CArmGeometry:
    """Distances and pixels of a C-arm."""

    source_to_isocenter_mm: _Distance = 765.0
    """Distance of the X-ray source from the isocenter, mm."""
    source_to_detector_mm: _Distance = 1100.0
    """Distance of the X-ray source from the detector, mm."""
    pixel_mm: Annotated[float, Within(0.01, 10)] = 0.308
    """Pixel pitch of the detector in fluoroscopy, mm."""

    @model_validator(mode="after")
    def _in_order(self) -> CArmGeometry:
        if self.source_to_detector_mm <= self.source_to_isocenter_mm:
            raise ValueError(
                f"source_to_detector_mm: {self.source_to_detector_mm:g}; give more than source_to_isocenter_mm, "
                f"{self.source_to_isocenter_mm:g}: the patient lies between source and detector"
            )
        return self


@dataclass(frozen=True, eq=False)
class Pose:
    """How a patient lies in the C-arm's frame, compared with where the CT has them.

    Attributes:
        rotation_rad: rotation vector about the isocenter, LPS axes, rad.
        translation_mm: after the rotation, LPS mm.
    """

    rotation_rad: Vector = field(default_factory=lambda: np.zeros(3))
    translation_mm: Vector = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of_vector(cls, values: Float[np.ndarray, "6"]) -> Pose:
        """Return the pose of three angles, rad, and three lengths, mm."""
        return cls(np.asarray(values[:3], dtype=float), np.asarray(values[3:], dtype=float))

    @property
    def vector(self) -> Float[np.ndarray, "6"]:
        """Rotation vector, rad, and translation, mm."""
        return np.concatenate([self.rotation_rad, self.translation_mm])

    @classmethod
    def draw(cls, random: np.random.Generator, translation_mm: float = 5.0, rotation_deg: float = 3.0) -> Pose:
        """Draw a pose: each length and each angle evenly up to these bounds on either side, mm and degrees."""
        angles, lengths = random.uniform(-1, 1, (2, 3))
        return cls(np.deg2rad(rotation_deg) * angles, translation_mm * lengths)

    def move(self, points: Float[np.ndarray, "*n 3"], isocenter: Vector) -> Float[np.ndarray, "*n 3"]:
        """Return where points of the CT, LPS mm, lie in the C-arm's frame."""
        return place(self.affine(isocenter), points)

    def affine(self, isocenter: Vector) -> Affine:
        """Return the map that `move` applies."""
        matrix = Rotation.from_rotvec(self.rotation_rad).as_matrix()
        return np.column_stack([matrix, isocenter + self.translation_mm - matrix @ isocenter])


@dataclass(frozen=True, eq=False)
class View:
    """One source and its detector.

    Attributes:
        source: LPS mm.
        axes: rows: along the image's columns, upwards in the image, and from the source to the detector; unit vectors.
        scale: of a point at distance 1 from the source, pixels.
    """

    source: Vector
    axes: Float[np.ndarray, "3 3"]
    scale: float

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return the pixels of points, LPS mm: to the right of the image's middle, and up from it."""
        in_view = (points - self.source) @ self.axes.T
        return self.scale * in_view[..., :2] / in_view[..., 2:]

    def pixel(self, points: Float[np.ndarray, "*n 3"], side: int) -> Float[np.ndarray, "*n 2"]:
        """Return row and column of points, LPS mm, in an image of so many pixels along a side."""
        return (side - 1) / 2 + self.project(points)[..., ::-1] * [-1.0, 1.0]

    def magnified(self, factor: float) -> View:
        """Return the view with an image that is magnified by a factor."""
        return replace(self, scale=self.scale * factor)

    def slope(self, point: Vector) -> Float[np.ndarray, "2 3"]:
        """Return the derivative of the pixel by the point, pixels/mm."""
        (in_view,) = (point[None] - self.source) @ self.axes.T
        away = in_view[:2, None] / in_view[2]
        return self.scale / in_view[2] * (self.axes[:2] - away * self.axes[2])


def view_of(view: View, pose: Pose, isocenter: Vector) -> View:
    """Return a view, given in the C-arm's frame, in the CT's frame of a patient who lies in a pose."""
    matrix = Rotation.from_rotvec(pose.rotation_rad).as_matrix()
    source = (view.source - isocenter - pose.translation_mm) @ matrix + isocenter
    return replace(view, source=source, axes=view.axes @ matrix)


def view_at(angles_deg: tuple[float, float], isocenter: Vector, geometry: CArmGeometry) -> View:
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
