"""How wire and catheters move in a cine: at random, or as a policy drives them (`drive_devices`)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.angiograms.config import RANDOM, AngiogramsConfig
from endopilot.angiograms.draw import CineDraw, motion_of, patient_seed
from endopilot.control.navigate import NavigateConfig, navigate
from endopilot.dataset.config import dataset_simulator
from endopilot.devices.stack import Stack, lines_from_tips
from endopilot.errors import InputError
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

_DEEPEST_SHARE = 0.9
"""Random devices stay within this share of the longest path; navigations go to a place within it."""
_NEAREST_SHARE = 0.4
_ATTEMPTS = 5
"""A motion that cannot be simulated is drawn again at most this often."""
_NAVIGATION_S = 45.0
"""Time limit of a policy's navigation, s."""


@dataclass(frozen=True, eq=False)
class Driven:
    """Devices at each frame, in the vessel as CT shows it.

    Attributes:
        nodes: of each frame and device, from its tip on, LPS mm.
        proximal: Δ (mm) and φ (rad) of each device.
        redrawn: motions that could not be simulated.
    """

    nodes: list[list[Float[np.ndarray, "_ 3"]]]
    proximal: Float[np.ndarray, "frames devices 2"]
    redrawn: int = 0

    def velocity(self, device: int, period_s: float) -> list[Float[np.ndarray, "_ 3"]]:
        """Return the velocity of a device's nodes at each frame, mm/s: that of places so far behind its tip."""
        lines = [nodes[device] for nodes in self.nodes]
        speeds = []
        for frame, nodes in enumerate(lines):
            before = lines[max(frame - 1, 0)]
            count = min(len(nodes), len(before))
            speed = np.zeros_like(nodes)
            speed[:count] = (nodes[:count] - before[:count]) / period_s
            speeds.append(speed)
        return speeds


def drive_devices(config: AngiogramsConfig, draw: CineDraw, anatomy: Anatomy, stack: Stack) -> Driven:
    """Simulate the devices of a cine.

    Raises:
        InputError: the devices do not fit, no motion of them can be simulated, or there is no such policy.
    """
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
