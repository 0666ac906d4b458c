"""What a cine shows, drawn at random (`draw_cine`), and how its devices move (`drive_devices`)."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from endopilot.angiograms.config import RANDOM, AngiogramsConfig
from endopilot.angiograms.flow import Injection
from endopilot.control.navigate import NavigateConfig, navigate
from endopilot.dataset.config import dataset_simulator
from endopilot.devices.stack import Stack, lines_from_tips
from endopilot.errors import InputError
from endopilot.phantom.chest import is_left
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.motion import Motion, motion_named
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy
from endopilot.xray.absorbers import is_coronary
from endopilot.xray.carm import Pose, view_at
from endopilot.xray.image import ImageConfig, isocenter_of

Range = tuple[float, float]
LEFT: dict[str, tuple[Range, Range]] = {
    "LAO caudal": ((40, 50), (-40, -25)),
    "AP caudal": ((-15, 0), (-30, -30)),
    "RAO caudal": ((-32, -20), (-30, -20)),
    "AP cranial": ((-10, 0), (35, 45)),
    "LAO cranial": ((30, 45), (25, 35)),
}
"""Ranges of LAO (positive) or RAO, and of cranial (positive) or caudal angle, degrees, for left coronary arteries:
table 2 of Di Mario and Sutaria, Heart 91, 2005."""
RIGHT: dict[str, tuple[Range, Range]] = {
    "LAO": ((45, 59), (0, 0)),
    "RAO": ((-32, -25), (0, 0)),
    "LAO cranial": ((30, 45), (25, 35)),
    "AP cranial": ((-10, 0), (35, 45)),
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
    """Draw a view, each of the vessel's kind as likely: its name, and LAO and cranial angle in its range, degrees."""
    views = OTHER if not is_coronary(anatomy) else LEFT if is_left(anatomy.tree) else RIGHT
    name = list(views)[int(random.integers(len(views)))]
    lao, cranial = (round(float(random.uniform(*bounds)), 1) for bounds in views[name])
    return name, (lao, cranial)


_MARGIN = 0.15
"""The ostium lies at least this share of the image's side within it."""
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
    """Draw a cine of a patient, of this number among theirs; it is the same whatever the others are."""
    random = np.random.default_rng([config.seed, _name_number(anatomy.name), 1, number])
    view, angles = draw_view(random, anatomy)
    if config.view_angles_deg:
        view, angles = "given", config.view_angles_deg[int(random.integers(len(config.view_angles_deg)))]
    pose = _panned(Pose.draw(random), angles, anatomy, config.image)
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


def _panned(pose: Pose, angles: tuple[float, float], anatomy: Anatomy, image: ImageConfig) -> Pose:
    """Return a pose with the table moved so far across the beam that the ostium is in the image."""
    isocenter = isocenter_of(anatomy)
    view = view_at(angles, isocenter, image.geometry)
    ostium = view.project(pose.move(anatomy.insertion.position, isocenter))
    reach = (0.5 - _MARGIN) * image.pixels
    off = (ostium - np.clip(ostium, -reach, reach)) * image.geometry.source_to_isocenter_mm / view.scale
    return replace(pose, translation_mm=pose.translation_mm - off @ view.axes[:2])


def motion_of(config: AngiogramsConfig, name: str) -> Motion | None:
    """Return how a patient's vessel moves; None where it lies still."""
    return motion_named(config.motion, patient_seed(config, name))


def patient_seed(config: AngiogramsConfig, name: str) -> int:
    """Return the seed of what is drawn once for a patient."""
    return int(np.random.default_rng([config.seed, _name_number(name), 0]).integers(2**48))


def _name_number(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")


_DEEPEST_SHARE = 0.9
"""Random devices stay within this share of the longest path; navigations go to a place within it."""
_NEAREST_SHARE = 0.4
_ATTEMPTS = 5
"""A motion that cannot be simulated is drawn again at most this often."""
_NAVIGATION_S = 45.0
"""Time limit of a policy's navigation, s."""


@dataclass(frozen=True, eq=False)
class Driven:
    """Devices at each frame, in the vessel as CT shows it: nodes of each from its tip on, LPS mm, and their Δ (mm) and
    φ (rad); and how many motions were redrawn since they could not be simulated."""

    nodes: list[list[Float[np.ndarray, "_ 3"]]]
    proximal: Float[np.ndarray, "frames devices 2"]
    redrawn: int = 0

    def velocity(self, frame: int, period_s: float) -> list[Float[np.ndarray, "_ 3"]]:
        """Return the velocity of each device's nodes at a frame, mm/s: that of places so far behind its tip."""
        speeds = [np.zeros_like(nodes) for nodes in self.nodes[frame]]
        for speed, nodes, before in zip(speeds, self.nodes[frame], self.nodes[max(frame - 1, 0)], strict=True):
            count = min(len(nodes), len(before))
            speed[:count] = (nodes[:count] - before[:count]) / period_s
        return speeds


def drive_devices(config: AngiogramsConfig, draw: CineDraw, anatomy: Anatomy, stack: Stack) -> Driven:
    """Simulate the devices of a cine. Raises InputError for devices that do not fit or cannot be simulated, or no such
    policy."""
    samples, period_s = draw.lead + config.frames, 1 / config.frames_per_second
    for attempt in range(_ATTEMPTS):
        key = [draw.drive_seed, attempt]
        if config.drive == RANDOM:
            initial, control = _random(anatomy, stack, key, samples, period_s)
        else:
            initial, control = _navigated(config, anatomy, stack, key, samples)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what cannot be simulated is drawn again, and counted
            made = simulate(
                anatomy,
                stack,
                control[None],
                initial=initial[None],
                motion=motion_of(config, anatomy.name),
                config=dataset_simulator(),
                record_shape=True,
                period_s=period_s,
            )
        if made.valid.all():
            assert made.shape is not None
            shape, proximal = made.shape[0, draw.lead :], made.proximal[0, draw.lead :]
            return Driven(
                [lines_from_tips(nodes, each[:, 0]) for nodes, each in zip(shape, proximal, strict=True)],
                proximal,
                attempt,
            )
    raise InputError(
        f"{anatomy.name}: {stack.name} could not be simulated in it; give another device, or this patient up"
    )


def _random(
    anatomy: Anatomy, stack: Stack, key: list[int], samples: int, period_s: float
) -> tuple[Float[np.ndarray, "devices 2"], Float[np.ndarray, "samples devices 2"]]:
    """Return the start of random manoeuvres and their velocities at each sample."""
    count = int(np.ceil(samples * period_s / SAMPLE_PERIOD_S)) + 1
    initial, control = random_controls(
        ControlConfig(),
        devices=len(stack),
        n_sequences=1,
        n_samples=count,
        seed=int(np.random.default_rng(key).integers(2**48)),
        max_inserted_length_mm=_DEEPEST_SHARE * float(anatomy.tree.longest_path().abscissa[-1]),
    )
    at = np.minimum((np.arange(samples) * period_s / SAMPLE_PERIOD_S).astype(int), count - 1)
    return initial[0], control[0, at]


def _navigated(
    config: AngiogramsConfig, anatomy: Anatomy, stack: Stack, key: list[int], samples: int
) -> tuple[Float[np.ndarray, "devices 2"], Float[np.ndarray, "samples devices 2"]]:
    """Let a policy drive to a drawn place; return the start of a drawn part of that, and velocities at each sample."""
    random, period_s = np.random.default_rng(key), 1 / config.frames_per_second
    leaves = anatomy.tree.leaves()
    line = anatomy.tree.path(leaves[int(random.integers(len(leaves)))])
    share = random.uniform(_NEAREST_SHARE, _DEEPEST_SHARE)
    target = line.points[int(np.searchsorted(line.abscissa, share * line.abscissa[-1]))]
    settings = NavigateConfig(
        seconds=_NAVIGATION_S,
        motion=config.motion,
        motion_seed=patient_seed(config, anatomy.name),
        tip="own",
        catheter_tilt_deg=0.0,
    )
    place = ",".join(f"{number:.3f}" for number in target)
    navigation = navigate(anatomy, place, policy=config.drive, device=stack, config=settings)
    episode = navigation.episode
    moved = np.concatenate([episode.start[0][None], episode.proximal[0]])
    last = max(navigation.record.seconds - samples * period_s, 0.0)
    at = random.uniform(0, last) + period_s * np.arange(samples + 1)
    times = episode.period_s * np.arange(len(moved))
    shown = np.apply_along_axis(lambda course: np.interp(at, times, course), 0, moved)
    return shown[0], np.diff(shown, axis=0) / period_s
