"""One cine, frame by frame, with the truth of each: what lies on which pixels, what shapes the beam, and `Cine`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from endopilot.angiograms.config import AngiogramsConfig
from endopilot.angiograms.draw import CineDraw, Driven, drive_devices, motion_of, patient_seed
from endopilot.angiograms.flow import Flow, grow
from endopilot.lines import length_along, places_on
from endopilot.simulation.motion import place, relative
from endopilot.xray.absorbers import GUIDE_WALL_MM, catheter_line, in_catheter, is_coronary
from endopilot.xray.carm import Affine, Image, View, view_at, view_of
from endopilot.xray.image import XrayImager
from endopilot.xray.projector import Shadow

Mask = Bool[np.ndarray, "rows columns"]
CLASSES: Mapping[str, int] = {"vessel": 1, "contrast": 2, "guide": 4, "catheter": 8, "wire": 16}
"""Names of the masks, and their bits in a mask's file: vessel (its whole lumen), contrast (where half of the blood on
the ray or more is contrast), guide (the guiding catheter), catheter (one that is driven) and wire."""
LUMEN_MM = 0.35
"""A ray passes the vessel if its path through the lumen, blurred by half a voxel, is longer, mm: so the mask ends where
the lumen does, within half a pixel, for radii from 0.5 to 2 mm."""
CONTRAST_SHARE = 0.5
_THINNEST_PX = 0.75
"""Half-width of the thinnest line, pixels: thinner ones would have gaps."""


def stroke(
    line: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, "n"], pixels: int
) -> Bool[np.ndarray, "pixels pixels"]:
    """Return the pixels whose middle lies on a line (column, row) with a radius at each point, pixels."""
    mask = np.zeros((pixels, pixels), dtype=bool)
    if len(line) < 2:
        return mask
    along = length_along(line)
    at = np.append(np.arange(0.0, along[-1], 1.0), along[-1])
    places, half = places_on(line, along, at), np.maximum(np.interp(at, along, radius), _THINNEST_PX)
    reach = int(np.ceil(half.max()))
    near = ((places > -reach) & (places < pixels - 1 + reach)).all(axis=1)
    places, half = places[near], half[near]
    around = np.arange(-reach, reach + 1)
    column = np.rint(places[:, 0]).astype(int)[:, None] + around
    row = np.rint(places[:, 1]).astype(int)[:, None] + around
    across, down = (column - places[:, :1]) ** 2, (row - places[:, 1:]) ** 2
    inside = down[:, :, None] + across[:, None, :] <= half[:, None, None] ** 2
    inside &= ((row >= 0) & (row < pixels))[:, :, None] & ((column >= 0) & (column < pixels))[:, None, :]
    number, i, j = np.nonzero(inside)
    mask[row[number, i], column[number, j]] = True
    return mask


def laid_together(masks: Mapping[str, Mask]) -> UInt8[np.ndarray, "rows columns"]:
    """Return masks by name as one image, with the bits of `CLASSES`."""
    together = np.zeros(next(iter(masks.values())).shape, dtype=np.uint8)
    for name, mask in masks.items():
        together |= np.uint8(CLASSES[name]) * mask.view(np.uint8)
    return together


def encoded(mask: Mask) -> dict[str, Any]:
    """Return COCO's run lengths of a mask, column after column: the first is of what the mask leaves out."""
    used = np.flatnonzero(mask.any(axis=0))
    left, right = (used[0], used[-1] + 1) if len(used) else (0, 0)
    flat = np.zeros(1 + (right - left) * len(mask) + 1, dtype=bool)  # between two pixels that the mask leaves out
    flat[1:-1] = mask[:, left:right].T.ravel()
    edges = left * len(mask) + np.flatnonzero(flat[1:] != flat[:-1])
    runs = np.diff(edges, prepend=0, append=mask.size)
    return {"size": list(mask.shape), "counts": (runs if runs[-1] else runs[:-1]).tolist()}


def box_of(mask: Mask) -> list[int]:
    """Return left, top, width and height of what a mask holds, pixels."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]


_SHUTTER = 0.1
"""How far the collimator's edges reach into the image at most, share of its side: 0 to 54 of 512 pixels in 24 public
cines, and little in half of them; the square root is drawn evenly."""
_PENUMBRA_MM = 0.9
"""Blur of the collimator's edges at the detector, standard deviation, mm: a focal spot of 0.8 mm through blades a fifth
of the way from the source has 0.8 mm · 4 / √12."""
CLOSED = -0.6
"""What a monitor shows beyond the collimator's edges, logarithm of the light: a grey of 35 to 60 in public cines."""
_WEDGE_SHARE, _WEDGE, _WEDGE_RAMP = 0.5, (0.3, 0.8), (0.1, 0.25)
"""Share of the cines with a wedge filter, its attenuation, and its ramp as a share of the image's side: assumptions."""
_LEADS = 3
"""Cables of the electrocardiogram in the image are fewer than this: an assumption."""
_CABLE = ((0.35, 0.08), (9.0, 0.05), (2.5, 0.35))
"""Of a cable, its electrode and the stud in it: radius on the detector, mm, and attenuation; assumptions."""
_SHOULDER = 0.25
"""What lies beyond is pressed into this much of the grey scale's 0.9 to either side, logarithm of the light."""
_BRIGHT = 80
"""Percentile of the background in the middle of the grey scale: vessels are darker than it."""
_HARMONISED_MM = 15.0
"""Details of the image wider than this on the detector, standard deviation, mm, are pressed: an assumption."""


@dataclass(frozen=True, eq=False)
class Beam:
    """The collimator's left, right, upper and lower edges, pixels, the share of the beam that it lets through, and the
    attenuation of wedge filter and cables."""

    edges: tuple[int, int, int, int]
    field: Image
    attenuation: Image

    @classmethod
    def draw(cls, random: np.random.Generator, patient: Image, pixel_mm: float) -> Beam:
        """Draw what is in the beam of a patient, whose attenuation is given: the wedge covers the brightest side."""
        pixels = len(patient)
        at, blur = np.arange(pixels), _PENUMBRA_MM / pixel_mm
        left, right, upper, lower = (round(float(share) * pixels) for share in _SHUTTER * random.random(4) ** 2)
        columns, rows = (
            ndtr((at - low + 0.5) / blur) * ndtr((pixels - high - 0.5 - at) / blur)
            for low, high in ((left, right), (upper, lower))
        )
        attenuation = np.zeros_like(patient)
        if random.random() < _WEDGE_SHARE:
            attenuation += _wedge(random, patient)
        for _ in range(int(random.integers(_LEADS))):
            attenuation += _cable(random, pixels, pixel_mm)
        field = np.outer(rows, columns).astype(np.float32)
        return cls((left, pixels - right, upper, pixels - lower), field, attenuation)


def _wedge(random: np.random.Generator, patient: Image) -> Image:
    """Return the attenuation of a filter whose edge lies across the image towards its brightest side."""
    middle = np.linspace(-0.5, 0.5, len(patient))
    turn = np.arange(0, 2 * np.pi, np.pi / 8)
    sides = np.cos(turn)[:, None, None] * middle + np.sin(turn)[:, None, None] * middle[:, None]
    brightest = sides[int(np.argmin([patient[side > 0.25].mean() for side in sides]))]
    begin, ramp = random.uniform(0.05, 0.25), random.uniform(*_WEDGE_RAMP)
    return (random.uniform(*_WEDGE) * np.clip((brightest - begin) / ramp, 0, 1)).astype(np.float32)


def _cable(random: np.random.Generator, pixels: int, pixel_mm: float) -> Image:
    """Return the attenuation of a cable that runs from above to an electrode, which may lie outside the image."""
    share, places = np.linspace(0, 1, 64)[:, None], random.uniform((-0.1, -0.1), (1.1, 1.6), (3, 2)) * pixels
    places[0, 1] = -1
    line = (1 - share) ** 2 * places[0] + 2 * share * (1 - share) * places[1] + share**2 * places[2]
    drawn = np.zeros((pixels, pixels), dtype=np.float32)
    for part, (radius, attenuation) in zip((line, line[-2:], line[-2:]), _CABLE, strict=True):
        drawn += np.float32(attenuation) * stroke(part, np.full(len(part), radius / pixel_mm), pixels)
    return gaussian_filter(drawn, _PENUMBRA_MM / 2 / pixel_mm)


def shown(light: Image, beam: Beam) -> Image:
    """Return what a monitor shows of the logarithm of the light: pressed beyond `CLOSED` on either side of the middle,
    so that nothing is black or white, and even beyond the collimator's edges."""
    within = np.clip(light, CLOSED, -CLOSED)
    within += np.float32(_SHOULDER) * np.tanh((light - within) / np.float32(_SHOULDER))
    return np.float32(CLOSED) + beam.field * (within - np.float32(CLOSED))


def harmonised(light: Image, beam: Beam, pixel_mm: float, span: float) -> Image:
    """Return what the C-arm takes off the logarithm of the light: of its slow part what spans more than `span`, and
    then the level that lies in the middle of the monitor's grey scale. Bright lungs and a dark liver then fit a
    monitor, and fine details keep their contrast."""
    slow, inside = gaussian_filter(light, _HARMONISED_MM / pixel_mm, mode="nearest"), beam.field > 0.5
    low, high = np.percentile(slow[inside], (5, 95))
    pressed = np.float32(1 - span / max(high - low, span)) * slow
    return pressed + np.float32(np.percentile((light - pressed)[inside], _BRIGHT))


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

    signal: Image
    grey: UInt8[np.ndarray, "rows columns"]
    masks: dict[str, Mask]
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
    def projection(self) -> Affine:
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
        signal: Image | None = None
        width_mm, (points, sizes) = imager.anatomy.distance_map.spacing_mm / 2, self._lumen
        for number, placed in enumerate(self.placed):
            shadow = Shadow(self.view, config.image.pixels, points, placed)
            lumen = shadow.of(sizes, width_mm=width_mm)
            vessel, path = lumen > LUMEN_MM, np.zeros_like(lumen)
            masks = {"vessel": vessel, "contrast": np.zeros_like(vessel)}
            if draw.injection is not None:
                share = np.interp(self._transit_s, self._transit, self._shares[number])
                path = shadow.of(share * sizes, width_mm=width_mm, blur_px=blur)
                masks["contrast"] = vessel & (path > CONTRAST_SHARE * lumen)
                if number / config.frames_per_second > draw.injection.start_s:  # saline fills the catheter before
                    path += imager.cloud("guide lumen", self.view, 1.0, placed)
                volume = self._reflux_mm3[number] / _REFLUX
                path += Shadow(self.view, config.image.pixels, reflux, placed).of(volume, width_mm=_REFLUX_MM / 2)
            background = patient + GUIDE * imager.cloud("guide", self.view, 1.0, placed)
            plane = replace(first, background=background, vessel_mm=path, placed=placed)
            lines, was = self.driven.nodes[number], relative(self._before[number], placed)
            moving = [
                speed + (nodes - place(was, nodes)) / max(config.image.pulse_s, 1e-9)
                for speed, nodes in zip(self.driven.velocity(number, period_s), lines, strict=True)
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
    ) -> dict[str, Mask]:
        stack = self.imager.stack
        radius_mm = {"guide": self.imager.anatomy.catheter_radius_mm + GUIDE_WALL_MM, "wire": stack.wire.tip_radius_mm}
        driven = [name for name in lines_mm if name.startswith("catheter")]
        radius_mm |= {name: each.tip_radius_mm for name, each in zip(driven, stack.catheters, strict=False)}
        masks: dict[str, Mask] = {}
        for name, line in lines_mm.items():
            depth = (place(self.placed[number], line) - self.view.source) @ self.view.axes[2]
            drawn = stroke(lines_px[name], self.view.scale * radius_mm[name] / depth, self.config.image.pixels)
            kind = name.partition("_")[0]
            masks[kind] = masks[kind] | drawn if kind in masks else drawn
        return masks
