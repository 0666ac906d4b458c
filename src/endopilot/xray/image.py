"""A fluoroscopic image: the patient, the contrasted vessel, catheter and wire as their attenuation, with quantum noise.

What does not move (`Plane`) is computed once for a direction of the C-arm: line integrals of the attenuation through a
CT, the path through the lumen, the catheter. A frame adds the wire and the noise. All lengths and attenuations are
physical; docs/xray.md says where the constants come from.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from endopilot.settings import Count, Finite, Positive, Share, settings
from endopilot.simulation.device import Device
from endopilot.types import Anatomy, Volume
from endopilot.xray.carm import CArmGeometry, View, view_at

WATER_MM = 0.0206
"""Attenuation of water at 60 keV, the mean energy of fluoroscopy's beam, 1/mm (NIST XCOM)."""
PHOTONS_MM2_UGY = 30174.0
"""Photons a mm² and µGy of a fluoroscopy beam (RQA 5 of IEC 62220-1)."""
_STEEL_MM, _COIL_MM = 0.95, 3.0
"""Attenuation of a wire's steel shaft, and of the tungsten or platinum coil over its tip, partly filled, 1/mm."""
_CATHETER_MM, _CATHETER_WALL_MM = 0.08, 0.25
"""Attenuation of a catheter's wall with its barium, 1/mm, and its thickness, mm."""
_CATHETER_SHOWN_MM = 60.0
_PLAIN_MM = 200.0
"""Water that stands for the patient where there is no CT, mm."""
_BLOOD_HU = 40.0
_STEP_MM = 0.1
"""Distance of the points by which a wire is drawn, mm."""
_RAY_STEP_MM = 1.5
_ENTRANCE_MM = 150.0
"""The reference point of the air kerma lies this much nearer to the source than the isocenter, mm (IEC 60601-2-43)."""


@settings
class ImageConfig:
    """Detector and beam."""

    geometry: CArmGeometry = field(default_factory=CArmGeometry)
    """Distances and pixels."""
    pixels: Count = 512
    """Columns and rows of the image."""
    detector_ugy: Positive = 0.03
    """Air kerma at the detector for one frame at the usual dose, µGy."""
    efficiency: Share = 0.7
    """Detective quantum efficiency."""
    scatter: Share = 0.3
    """Scattered light at the detector, as a share of the mean unscattered one, behind the grid."""
    blur_mm: Positive = 0.18
    """Blur of focal spot and scintillator at the detector, standard deviation, mm."""
    iodine_mm: Positive = 0.14
    """Attenuation of the contrasted blood, 1/mm: 185 mg iodine/ml at 7.6 cm²/g."""
    opaque_tip_mm: Positive = 30.0
    """Length of the wire's radiopaque coil, mm."""
    window: Finite = 0.9
    """Half-width of the grey scale, in powers of e about the image's middle."""


@dataclass(frozen=True, eq=False)
class Plane:
    """What does not move in one view.

    Attributes:
        view: source and detector.
        zoom: magnification of the image; at 1 a pixel is the detector's.
        background: attenuation of patient and catheter along each ray.
        vessel_mm: path of each ray through the lumen, mm.
        reference: logarithm of the mean transmission, about which grey values are spread.
    """

    view: View
    zoom: float
    background: Float32[np.ndarray, "rows columns"]
    vessel_mm: Float32[np.ndarray, "rows columns"]
    reference: float


class XrayImager:
    """Makes the images of one patient and one wire."""

    def __init__(
        self, anatomy: Anatomy, device: Device, ct: Volume | None = None, config: ImageConfig | None = None
    ) -> None:
        """Bring the middle of the vessel to the isocenter.

        Args:
            anatomy: the vessel.
            device: the wire.
            ct: of the patient, HU; 200 mm of water if not given. The blood in the vessel loses its contrast.
            config: detector and beam.
        """
        self.anatomy, self.device, self.config = anatomy, device, config or ImageConfig()
        self.isocenter = np.concatenate([branch.centerline.points for branch in anatomy.tree.branches]).mean(axis=0)
        self._ct = None if ct is None else _without_contrast(ct, anatomy)
        self._lumen = _lumen_points(anatomy)

    def plane(self, angles_deg: tuple[float, float], zoom_factor: float = 1.0, *, rays: int = 256) -> Plane:
        """Compute what does not move under some angles.

        Args:
            angles_deg: LAO (positive) or RAO, and cranial (positive) or caudal, degrees.
            zoom_factor: magnification of the image.
            rays: cast through the CT, along each side of the image; their result is interpolated.
        """
        view, pixels = view_at(angles_deg, self.isocenter, self.config.geometry), self.config.pixels
        if self._ct is None:
            background = np.full((pixels, pixels), WATER_MM * _PLAIN_MM, dtype=np.float32)
        else:
            cast = _cast(self._ct, view, view.scale * zoom_factor, pixels, min(rays, pixels))
            wide = zoom(cast, pixels / cast.shape[0], order=1, grid_mode=True, mode="nearest")
            background = np.asarray(wide, dtype=np.float32)
        points, mass = _catheter_points(self.anatomy)
        background += self._splat(view, zoom_factor, points, mass * _CATHETER_MM)
        spacing = self.anatomy.distance_map.spacing_mm
        vessel = self._splat(view, zoom_factor, *self._lumen, width_mm=spacing / 2)
        primary = np.exp(-background)
        reference = float(np.log(np.median(primary) + self.config.scatter * primary.mean()))
        return Plane(view, zoom_factor, background, vessel, reference)

    def frame(
        self,
        plane: Plane,
        nodes: Float[np.ndarray, "n 3"],
        *,
        contrast: float = 0.0,
        dose: float = 1.0,
        seed: int = 0,
        roadmap: Float32[np.ndarray, "rows columns"] | None = None,
    ) -> UInt8[np.ndarray, "rows columns"]:
        """Return an image, grey values from 0 (black) to 255; the same seed gives the same noise.

        Args:
            plane: what does not move.
            nodes: of the wire from its tip on, LPS mm.
            contrast: share of the full contrast in the vessel's blood.
            dose: multiple of the usual dose.
            seed: of the noise.
            roadmap: path through the lumen, mm, of a vessel that is laid under the image in white.
        """
        config = self.config
        attenuation = plane.background + self.wire(plane, nodes)
        if contrast > 0:
            attenuation += np.float32(contrast * config.iodine_mm) * plane.vessel_mm
        light = np.exp(-attenuation)
        light += np.float32(config.scatter * float(light.mean()))
        photons = self._photons(plane, dose) * light / np.float32(np.exp(plane.reference))
        noise = np.random.default_rng([seed, 0x78726179]).standard_normal(light.shape, dtype=np.float32)
        value = np.log(light) - np.float32(plane.reference) + noise / np.sqrt(photons)
        grey = 127.5 + np.float32(127.5 / config.window) * value
        if roadmap is not None:
            grey += 90.0 * (1 - np.exp(-np.float32(config.iodine_mm) * roadmap))
        return np.clip(grey, 0, 255).astype(np.uint8)

    def wire(self, plane: Plane, nodes: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "rows columns"]:
        """Return the attenuation of a wire along each ray.

        Args:
            plane: the view.
            nodes: of the wire from its tip on, LPS mm.
        """
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
        at = np.arange(_STEP_MM / 2, along[-1], _STEP_MM)
        points = np.stack([np.interp(at, along, axis) for axis in nodes.T], axis=-1)
        per_mm = np.where(at <= self.config.opaque_tip_mm, _COIL_MM, _STEEL_MM)
        radius = self.device.tip_radius_mm
        return self._splat(plane.view, plane.zoom, points, per_mm * np.pi * radius**2 * _STEP_MM, width_mm=radius / 2)

    def air_kerma_ugy(self, plane: Plane, dose: float) -> float:
        """Return the air kerma of a frame at the patient's entrance reference point, µGy."""
        geometry = self.config.geometry
        reference_mm = geometry.source_to_isocenter_mm - _ENTRANCE_MM
        nearer = (geometry.source_to_detector_mm / reference_mm) ** 2
        return self.config.detector_ugy * dose * nearer / float(np.exp(plane.reference))

    def _photons(self, plane: Plane, dose: float) -> float:
        """Return how many photons a pixel of mean brightness counts: the exposure control keeps the detector's dose."""
        config, side = self.config, self.config.geometry.pixel_mm / plane.zoom
        return PHOTONS_MM2_UGY * config.efficiency * config.detector_ugy * dose * side**2

    def _splat(
        self, view: View, zoom_factor: float, points: np.ndarray, volume: np.ndarray, *, width_mm: float = 0.0
    ) -> Float32[np.ndarray, "rows columns"]:
        """Return line integrals of small volumes: each is shared among four pixels, then blurred.

        Args:
            view: source and detector.
            zoom_factor: magnification of the image.
            points: places, LPS mm.
            volume: mm³, or mm² where it is weighted by an attenuation.
            width_mm: standard deviation of each in space, mm.
        """
        pixels, scale = self.config.pixels, view.scale * zoom_factor
        image = np.zeros((pixels, pixels), dtype=np.float32)
        in_view = (points - view.source) @ view.axes.T
        per_mm = scale / in_view[:, 2]
        at = np.stack([pixels / 2 - 0.5 - in_view[:, 1] * per_mm, pixels / 2 - 0.5 + in_view[:, 0] * per_mm], axis=-1)
        inside = ((at > 0) & (at < pixels - 1)).all(axis=1)
        if not inside.any():
            return image
        at, mass = at[inside], (np.broadcast_to(volume, len(points)) * per_mm**2)[inside]
        detector_px = self.config.blur_mm / self.config.geometry.pixel_mm * zoom_factor
        sigma = float(np.hypot(width_mm * per_mm.mean(), detector_px))
        reach = int(4 * sigma) + 1
        low = np.maximum(np.floor(at.min(axis=0)).astype(int) - reach, 0)
        high = np.minimum(np.floor(at.max(axis=0)).astype(int) + 2 + reach, pixels)
        rows, columns = high - low
        corner = np.floor(at).astype(int)
        rest, corner = at - corner, corner - low
        box = np.zeros(rows * columns)
        for row in (0, 1):
            for column in (0, 1):
                share = np.abs(1 - row - rest[:, 0]) * np.abs(1 - column - rest[:, 1])
                index = (corner[:, 0] + row) * columns + corner[:, 1] + column
                box += np.bincount(index, mass * share, minlength=rows * columns)
        blurred = gaussian_filter(box.reshape(rows, columns), sigma, mode="constant")
        image[low[0] : high[0], low[1] : high[1]] = blurred
        return image


def _without_contrast(ct: Volume, anatomy: Anatomy) -> Volume:
    """Return the CT with the blood of the vessel as it is without contrast."""
    voxels = ct.voxels.astype(np.float32)
    points, _ = _lumen_points(anatomy)
    index = np.rint(ct.world_to_index(points)).astype(int)[:, ::-1]
    index = index[((index >= 0) & (index < voxels.shape)).all(axis=1)]
    at = tuple(index.T)
    voxels[at] = np.minimum(voxels[at], _BLOOD_HU)
    return Volume(voxels, ct.spacing_mm, ct.origin_mm, ct.direction)


def _lumen_points(anatomy: Anatomy) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the lumen as small volumes: their places, LPS mm, and sizes, mm³; those on the wall count in part."""
    lumen = anatomy.distance_map
    share = np.clip(np.asarray(lumen.values) / lumen.spacing_mm + 0.5, 0, 1)
    index = np.argwhere(share > 0)
    return lumen.origin_mm + index[:, ::-1] * lumen.spacing_mm, share[tuple(index.T)] * lumen.spacing_mm**3


def _catheter_points(anatomy: Anatomy) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the wall of the guiding catheter as small volumes: their places, LPS mm, and sizes, mm³."""
    axis, radius = anatomy.insertion.direction, anatomy.catheter_radius_mm + _CATHETER_WALL_MM / 2
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    first /= np.linalg.norm(first)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = radius * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(axis, first))
    along = np.arange(-_CATHETER_SHOWN_MM, 0, 0.15)
    points = anatomy.insertion.position + along[:, None, None] * axis + ring
    size = 2 * np.pi * radius * _CATHETER_WALL_MM * 0.15 / len(turn)
    return points.reshape(-1, 3), np.full(points.shape[0] * points.shape[1], size)


def _cast(ct: Volume, view: View, scale: float, pixels: int, rays: int) -> Float32[np.ndarray, "rays rays"]:
    """Return the attenuation along rays through a CT, plane by plane; beyond its sides it goes on as at its edge."""
    step = pixels / rays
    offset = (np.arange(rays) + 0.5) * step - pixels / 2
    side, up = np.meshgrid(offset / scale, -offset / scale)
    direction = view.axes[2] + side[..., None] * view.axes[0] + up[..., None] * view.axes[1]
    size = np.array(ct.voxels.shape[::-1])
    corners = np.array(np.meshgrid(*([0, n - 1] for n in size))).reshape(3, -1).T
    depths = (ct.index_to_world(corners) - view.source) @ view.axes[2]
    into = (direction @ ct.direction) / ct.spacing_mm
    begin = ((view.source - ct.origin_mm) @ ct.direction) / ct.spacing_mm
    total = np.zeros((rays, rays), dtype=np.float32)
    for depth in np.arange(depths.min(), depths.max(), _RAY_STEP_MM):
        index = begin + depth * into
        values = map_coordinates(ct.voxels, np.moveaxis(index, -1, 0)[::-1], order=1, mode="nearest", output=np.float32)
        total += np.maximum(1 + values / 1000, 0)
    return total * (WATER_MM * _RAY_STEP_MM) * np.linalg.norm(direction, axis=-1).astype(np.float32)
