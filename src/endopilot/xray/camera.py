"""A camera that sees a tip as a pixel of an image: planar, as over a phantom, or a C-arm; and its file, `camera.yaml`.

Pixels are counted as images are: columns to the right and rows downwards, from 0 at the middle of the first one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import model_validator
from scipy.spatial import KDTree

from endopilot.files import read_yaml
from endopilot.settings import Finite, Within, read_settings, settings
from endopilot.types import VesselTree
from endopilot.xray.carm import CArmGeometry, Places, View, view_at

CAMERA_FILE = "camera.yaml"
"""Name of the camera's file beside a log."""
Point = tuple[Finite, Finite, Finite]
Row = tuple[Finite, Finite, Finite, Finite]
_SINGULAR = 1e-12
_UNIT = 1e-3
"""Directions are taken as given if their lengths are 1, and right angles right, to this."""


@settings
class PlanarCamera:
    """A camera that looks straight onto a plane: a pixel is as many mm everywhere, and depth is not seen."""

    mm_per_pixel: Annotated[float, Within(1e-4, 100)]
    """Size of a pixel in the plane, mm."""
    origin_mm: Point = (0.0, 0.0, 0.0)
    """Where the middle of pixel (0, 0) lies, LPS mm."""
    columns: Point = (1.0, 0.0, 0.0)
    """Direction, LPS, in which columns grow, to the right in the image: a unit vector."""
    rows: Point = (0.0, -1.0, 0.0)
    """Direction, LPS, in which rows grow, downwards in the image: a unit vector across `columns`."""

    @model_validator(mode="after")
    def _axes_stand_across(self) -> PlanarCamera:
        across, down = np.array(self.columns), np.array(self.rows)
        for name, axis in (("columns", across), ("rows", down)):
            if abs(np.linalg.norm(axis) - 1) > _UNIT:
                raise ValueError(f"{name}: {axis.tolist()} has length {np.linalg.norm(axis):.4g}; give a unit vector")
        if abs(across @ down) > _UNIT:
            raise ValueError(f"rows: {down.tolist()} is not across columns; give two directions at right angles")
        return self

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return column and row, pixels, of points, LPS mm."""
        return (points - self.origin_mm) @ np.array([self.columns, self.rows]).T / self.mm_per_pixel

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> tuple[Places, Places]:
        """Return a point, LPS mm, on what each pixel shows, and the unit vector along it."""
        through = np.array(self.origin_mm) + self.mm_per_pixel * pixels @ np.array([self.columns, self.rows])
        return through, np.broadcast_to(np.cross(self.columns, self.rows), through.shape)


@settings
class CArmCamera:
    """A C-arm that stands still, and whose images are as large as its detector's pixels make them.

    It is given by angles, isocenter and distances, or by its projection matrix.
    """

    angles_deg: tuple[Finite, Finite] | None = None
    """LAO (positive) or RAO, and cranial (positive) or caudal angle, degrees."""
    isocenter_mm: Point | None = None
    """Point about which the C-arm turns, LPS mm."""
    centre_px: tuple[Finite, Finite] | None = None
    """Column and row, pixels, that show the isocenter."""
    geometry: CArmGeometry = CArmGeometry()
    """Distances and pixels."""
    matrix: tuple[Row, Row, Row] | None = None
    """In place of all these: (w·column, w·row, w) is this matrix times (x, y, z, 1), pixels and LPS mm."""

    @model_validator(mode="after")
    def _is_given_in_one_way(self) -> CArmCamera:
        angles = {name: getattr(self, name) for name in ("angles_deg", "isocenter_mm", "centre_px")}
        absent = next((name for name, value in angles.items() if value is None), None)
        if self.matrix is None:
            if absent is not None:
                raise ValueError(f"{absent}: missing; add it, or give a matrix in place of angles")
        elif extra := [name for name, value in angles.items() if value is not None]:
            raise ValueError(f"{extra[0]}: is given beside matrix; give one of them")
        elif abs(np.linalg.det(np.array(self.matrix)[:, :3])) < _SINGULAR * np.linalg.norm(self.matrix) ** 3:
            raise ValueError("matrix: its first three columns have no inverse; give a projection from a point")
        return self

    @property
    def view(self) -> View:
        """Source and detector; of a matrix, the axes along columns and rows are scaled as its pixels are."""
        if self.matrix is None:
            assert self.angles_deg is not None
            return view_at(self.angles_deg, np.array(self.isocenter_mm), self.geometry)
        matrix = np.array(self.matrix)
        matrix = matrix * np.sign(np.linalg.det(matrix[:, :3])) / np.linalg.norm(matrix[2, :3])
        column, row = self._centre
        across, down = matrix[0, :3] - column * matrix[2, :3], matrix[1, :3] - row * matrix[2, :3]
        scale = float(np.linalg.norm(across))
        return View(
            source=-np.linalg.solve(matrix[:, :3], matrix[:, 3]),
            axes=np.stack([across / scale, -down / scale, matrix[2, :3]]),
            scale=scale,
        )

    @property
    def _centre(self) -> Float[np.ndarray, "2"]:
        """Column and row where the beam meets the detector at a right angle."""
        if self.matrix is None:
            return np.array(self.centre_px)
        first, second, beam = np.array(self.matrix)[:, :3]
        return np.array([first @ beam, second @ beam]) / (beam @ beam)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return column and row, pixels, of points, LPS mm."""
        return self.view.project(points) * [1.0, -1.0] + self._centre

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> tuple[Places, Places]:
        """Return a point, LPS mm, on what each pixel shows, and the unit vector along it."""
        view = self.view
        across = (pixels - self._centre) * [1.0, -1.0] / view.scale
        along = np.column_stack([across, np.ones(len(across))]) @ np.linalg.inv(view.axes).T
        return np.broadcast_to(view.source, along.shape), along / np.linalg.norm(along, axis=1, keepdims=True)


Camera = PlanarCamera | CArmCamera
_ANY_MATRIX = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0))


def read_camera(path: Path) -> Camera:
    """Read a camera from a YAML file: a `CArmCamera` where it holds `angles_deg` or `matrix`, else a `PlanarCamera`.

    Raises:
        InputError: no such file; the line names file, field, value and mend.
    """
    content = read_yaml(path)
    if isinstance(content, dict) and "matrix" in content:
        return read_settings(path, CArmCamera, onto=CArmCamera(matrix=_ANY_MATRIX))
    if isinstance(content, dict) and "angles_deg" in content:
        return read_settings(path, CArmCamera)
    return read_settings(path, PlanarCamera)


def points_in_vessel(camera: Camera, pixels: Float[np.ndarray, "n 2"], tree: VesselTree) -> Places:
    """Return what pixels show if it lies in a vessel: on each one's ray the point nearest to a centerline, LPS mm.

    NaN stays NaN. Where two branches cover each other in the image, it is that which lies nearer to the ray.
    """
    lines = tree.line.points
    found = np.full((len(pixels), 3), np.nan)
    seen = np.isfinite(pixels).all(axis=1)
    _, nearest = KDTree(camera.project(lines)).query(pixels[seen])
    through, along = camera.rays(pixels[seen])
    found[seen] = through + ((lines[nearest] - through) * along).sum(axis=1, keepdims=True) * along
    return found
