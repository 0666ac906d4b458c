"""What a cine shows, drawn at random: `draw_cine`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.angiograms.config import AngiogramsConfig
from endopilot.angiograms.flow import Injection
from endopilot.phantom.chest import is_left
from endopilot.simulation.motion import Motion, motion_named
from endopilot.types import Anatomy
from endopilot.xray.absorbers import is_coronary
from endopilot.xray.carm import Pose

Range = tuple[float, float]
LEFT: dict[str, tuple[Range, Range]] = {
    "LAO caudal": ((40, 50), (-40, -25)),
    "AP caudal": ((-15, 0), (-30, -30)),
    "RAO caudal": ((-45, -30), (-40, -30)),
    "AP cranial": ((-10, 0), (35, 45)),
    "LAO cranial": ((30, 45), (25, 35)),
    "lateral": ((90, 90), (-30, 30)),
}
"""Ranges of LAO (positive) or RAO, and of cranial (positive) or caudal angle, degrees, for left coronary arteries:
table 2 of Di Mario and Sutaria, Heart 91, 2005."""
RIGHT: dict[str, tuple[Range, Range]] = {
    "LAO": ((45, 60), (0, 0)),
    "RAO": ((-45, -30), (0, 0)),
    "LAO cranial": ((30, 45), (25, 35)),
    "AP cranial": ((-10, 0), (35, 45)),
    "lateral": ((90, 90), (-30, 30)),
}
"""The same for right coronary arteries."""
OTHER: dict[str, tuple[Range, Range]] = {
    "AP": ((-5, 5), (-5, 5)),
    "LAO": ((20, 40), (-10, 10)),
    "RAO": ((-40, -20), (-10, 10)),
    "lateral": ((85, 95), (-5, 5)),
}
"""The same for other vessels: frontal, oblique and lateral; an assumption."""


def draw_view(random: np.random.Generator, anatomy: Anatomy) -> tuple[str, tuple[float, float]]:
    """Draw a view of a vessel: each of its kind's is as likely, and each angle within its range.

    Returns:
        The view's name, and LAO (positive) or RAO, and cranial (positive) or caudal angle, degrees.
    """
    views = OTHER if not is_coronary(anatomy) else LEFT if is_left(anatomy.tree) else RIGHT
    name = list(views)[int(random.integers(len(views)))]
    lao, cranial = (round(float(random.uniform(*bounds)), 1) for bounds in views[name])
    return name, (lao, cranial)


def view_text(angles_deg: Sequence[float]) -> str:
    """Return a view as clinics write it, such as "LAO 45 CRAN 20"."""
    lao, cranial = angles_deg
    side, tilt = ("LAO" if lao >= 0 else "RAO"), ("CRAN" if cranial >= 0 else "CAUD")
    return f"{side} {abs(lao):.0f}" + (f" {tilt} {abs(cranial):.0f}" if cranial else "")


_START_S = (0.2, 0.8)
"""Range of the time at which an injection begins, s: an assumption."""
_BREATH_S = 4.0
"""A cine begins anywhere within a breath of this length, s, as `Motion` has it."""


@dataclass(frozen=True, eq=False)
class CineDraw:
    """What one cine shows.

    Attributes:
        angles_deg: LAO (positive) or RAO, and cranial (positive) or caudal, degrees.
        dose: of a frame, as a multiple of fluoroscopy's.
        lead: frames for which heart, breath and devices move before the first one.
        injection: of contrast; None where there is none.
        noise_seed: of the first frame's noise; it grows by one a frame.
    """

    view: str
    angles_deg: tuple[float, float]
    pose: Pose
    dose: float
    lead: int
    injection: Injection | None
    blood_mm_s: float
    devices: bool
    drive_seed: int
    noise_seed: int

    def times_s(self, config: AngiogramsConfig) -> Float[np.ndarray, "frames"]:
        """Return the times of the frames since heart, breath and devices began to move, s."""
        return (self.lead + 1 + np.arange(config.frames)) / config.frames_per_second


def draw_cine(config: AngiogramsConfig, anatomy: Anatomy, number: int) -> CineDraw:
    """Draw a cine of a patient; it is the same whatever the others are.

    Args:
        anatomy: the patient's vessel.
        number: of the cine among the patient's.
    """
    random = np.random.default_rng([config.seed, _name_number(anatomy.name), 1, number])
    view, angles = draw_view(random, anatomy)
    if config.view_angles_deg:
        view, angles = "given", config.view_angles_deg[int(random.integers(len(config.view_angles_deg)))]
    pose = Pose.draw(random)
    dose = float(np.exp(random.uniform(*np.log(config.dose))))
    lead = int(random.integers(round(_BREATH_S * config.frames_per_second)))
    start, duration, rate = (
        float(random.uniform(*bounds)) for bounds in (_START_S, config.injection_s, config.injection_ml_s)
    )
    blood = float(random.uniform(*config.blood_mm_s))
    injected, devices = random.random(2) < (config.injected_share, config.device_share)
    drive_seed, noise_seed = (int(seed) for seed in random.integers(2**48, size=2))
    injection = Injection(start, duration, rate) if injected else None
    return CineDraw(view, angles, pose, dose, lead, injection, blood, bool(devices), drive_seed, noise_seed)


def motion_of(config: AngiogramsConfig, name: str) -> Motion | None:
    """Return how a patient's vessel moves; None where it lies still."""
    return motion_named(config.motion, patient_seed(config, name))


def patient_seed(config: AngiogramsConfig, name: str) -> int:
    """Return the seed of what is drawn once for a patient."""
    return int(np.random.default_rng([config.seed, _name_number(name), 0]).integers(2**48))


def _name_number(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
