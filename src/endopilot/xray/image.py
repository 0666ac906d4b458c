"""A fluoroscopic image: the patient, the contrasted vessel, catheters and wire as what they take away, and noise.

What does not move (`Plane`) is computed once for a direction of the C-arm: line integrals of the attenuation through a
CT, the path through the lumen, the guiding catheter, the scattered light. A frame adds the wire, the catheters that are
driven with it, and the noise. All lengths and attenuations are physical; docs/concepts/images.md says where the
constants come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter, zoom

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.imaging.grid import check_covers
from endopilot.settings import Finite, Positive, Share, ShareBelowOne, Within, settings
from endopilot.simulation.motion import place
from endopilot.types import Anatomy, Volume
from endopilot.xray.absorbers import (
    CATHETER_MM,
    COIL_MM,
    WATER_MM,
    catheter_line,
    catheter_lumen_points,
    catheter_points,
    driven_catheter_points,
    in_catheter,
    lumen_points,
    wire_points,
    without_contrast,
)
from endopilot.xray.carm import Affine, CArmGeometry, Image, Places, Pose, Vector, View, view_at, view_of
from endopilot.xray.projector import Shadow, blurred, cast

PHOTONS_MM2_UGY = 30174.0
"""Photons a mm² and µGy of a fluoroscopy beam (RQA 5 of IEC 62220-1)."""
_PLAIN_MM = 200.0
"""Water that stands for the patient where there is no CT, mm."""
_ENTRANCE_MM = 150.0
"""The reference point of the air kerma lies this much nearer to the source than the isocenter, mm (IEC 60601-2-43)."""
_COARSE = 8
"""Scatter is computed for squares of this many pixels a side."""
_MOST_PULSES = 8
_WIRE_STEP_MM = 0.1
"""Distance of the places that a wire is made of, mm; on a coarser detector they are as much farther apart."""
_ROADMAP_GREY = 90.0


@settings
class ImageConfig:
    """Detector and beam."""

    geometry: CArmGeometry = field(default_factory=CArmGeometry)
    """Distances and pixels."""
    pixels: Annotated[int, Within(1, 4096)] = 512
    """Columns and rows of the image."""
    detector_ugy: Positive = 0.03
    """Air kerma at the detector for one frame at the usual dose, µGy."""
    efficiency: Share = 0.7
    """Detective quantum efficiency."""
    scatter: Share = 0.3
    """Scattered light at the detector, as a share of the unscattered one, behind the grid."""
    scatter_mm: Annotated[float, Within(0.1, 1000)] = 30.0
    """Reach of the scattered light at the detector, standard deviation, mm."""
    focal_spot_mm: Annotated[float, Within(0, 10)] = 0.6
    """Width of the focal spot, mm; magnification spreads it over the detector."""
    scintillator_mm: Annotated[float, Within(0, 10)] = 0.16
    """Blur of the scintillator, which blurs image and quantum noise alike, standard deviation, mm."""
    pulse_s: Annotated[float, Within(0, 1)] = 0.008
    """Length of a pulse, s: what moves is blurred along its path."""
    iodine_mm: Positive = 0.14
    """Attenuation of the contrasted blood, 1/mm: 185 mg iodine/ml at 7.6 cm²/g."""
    opaque_tip_mm: Annotated[float, Within(0, 5000, above_low=True)] = 30.0
    """Length of the wire's radiopaque coil, mm."""
    coil_mm: Positive = COIL_MM
    """Attenuation of that coil, 1/mm."""
    electronic_noise_ugy: Annotated[float, Within(0, 10)] = 0.0
    """Air kerma at the detector at which the electronics' noise is as large as the quantum noise, µGy; none at 0."""
    edge_weight: Annotated[float, Within(0, 10)] = 0.0
    """Weight with which the C-arm adds to an image what its own blur lacks (unsharp mask); none at 0."""
    edge_mm: Annotated[float, Within(0.05, 20)] = 1.0
    """Standard deviation of that blur at the detector, mm."""
    temporal_weight: ShareBelowOne = 0.0
    """Weight of the image before in an image of a sequence (recursive filter); none at 0."""
    window: Finite = 0.9
    """Half-width of the grey scale, in powers of e about the image's middle."""

    @property
    def penumbra_mm(self) -> float:
        """Standard deviation of the focal spot's blur at the detector of what lies at the isocenter, mm."""
        magnification = self.geometry.source_to_detector_mm / self.geometry.source_to_isocenter_mm
        return self.focal_spot_mm * (magnification - 1) / np.sqrt(12)  # an even spot of width w has w/√12


@dataclass(frozen=True, eq=False)
class Plane:
    """What does not move in one view.

    Attributes:
        view: source and detector in the CT's frame; its pixels are the image's.
        zoom: magnification of the image; at 1 a pixel is the detector's.
        background: attenuation of patient and catheter along each ray.
        scatter: scattered light, in units of the beam without a patient.
        vessel_mm: path of each ray through what contrast fills, mm.
        reference: logarithm of the usual signal, about which grey values are spread.
        placed: affine map of the vessel, and of what lies in it, from where CT shows it to where it lies, LPS mm.
    """

    view: View
    zoom: float
    background: Image
    scatter: Image
    vessel_mm: Image
    reference: float
    placed: Affine

    def pixel(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return row and column of points of the vessel or in it, LPS mm of the CT."""
        return self.view.pixel(place(self.placed, points), len(self.background))


class XrayImager:
    """Makes the images of one patient and one wire, alone or with catheters around it.

    Attributes:
        anatomy: the vessel.
        stack: the wire, and the catheters around it.
        config: detector and beam.
        isocenter: the middle of the vessel, about which the C-arm turns, LPS mm.
        ct: of the patient, HU, without contrast in the vessel's blood; None for 200 mm of water.
        lumen_points: where the small volumes lie that the vessel's lumen is made of, LPS mm; `lumen_sizes`, mm³.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        device: Wire | Stack | str | Path,
        *,
        ct: Volume | None = None,
        config: ImageConfig | None = None,
    ) -> None:
        """Bring the middle of the vessel to the isocenter.

        Args:
            anatomy: the vessel.
            device: the wire or its name, or the wire and its catheters.
            ct: of the patient, HU; 200 mm of water if not given. The blood in the vessel loses its contrast.
            config: detector and beam.

        Raises:
            InputError: the CT is of another place than the vessel.
        """
        if ct is not None:
            check_covers(ct, anatomy)
        self.anatomy, self.stack, self.config = anatomy, Stack.of(device), config or ImageConfig()
        self.isocenter = isocenter_of(anatomy)
        self.lumen_points, self.lumen_sizes = lumen_points(anatomy)
        self.ct = None if ct is None else without_contrast(ct, self.lumen_points)
        self._guide = catheter_line(anatomy)
        wall, wall_sizes = catheter_points(anatomy)
        self._clouds = {
            "guide": (wall, wall_sizes * CATHETER_MM, 0.0),
            "lumen": (self.lumen_points, self.lumen_sizes, anatomy.distance_map.spacing_mm / 2),
            "guide lumen": (*catheter_lumen_points(anatomy), 0.1),
        }

    def plane(
        self,
        angles_deg: tuple[float, float],
        zoom_factor: float = 1.0,
        *,
        rays: int = 256,
        pose: Pose | None = None,
        placed: Affine | None = None,
    ) -> Plane:
        """Compute what does not move under some angles.

        Args:
            angles_deg: LAO (positive) or RAO, and cranial (positive) or caudal, degrees.
            zoom_factor: magnification of the image.
            rays: cast through the CT, along each side of the image; their result is interpolated.
            pose: of the patient; as the CT has it if not given.
            placed: affine map of vessel and catheter from where CT shows them to where heart and breath have moved
                them, LPS mm; the chest around stays.
        """
        placed = np.eye(3, 4) if placed is None else placed
        view = view_at(angles_deg, self.isocenter, self.config.geometry).magnified(zoom_factor)
        if pose is not None:
            view = view_of(view, pose, self.isocenter)
        return self.plane_through(self.patient(view, rays=rays), view, zoom_factor, placed)

    def plane_through(self, patient: Image, view: View, zoom_factor: float, placed: Affine) -> Plane:
        """Compute what does not move, as `plane` does, given the attenuation of the patient in a view of the CT."""
        background = patient + self.cloud("guide", view, zoom_factor, placed)
        vessel = self.cloud("lumen", view, zoom_factor, placed)
        vessel += self.cloud("guide lumen", view, zoom_factor, placed)
        primary = np.exp(-background)
        scatter = self._scattered(primary, zoom_factor)
        usual = float(np.log(np.median(primary + scatter)))
        return Plane(view, zoom_factor, background, scatter, vessel, usual, placed)

    def patient(self, view: View, *, rays: int = 256) -> Image:
        """Return the attenuation along each ray without vessel, catheters and wire, `rays` a side interpolated."""
        pixels = self.config.pixels
        if self.ct is None:
            return np.full((pixels, pixels), WATER_MM * _PLAIN_MM, dtype=np.float32)
        through = cast(self.ct, view, pixels, min(rays, pixels))
        wide = zoom(through, pixels / through.shape[0], order=1, grid_mode=True, mode="nearest")
        return np.asarray(wide, dtype=np.float32)

    def cloud(
        self, part: Literal["guide", "lumen", "guide lumen"], view: View, zoom_factor: float, placed: Affine
    ) -> Image:
        """Return the attenuation of the guiding catheter's wall along each ray, or the ray's path through the vessel's
        lumen or inside the guiding catheter, mm; other arguments as `plane_through` has."""
        points, sizes, width_mm = self._clouds[part]
        shadow = Shadow(view, self.config.pixels, points, placed)
        return shadow.of(sizes, width_mm=width_mm, blur_px=self.blur_px(zoom_factor))

    def signal(
        self,
        plane: Plane,
        nodes: Places,
        *,
        contrast: float = 0.0,
        dose: float = 1.0,
        seed: int = 0,
        noise: Image | None = None,
        before: Image | None = None,
        velocity: Places | None = None,
        catheters: Sequence[Float[np.ndarray, "_ 3"]] = (),
        catheter_velocities: Sequence[Float[np.ndarray, "_ 3"]] | None = None,
    ) -> Image:
        """Return what the C-arm makes of what its detector reads: the logarithm of the light over the usual one.

        The same seed gives the same noise.

        Args:
            plane: what does not move.
            nodes: of the wire from its tip on, LPS mm of the CT; none for an image without a wire.
            contrast: share of the full contrast in the vessel's blood.
            dose: multiple of the usual dose.
            seed: of the noise.
            noise: of standard deviation 1, a number for each pixel; drawn if not given.
            before: the signal before in a sequence, for the temporal filter; this is the first if not given.
            velocity: of the nodes, mm/s, which blurs the wire over the pulse; at rest if not given.
            catheters: nodes of each catheter from its tip on, LPS mm of the CT; none if not given.
            catheter_velocities: of these nodes, mm/s; at rest if not given.
        """
        config = self.config
        attenuation = plane.background.copy()
        moving = [velocity, *(catheter_velocities or [None] * len(catheters))]
        for number, (line, its_velocity) in enumerate(zip([nodes, *catheters], moving, strict=True)):
            if len(line):
                attenuation += self.wire(plane, line, number=number, velocity=its_velocity)
        if contrast > 0:
            attenuation += np.float32(contrast * config.iodine_mm) * plane.vessel_mm
        light = np.exp(np.negative(attenuation, out=attenuation), out=attenuation)
        light += plane.scatter
        light *= np.float32(np.exp(-plane.reference))
        if noise is None:
            noise = np.random.default_rng([seed, 0x78726179]).standard_normal(light.shape, dtype=np.float32)
        noise = noise / np.sqrt(light * np.float32(self.photons(plane, dose)))
        per_mm = plane.zoom / config.geometry.pixel_mm
        read = np.log(light)
        read += blurred(noise, config.scintillator_mm * per_mm)
        if config.electronic_noise_ugy > 0:  # it is white, and grows in dark parts as one over the light
            random = np.random.default_rng([seed, 0x656C6563])
            share = config.electronic_noise_ugy / (config.detector_ugy * dose * self.photons(plane, dose))
            read += random.standard_normal(light.shape, dtype=np.float32) * np.float32(np.sqrt(share)) / light
        if config.edge_weight > 0:
            read += np.float32(config.edge_weight) * (read - blurred(read, config.edge_mm * per_mm))
        if before is None or config.temporal_weight == 0:
            return read
        return np.float32(1 - config.temporal_weight) * read + np.float32(config.temporal_weight) * before

    def grey(
        self, signal: Image, *, mask: Image | None = None, roadmap: Image | None = None
    ) -> UInt8[np.ndarray, "rows columns"]:
        """Return a signal as grey values from 0 (black) to 255.

        That of a mask without contrast is subtracted (DSA), a path through the vessel, mm, laid under it in white.
        """
        per_e = np.float32(127.5 / self.config.window)
        value = 127.5 + per_e * signal if mask is None else 200.0 + per_e * (signal - mask)
        if roadmap is not None:
            value = value + _ROADMAP_GREY * (1 - np.exp(-np.float32(self.config.iodine_mm) * roadmap))
        return np.clip(value, 0, 255).astype(np.uint8)

    def wire(self, plane: Plane, nodes: Places, *, number: int = 0, velocity: Places | None = None) -> Image:
        """Return the attenuation of the wire, or of a catheter around it, along each ray, mean over a pulse.

        The pulse ends with the device at its nodes, which begin at the tip, LPS mm; it is at rest if no velocity of
        them is given, mm/s. The wire's number is 0, then come the catheters from the inside out.
        """
        config, lines = self.config, [nodes]
        if velocity is not None:
            path_px = float(np.linalg.norm(velocity, axis=1).max()) * config.pulse_s
            path_px *= plane.view.scale / config.geometry.source_to_isocenter_mm
            times = config.pulse_s * (np.arange(count := min(1 + int(2 * path_px), _MOST_PULSES)) + 0.5) / count
            lines = [nodes - time * velocity for time in times]
        if number == 0:
            radius = self.stack.wire.tip_radius_mm
            step_mm = _WIRE_STEP_MM * max(1.0, config.geometry.pixel_mm / CArmGeometry().pixel_mm)
            how = {"opaque_tip_mm": config.opaque_tip_mm, "step_mm": step_mm, "coil_mm": config.coil_mm}
            draw, width_mm = partial(wire_points, radius_mm=radius, **how), radius / 2
        else:
            catheter = self.stack.catheters[number - 1]
            draw = partial(driven_catheter_points, catheter)
            width_mm = (catheter.tip_radius_mm - catheter.inner_diameter_mm / 2) / np.sqrt(12)
        drawn = [draw(in_catheter(self.anatomy, line, self._guide)) for line in lines]
        points, sizes = (np.concatenate(each) for each in zip(*drawn, strict=True))
        shadow = Shadow(plane.view, config.pixels, points, plane.placed)
        return shadow.of(sizes / len(lines), width_mm=width_mm, blur_px=self.blur_px(plane.zoom))

    def air_kerma_ugy(self, plane: Plane, dose: float) -> float:
        """Return the air kerma of a frame at the patient's entrance reference point, µGy."""
        geometry = self.config.geometry
        reference_mm = geometry.source_to_isocenter_mm - _ENTRANCE_MM
        nearer = (geometry.source_to_detector_mm / reference_mm) ** 2
        return self.config.detector_ugy * dose * nearer / float(np.exp(plane.reference))

    def photons(self, plane: Plane, dose: float = 1.0) -> float:
        """Return how many photons a pixel of usual brightness counts; exposure control keeps the detector's dose."""
        config, side = self.config, self.config.geometry.pixel_mm / plane.zoom
        return PHOTONS_MM2_UGY * config.efficiency * config.detector_ugy * dose * side**2

    def blur_px(self, zoom_factor: float) -> float:
        """Return the blur of focal spot and scintillator, standard deviation, pixels of the image."""
        config = self.config
        return float(np.hypot(config.penumbra_mm, config.scintillator_mm) / config.geometry.pixel_mm * zoom_factor)

    def _scattered(self, primary: Image, zoom_factor: float) -> Image:
        """Return the scattered light: a share of the other, spread out; the beam is as wide as the image."""
        config, squares = self.config, max(len(primary) // _COARSE, 1)
        small = zoom(primary, squares / len(primary), order=1, grid_mode=True, mode="nearest")
        reach = config.scatter_mm / config.geometry.pixel_mm * zoom_factor * squares / len(primary)
        spread = config.scatter * gaussian_filter(small, reach, mode="constant")
        return np.asarray(zoom(spread, len(primary) / squares, order=1, grid_mode=True, mode="nearest"), np.float32)


def isocenter_of(anatomy: Anatomy) -> Vector:
    """Return the middle of a vessel, about which the C-arm turns, LPS mm."""
    return anatomy.tree.line.points.mean(axis=0)
