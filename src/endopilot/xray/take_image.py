"""One X-ray image of a wire that was pushed into a vessel, alone or in a catheter: `take_image`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, UInt8

from endopilot.devices.stack import Stack, lines_from_tips
from endopilot.files import png_image, write_whole
from endopilot.runs import PNG
from endopilot.settings import LONGEST_S, Finite, Positive, Seed, Share, Text, Within, public, settings
from endopilot.simulation.motion import Motion, MotionName, motion_named, place, relative
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, Volume
from endopilot.xray.absorbers import surroundings
from endopilot.xray.image import ImageConfig, XrayImager

_SHORTEST_S = 0.0125
"""The wire is held for this long at least before the image, s: one time step."""
_MASK_SEED = 2**32
"""The image without contrast has noise of its own."""


@settings
class TakeImageConfig:
    """What is shown, from where, at which dose."""

    show: Literal["fluoroscopy", "contrast", "dsa", "roadmap"] = "fluoroscopy"
    """fluoroscopy; contrast (the vessel filled); dsa (that less the image before the injection); roadmap (fluoroscopy
    over the vessel of an injection before, in white)."""
    view_deg: tuple[Finite, Finite] = (-30.0, 0.0)
    """LAO (positive) or RAO, and cranial (positive) or caudal, degrees."""
    zoom: Annotated[float, Within(0.25, 8)] = 1.0
    """Magnification of the image."""
    dose: Positive = 1.0
    """Multiple of the usual dose of a frame."""
    contrast: Share = 1.0
    """Share of the full contrast in the vessel, where it is shown."""
    device: Text = "workhorse-014"
    """Name of a device (`endopilot devices`) or a YAML file."""
    inserted_length_mm: Annotated[float, Within(0, 5000)] = 60.0
    """Length of wire that is pushed in before, mm; 0 shows the vessel without wire and catheters."""
    rotation_rad: Finite = 0.0
    """Rotation of the wire as it goes in, rad."""
    catheter: tuple[Text, ...] = ()
    """Up to two catheters around the wire, from the inside out: names such as microcatheter-1.7f, or YAML files."""
    catheter_inserted_length_mm: Annotated[float, Within(0, 5000)] = 40.0
    """Length of the catheters that is pushed in with it, mm."""
    speed_mm_s: Finite = 0.0
    """Speed of the wire along its axis while it is exposed, mm/s: it is blurred."""
    motion: MotionName = "still"
    """How heart and breath move vessel, catheter and wire: still, breathing, heartbeat or both."""
    motion_seed: Seed | None = None
    """Draws the patient's amplitudes from the published distributions; their means if not given."""
    time_s: Annotated[float, Within(0, LONGEST_S)] = 0.0
    """Time of the image, s, from mid-diastole at the end of expiration on, where CT shows the vessel."""
    seed: Seed = 0
    """Seed of the quantum noise."""
    image: ImageConfig = field(default_factory=ImageConfig)
    """Detector and beam."""


@dataclass(frozen=True, eq=False)
class XrayImage:
    """An image, and what it cost.

    Attributes:
        grey: values from 0 (black) to 255.
        tip_pixel: row and column of the wire's true tip; None without a wire.
        air_kerma_ugy: at the patient's entrance reference point, µGy, for all its frames.
        frames: exposures that it took: two with a mask or a roadmap.
        mm_per_pixel: at the isocenter.
    """

    grey: UInt8[np.ndarray, "rows columns"]
    tip_pixel: Float[np.ndarray, "2"] | None
    air_kerma_ugy: float
    frames: int
    mm_per_pixel: float

    def write(self, path: str | Path) -> None:
        """Write the image as PNG.

        Raises:
            InputError: the suffix is not .png, or the file cannot be written.
        """
        PNG.files(Path(path))
        write_whole(path, png_image(self.grey))


@public
def take_image(anatomy: Anatomy, *, config: TakeImageConfig | None = None, ct: Volume | None = None) -> XrayImage:
    """Push a wire into a vessel, and take an X-ray image of it.

    Args:
        anatomy: the vessel.
        config: what is shown, from where, at which dose.
        ct: of the patient, HU; of a synthetic chest around a coronary artery, else 200 mm of water if not given.

    Raises:
        InputError: no such device, or it does not fit the vessel.
    """
    config = config or TakeImageConfig()
    stack = Stack.of(config.device, *config.catheter)
    motion = motion_named(config.motion, config.motion_seed)
    lines = _pushed(anatomy, stack, config, motion)
    nodes = lines[0]
    patient = surroundings(anatomy) if ct is None else ct
    imager = XrayImager(anatomy, stack, ct=patient, config=config.image)
    placed, before = np.eye(3, 4), np.eye(3, 4)  # at the end of the pulse and at its start
    if motion is not None:
        times = np.array([config.time_s, config.time_s - config.image.pulse_s])
        placed, before = motion.core(np.asarray(anatomy.insertion.position)).placements(times)[0]
    plane = imager.plane(config.view_deg, config.zoom, placed=placed)
    speeds = [np.zeros_like(line) for line in lines]
    if len(nodes):
        forwards = -np.gradient(nodes, axis=0)
        speeds[0] = config.speed_mm_s * forwards / np.linalg.norm(forwards, axis=1, keepdims=True)
        if motion is not None:
            was, pulse_s = relative(before, placed), max(config.image.pulse_s, 1e-9)
            speeds = [speed + (line - place(was, line)) / pulse_s for speed, line in zip(speeds, lines, strict=True)]
    share = config.contrast if config.show in ("contrast", "dsa") else 0.0
    signal = imager.signal(
        plane,
        nodes,
        contrast=share,
        dose=config.dose,
        seed=config.seed,
        velocity=speeds[0],
        catheters=lines[1:],
        catheter_velocities=speeds[1:],
    )
    mask = None
    if config.show == "dsa":
        mask = imager.signal(plane, nodes[:0], dose=config.dose, seed=config.seed + _MASK_SEED)
    grey = imager.grey(signal, mask=mask, roadmap=plane.vessel_mm if config.show == "roadmap" else None)
    frames = 2 if config.show in ("dsa", "roadmap") else 1
    geometry = config.image.geometry
    return XrayImage(
        grey=grey,
        tip_pixel=plane.pixel(nodes[0]) if len(nodes) else None,
        air_kerma_ugy=frames * imager.air_kerma_ugy(plane, config.dose),
        frames=frames,
        mm_per_pixel=geometry.source_to_isocenter_mm / plane.view.scale,
    )


def _pushed(
    anatomy: Anatomy, stack: Stack, config: TakeImageConfig, motion: Motion | None
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the nodes of a wire and its catheters that were pushed in, each from its tip on.

    They lie in the vessel as CT shows it. At 0 mm there is a wire without nodes, and nothing else.
    """
    if config.inserted_length_mm == 0:
        return [np.zeros((0, 3))]
    start = [
        (config.inserted_length_mm, config.rotation_rad),
        *[(config.catheter_inserted_length_mm, 0.0)] * (len(stack) - 1),
    ]
    period_s = max(config.time_s, _SHORTEST_S) if motion is not None else SAMPLE_PERIOD_S
    rollout = simulate(
        anatomy,
        stack,
        np.zeros((1, 1, len(stack), 2)),
        initial=np.array([start]),
        record_shape=True,
        motion=motion,
        period_s=period_s,
    )
    assert rollout.shape is not None
    return lines_from_tips(rollout.shape[0, -1], rollout.inserted_length[0, -1])
