"""A C-arm whose exposures are images: the tip is found in them, in a patient whose pose is not known beforehand.

It stands for `Fluoroscope`, which assumes the errors of detection. One injection of contrast registers the patient;
then every exposure makes an image of each view, and the detector finds the tip, or says that it finds none. Each wire
that is found bounds the pose.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from endopilot.anatomy.projection import TipProjector
from endopilot.devices.device import Wire
from endopilot.errors import InputError
from endopilot.simulation.motion import Motion, published_mean
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy
from endopilot.xray.absorbers import surroundings
from endopilot.xray.carm import Pose, view_at
from endopilot.xray.detector import Signal, TipDetector
from endopilot.xray.fluoroscope import FluoroscopeConfig, TipMeasurement, measurement_at
from endopilot.xray.image import ImageConfig, Plane, XrayImager
from endopilot.xray.motion_registration import register_motion, take_run
from endopilot.xray.moving_patient import seen_wire
from endopilot.xray.pose_refinement import PoseRefiner
from endopilot.xray.registration import Registration, register, vessel_error_mm
from endopilot.xray.tip_posterior import TipEstimate

_NO_WIRE = np.zeros((0, 3))
_MOVED_MM = 0.1
"""A tip is looked for again where its image has moved the vessel by more than this, mm."""
_MOVING_SLACK_MM, _LIKELIER = 2.0, 10.0
"""In a patient who moves, a wire is also looked for this far outside the lumen, mm: their motion is not quite the known
one. It is there if the images are likelier so by this logarithm."""


class NotRegistered(InputError):
    """A vessel is not recognised in the X-ray images that were to register the patient."""


class ImageFluoroscope:
    """A C-arm around one patient, whose vessel is known from the CT and whose pose is not.

    Attributes:
        pose: in which the patient truly lies; nothing that is measured knows it.
        registration: the pose as one injection of contrast shows it.
        refiner: the pose as that and all wires so far show it.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        device: Wire,
        *,
        config: FluoroscopeConfig | None = None,
        seed: int = 0,
        known_motion: Motion | None = None,
        registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Lay the patient on the table, inject contrast and register.

        Args:
            anatomy: the vessel; a coronary artery lies in a synthetic chest, any other in water.
            device: the wire.
            config: geometry and views; its errors of detection are not used.
            seed: of the pose, up to 5 mm and 3° along and about each axis, and of these images' noise.
            known_motion: what is known of how the patient moves.
            registration_mm: the wire shows displaced by this, mm LPS, besides what the registration errs.

        Raises:
            NotRegistered: the vessel is not recognised in the images.
        """
        config = config or FluoroscopeConfig()
        random = np.random.default_rng([seed, 0x706F7365])
        angles = config.view_angles_deg[: 2 if config.biplane else 1]
        self.pose, self._anatomy, self.known_motion = Pose.draw(random), anatomy, known_motion
        self.registration_mm = registration_mm
        self._imager = XrayImager(
            anatomy, device, ct=surroundings(anatomy), config=ImageConfig(geometry=config.geometry)
        )
        self._angles_deg = angles
        self._planes = [self._imager.plane(angle, pose=self.pose) for angle in angles]
        self._views = [view_at(angle, self._imager.isocenter, config.geometry) for angle in angles]
        lit, before = ([self._signal(plane, _NO_WIRE, random, share) for plane in self._planes] for share in (1.0, 0.0))
        self._before = before
        self.registration: Registration = register(anatomy, self._views, lit, before, self._imager.config)
        if self.registration.failure:
            raise NotRegistered(f"X-ray images: {anatomy.name} cannot be registered: {self.registration.failure}")
        self._detector = TipDetector(anatomy, device)
        self._project = TipProjector(anatomy.tree, anatomy.insertion)
        self.forget_wires()
        self._slack_mm = self.refiner.slack_mm(self._views, self._detector.config.slack_mm)

    def forget_wires(self) -> None:
        """Take the patient's pose to be what contrast showed, whatever the wires since: another navigation begins."""
        self.refiner = PoseRefiner(self._anatomy, self.registration)

    def measure_motion(self, motion: Motion | None, random: np.random.Generator) -> Motion | None:
        """Inject contrast once more, take a run of images over a breath, and return how the patient moves by them.

        Args:
            motion: how the patient truly moves.
            random: where the noise is drawn from.

        Raises:
            NotRegistered: the vessel is not recognised in the images.
        """
        if motion is None or (mean := published_mean(motion)) is None:
            return None
        run = take_run(self._imager, self._angles_deg, self.pose, motion, random)
        views = self.registration.views(self._views, self._imager.isocenter)
        found = register_motion(self._anatomy, views, run, self._before, mean, self._imager.config)
        if found.failure:
            name = self._anatomy.name
            raise NotRegistered(f"X-ray images: the motion of {name} cannot be measured: {found.failure}")
        return found.motion

    def expose(
        self, simulator: Simulator, inserted_length: float, random: np.random.Generator, *, time_s: float
    ) -> TipMeasurement | None:
        """Take one exposure of every view and say where the wire's tip is, as `CArm` says."""
        ostium = self._anatomy.insertion.position
        nodes, _, _ = seen_wire(simulator, self.known_motion, ostium, time_s, self.registration_mm)
        return self.measure(nodes, inserted_length, random)

    def measure(
        self,
        nodes: Float[np.ndarray, "n 3"],
        inserted_length: float,
        random: np.random.Generator,
        *,
        refine: bool = True,
    ) -> TipMeasurement | None:
        """Take one exposure of every view and say where the tip is; None where no wire is found.

        Args:
            nodes: of the wire as it truly is, from its tip on, LPS mm.
            inserted_length: Δ by the robot's encoder, mm.
            random: where the noise is drawn from.
            refine: whether a wire whose tip is not ambiguous refines the pose that later exposures take the patient to
                lie in.
        """
        signals = [self._signal(plane, nodes, random) for plane in self._planes]
        photons = [self._imager.photons(plane) for plane in self._planes]
        image = signals, photons, inserted_length
        empty = self._before
        found = self._detector.find(self.refiner.views(self._views), *image, self._slack_mm, empty)
        if self.known_motion is not None and (beside := self._beside(found, image)) is not None:
            return self._measured(beside)
        if found is None:
            return None
        before, moved_mm = self.refiner.pose, 0.0
        if refine and found.status == "found":
            moved_mm = vessel_error_mm(self._anatomy, before, self.refiner.refine(self._views, found, self._slack_mm))
        if moved_mm > _MOVED_MM or self._slack_mm > self._detector.config.slack_mm:
            found = self._detector.find(self.refiner.views(self._views), *image, before=empty) or found
        return self._measured(found)

    def _measured(self, found: TipEstimate) -> TipMeasurement:
        return measurement_at(self._project, self._anatomy, found.position[None], found.covariance[None])

    def _beside(self, found: TipEstimate | None, image: tuple[list[Signal], list[float], float]) -> TipEstimate | None:
        """Return the tip of a wire that lies where the known motion does not take the vessel; None if it does not."""
        slack_mm = max(_MOVING_SLACK_MM, self._slack_mm)
        beside = self._detector.find(self.refiner.views(self._views), *image, slack_mm=slack_mm, before=self._before)
        if beside is None or (found is not None and beside.log_odds < found.log_odds + _LIKELIER):
            return None
        return beside

    def _signal(
        self, plane: Plane, nodes: Float[np.ndarray, "n 3"], random: np.random.Generator, contrast: float = 0.0
    ) -> Float32[np.ndarray, "rows columns"]:
        return self._imager.signal(plane, nodes, contrast=contrast, seed=int(random.integers(2**31)))
