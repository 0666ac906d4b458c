"""One cine, frame by frame, with the truth of each frame: `Cine`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from endopilot.angiograms.beam import CONTRAST_SHARE, LUMEN_MM, Beam, harmonised, shown, stroke
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.angiograms.draw import CineDraw, Driven, drive_devices, motion_of, patient_seed
from endopilot.angiograms.flow import Flow, grow
from endopilot.lines import length_along, places_on
from endopilot.simulation.motion import place, relative
from endopilot.xray.absorbers import GUIDE_WALL_MM, catheter_line, in_catheter, is_coronary
from endopilot.xray.carm import View, view_at, view_of
from endopilot.xray.image import XrayImager
from endopilot.xray.projector import Shadow, splat

KEYPOINTS = {
    "guide": {"tip": 0.0, "20 mm behind": 20.0, "40 mm behind": 40.0},
    "catheter": {"tip": 0.0, "10 mm behind": 10.0, "20 mm behind": 20.0},
    "wire": {"tip": 0.0, "10 mm behind": 10.0, "20 mm behind": 20.0, "30 mm behind": 30.0},
}
"""Keypoints of each device: their names, and their distance behind its tip along it, mm."""
_MOST_RAYS = 256
GUIDE = np.float32(1.8)
"""A guiding catheter takes away so many times what its wall does in fluoroscopy's images: empty ones have a contrast of
0.13 to 0.22 in public cines."""
SPAN = (0.15, 0.3)
"""Range of what the C-arm leaves of a background's slow part, 5 to 95 %: with its details it then spans 0.3 to 0.6, as
in public cines."""
_REFLUX, _REFLUX_MM = 300, 4.0
"""Number of small volumes that stand for contrast in the aorta, and how far about the ostium they lie, standard
deviation, mm: an assumption."""


@dataclass(frozen=True, eq=False)
class CineFrame:
    """One frame and its truth. Pixels are (column, row), from 0 at the middle of the first one.

    Attributes:
        signal: the logarithm of the light as a monitor shows it, from 0 in the middle of its grey scale.
        grey: as a monitor shows it, from 0 (black) to 255.
        masks: by the names of `masks.CLASSES`.
        lines_mm: the axis of each device from its tip on, by name, LPS mm of the CT; it lies in the vessel as CT shows
            it, and behind the ostium along the guiding catheter. Several driven catheters are catheter, catheter_2.
        lines_px: the same in the image, as heart and breath have moved them.
    """

    signal: Float32[np.ndarray, "rows columns"]
    grey: UInt8[np.ndarray, "rows columns"]
    masks: dict[str, Bool[np.ndarray, "rows columns"]]
    lines_mm: dict[str, Float[np.ndarray, "_ 3"]]
    lines_px: dict[str, Float[np.ndarray, "_ 2"]]


class Cine:
    """One cine of a patient.

    Attributes:
        view: source and detector, in the frame of the CT.
        times_s: of the frames since heart, breath and devices began to move, s.
        placed: affine map of the vessel, and of what lies in it, from where CT shows it to where heart and breath have
            moved it at each frame, LPS mm of the CT.
        contrast: share of contrast in the blood at each frame and point of `flow`; 0 where none is injected.
        driven: the devices, or none.
        air_kerma_ugy: of a frame, at the patient's entrance reference point, µGy; 0 before the first is made.
        beam: collimator, wedge filter and cables, and `reference`, the logarithm of the usual light, from then on.
    """

    def __init__(self, config: AngiogramsConfig, draw: CineDraw, imager: XrayImager) -> None:
        """Simulate what a cine shows. Raises InputError for devices that do not fit, or no such policy."""
        self.config, self.draw, self.imager = config, draw, imager
        anatomy = imager.anatomy
        self.view: View = view_of(
            view_at(draw.angles_deg, imager.isocenter, config.image.geometry), draw.pose, imager.isocenter
        )
        self.times_s = draw.times_s(config)
        motion = motion_of(config, anatomy.name)
        self.placed = np.tile(np.eye(3, 4), (config.frames, 1, 1))
        self._before = self.placed
        if motion is not None:
            core = motion.core(np.asarray(anatomy.insertion.position))
            self.placed = core.placements(self.times_s)[0]
            self._before = core.placements(self.times_s - config.image.pulse_s)[0]
        self.flow = Flow(anatomy.tree, draw.blood_mm_s)
        random = np.random.default_rng(patient_seed(config, anatomy.name))
        self._lumen = imager.lumen_points, imager.lumen_sizes
        if is_coronary(anatomy):
            self._lumen = tuple(map(np.concatenate, zip(self._lumen, grow(anatomy, self.flow, random), strict=True)))
        self._transit_s = self.flow.transit_of(self._lumen[0])
        self.contrast = np.zeros((config.frames, len(self.flow.points)))
        if draw.injection is not None:
            times = np.arange(config.frames) / config.frames_per_second
            self._transit, self._shares = self.flow.contrast(draw.injection, times)
            self.contrast = np.stack([np.interp(self.flow.transit_s, self._transit, row) for row in self._shares])
            self._reflux_mm3 = self.flow.reflux_ml(draw.injection, times) * 1000
        self.air_kerma_ugy = 0.0
        self._guide = catheter_line(anatomy)
        none = Driven([[]] * config.frames, np.zeros((config.frames, 0, 2)))
        self.driven = drive_devices(config, draw, anatomy, imager.stack) if draw.devices else none

    @cached_property
    def projection(self) -> Float[np.ndarray, "3 4"]:
        """Matrix from LPS mm of the CT to (column, row, 1) times the depth: homogeneous pixels."""
        right, up, beam = self.view.axes
        middle = (self.config.image.pixels - 1) / 2
        rows = np.stack([self.view.scale * right + middle * beam, -self.view.scale * up + middle * beam, beam])
        return np.column_stack([rows, -rows @ self.view.source])

    def project(self, points: Float[np.ndarray, "*n 3"], frame: int) -> Float[np.ndarray, "*n 2"]:
        """Return column and row, pixels, of points of the vessel or in it, LPS mm of the CT, at a frame."""
        homogeneous = place(self.projection, place(self.placed[frame], points))
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def frames(self) -> Iterator[CineFrame]:
        """Yield the frames in turn."""
        config, draw, imager = self.config, self.draw, self.imager
        patient, pixel_mm = imager.patient(self.view, rays=self._rays()), config.image.geometry.pixel_mm
        random = np.random.default_rng(draw.noise_seed)
        self.beam = beam = Beam.draw(random, patient, pixel_mm)
        patient = patient + beam.attenuation
        first = imager.plane_through(patient, self.view, 1.0, self.placed[0])
        self.reference = first.reference
        self.air_kerma_ugy = imager.air_kerma_ugy(first, draw.dose)
        light = np.log(np.exp(-first.background) + first.scatter) - np.float32(first.reference)
        pressed = harmonised(light, beam, pixel_mm, float(random.uniform(*SPAN)))
        blur, period_s = imager.blur_px(1.0), 1 / config.frames_per_second
        reflux = imager.anatomy.insertion.position + random.normal(0, _REFLUX_MM, size=(_REFLUX, 3))
        signal: Float32[np.ndarray, "rows columns"] | None = None
        speeds = [self.driven.velocity(device, period_s) for device in range(self.driven.proximal.shape[1])]
        width_mm, (points, sizes) = imager.anatomy.distance_map.spacing_mm / 2, self._lumen
        for number, placed in enumerate(self.placed):
            shadow = Shadow(self.view, config.image.pixels, points, placed)
            lumen = shadow.of(sizes, width_mm=width_mm)
            masks = {"vessel": lumen > LUMEN_MM}
            path = np.zeros_like(lumen)
            if draw.injection is not None:
                share = np.interp(self._transit_s, self._transit, self._shares[number])
                path = shadow.of(share * sizes, width_mm=width_mm, blur_px=blur)
            masks["contrast"] = masks["vessel"] & (path > CONTRAST_SHARE * lumen)
            if draw.injection is not None:
                if number / config.frames_per_second > draw.injection.start_s:  # saline fills the catheter before
                    path += imager.guide_lumen(self.view, 1.0, placed)
                volume = self._reflux_mm3[number] / _REFLUX
                path += splat(self.view, config.image.pixels, reflux, volume, placed=placed, width_mm=_REFLUX_MM / 2)
            background = patient + GUIDE * imager.guide(self.view, 1.0, placed)
            plane = replace(first, background=background, vessel_mm=path, placed=placed)
            lines, was = self.driven.nodes[number], relative(self._before[number], placed)
            moving = [
                speed[number] + (nodes - place(was, nodes)) / max(config.image.pulse_s, 1e-9)
                for speed, nodes in zip(speeds, lines, strict=True)
            ]
            signal = imager.signal(
                plane,
                lines[0] if lines else np.zeros((0, 3)),
                contrast=float(draw.injection is not None),
                dose=draw.dose,
                seed=draw.noise_seed + number,
                before=signal,
                velocity=moving[0] if lines else None,
                catheters=lines[1:],
                catheter_velocities=moving[1:],
            )
            lines_mm = self._lines(lines)
            lines_px = {name: self.project(line, number) for name, line in lines_mm.items()}
            masks |= self._device_masks(lines_mm, lines_px, number)
            seen = shown(signal - pressed, beam)
            yield CineFrame(seen, imager.grey(seen), masks, lines_mm, lines_px)

    def keypoints(self, frame: CineFrame) -> dict[str, tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 2"]]]:
        """Return the keypoints of each device in a frame, LPS mm of the CT and pixels; NaN beyond a device's end."""
        found = {}
        for name, line in frame.lines_mm.items():
            along = length_along(line)
            at = np.array(list(KEYPOINTS[name.partition("_")[0]].values()))
            beyond = (at > along[-1])[:, None]
            pair = (places_on(points, along, at) for points in (line, frame.lines_px[name]))
            found[name] = tuple(np.where(beyond, np.nan, places) for places in pair)
        return found

    def _rays(self) -> int:
        """Return how many rays are cast through the CT along each side of the image: two a voxel, and 256 at most."""
        ct = self.imager.ct
        field_mm = self.config.image.pixels / self.view.scale * self.config.image.geometry.source_to_isocenter_mm
        return _MOST_RAYS if ct is None else min(int(np.ceil(2 * field_mm / ct.spacing_mm.min())), _MOST_RAYS)

    def _lines(self, lines: list[Float[np.ndarray, "_ 3"]]) -> dict[str, Float[np.ndarray, "_ 3"]]:
        """Return the axes of all devices by name, LPS mm of the CT."""
        names = ["wire", "catheter", *(f"catheter_{k}" for k in range(2, len(lines)))]
        anatomy, guide = self.imager.anatomy, self._guide
        laid = {name: in_catheter(anatomy, nodes, guide) for name, nodes in zip(names, lines, strict=False)}
        return {"guide": guide[1]} | laid

    def _device_masks(
        self, lines_mm: dict[str, Float[np.ndarray, "_ 3"]], lines_px: dict[str, Float[np.ndarray, "_ 2"]], number: int
    ) -> dict[str, Bool[np.ndarray, "rows columns"]]:
        stack = self.imager.stack
        radius_mm = {"guide": self.imager.anatomy.catheter_radius_mm + GUIDE_WALL_MM, "wire": stack.wire.tip_radius_mm}
        driven = [name for name in lines_mm if name.startswith("catheter")]
        radius_mm |= {name: each.tip_radius_mm for name, each in zip(driven, stack.catheters, strict=False)}
        masks: dict[str, Bool[np.ndarray, "rows columns"]] = {}
        for name, line in lines_mm.items():
            depth = (place(self.placed[number], line) - self.view.source) @ self.view.axes[2]
            drawn = stroke(lines_px[name], self.view.scale * radius_mm[name] / depth, self.config.image.pixels)
            kind = name.partition("_")[0]
            masks[kind] = masks[kind] | drawn if kind in masks else drawn
        return masks
