"""A C-arm whose exposures are images: the tip is found in them, in a patient whose pose is not known beforehand.

It stands for `Fluoroscope`, which assumes the errors of detection. One injection of contrast registers the patient;
then every exposure makes an image of each view, and the detector finds the tip, or says that it finds none. Each wire
that is found bounds the pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from endopilot.devices.device import Wire
from endopilot.errors import InputError
from endopilot.simulation.motion import Motion, published_mean
from endopilot.types import Anatomy
from endopilot.xray.absorbers import surroundings
from endopilot.xray.carm import Image, Places, Pose, Vector, view_at
from endopilot.xray.detector import DISPLACED_MM, TipDetector
from endopilot.xray.fluoroscope import CArm, FluoroscopeConfig, TipMeasurement
from endopilot.xray.image import ImageConfig, Plane, XrayImager
from endopilot.xray.registration import Registration, register, register_motion, take_run

_NO_WIRE = np.zeros((0, 3))
DRIFTS_MM = 0.3
"""A vessel that lies shifted drifts by this from exposure to exposure, mm: an assumption."""


class NotRegistered(InputError):
    """A vessel is not recognised in the X-ray images that were to register the patient."""


class ImageFluoroscope(CArm):
    """A C-arm around one patient whose pose is not known beforehand.

    Attributes:
        pose: in which the patient truly lies; nothing that is measured knows it.
        registration: the pose as one injection of contrast shows it.
        shift: how far the vessel lies from there, by all wires so far, LPS mm of the CT; `spread` is its covariance,
            mm².
    """

    def __init__(
        self, anatomy: Anatomy, device: Wire, *, config: FluoroscopeConfig | None = None, seed: int = 0
    ) -> None:
        """Lay the patient on the table, inject contrast and register; NotRegistered if that fails.

        A coronary artery lies in a synthetic chest, any other vessel in water. The seed draws the pose, up to 5 mm and
        3° along and about each axis, and these images' noise; the errors of detection of `config` are not used.
        """
        super().__init__(anatomy)
        config, random = config or FluoroscopeConfig(), np.random.default_rng([seed, 0x706F7365])
        self.pose, self._angles_deg = Pose.draw(random), config.view_angles_deg[: 1 + config.biplane]
        image = ImageConfig(geometry=config.geometry)
        self._imager = imager = XrayImager(anatomy, device, ct=surroundings(anatomy), config=image)
        self._planes = [imager.plane(angles, pose=self.pose) for angles in self._angles_deg]
        views = [view_at(angles, imager.isocenter, config.geometry) for angles in self._angles_deg]
        lit, before = ([self._signal(plane, _NO_WIRE, random, share) for plane in self._planes] for share in (1.0, 0.0))
        self._before = before
        self.registration: Registration = register(anatomy, views, lit, before, image)
        if self.registration.failure:
            raise NotRegistered(f"X-ray images: {anatomy.name} cannot be registered: {self.registration.failure}")
        self._detector = TipDetector(anatomy, device)
        self._registered = self.registration.views(views, imager.isocenter)
        self._photons = [imager.photons(plane) for plane in self._planes]
        self._lines = list(map(self._detector.lines, self._registered, before, self._photons))
        self.forget_wires()

    def forget_wires(self) -> None:
        """Take the vessel to lie where contrast showed it, whatever the wires since: another navigation begins."""
        off = DISPLACED_MM**2 * np.eye(3)  # of one who moves: their motion is not quite known
        self.shift, self.spread = np.zeros(3), self.registration.place_covariance(self._anatomy) + off

    def measure_motion(self, motion: Motion | None, random: np.random.Generator) -> Motion | None:
        """Inject contrast once more, take a run of images over a breath, and return how the patient moves by them;
        NotRegistered if the vessel is not recognised there."""
        if motion is None or (mean := published_mean(motion)) is None:
            return None
        run = take_run(self._imager, self._angles_deg, self.pose, motion, random)
        found = register_motion(self._anatomy, self._registered, run, self._before, mean, self._imager.config)
        if found.failure:
            name = self._anatomy.name
            raise NotRegistered(f"X-ray images: the motion of {name} cannot be measured: {found.failure}")
        return found.motion

    def _show(
        self, nodes: Places, tip: Vector, heading: Vector, inserted_length: float, random: np.random.Generator
    ) -> TipMeasurement | None:
        return self.measure(nodes, inserted_length, random)

    def measure(self, nodes: Places, inserted_length: float, random: np.random.Generator) -> TipMeasurement | None:
        """Take one exposure of every view and say where the tip of a wire with these nodes, LPS mm, is found to be,
        None where no wire is. One whose tip is not ambiguous refines the pose that later exposures take the patient to
        lie in."""
        signals = [self._signal(plane, nodes, random) for plane in self._planes]
        views = [replace(view, source=view.source - self.shift) for view in self._registered]
        found = self._detector.estimate(views, signals, self._photons, inserted_length, self._lines, self.spread)
        if found.status == "not found":
            return None
        if self.known_motion is None and found.status == "found":
            self.shift, self.spread = self.shift + found.shift, found.spread[3:, 3:] + DRIFTS_MM**2 * np.eye(3)
        return self._measured(found.position[None], found.covariance[None])

    def _signal(self, plane: Plane, nodes: Places, random: np.random.Generator, contrast: float = 0.0) -> Image:
        return self._imager.signal(plane, nodes, contrast=contrast, seed=int(random.integers(2**31)))
