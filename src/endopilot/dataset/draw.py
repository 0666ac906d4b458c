"""The random part of a dataset: controls, friction and tip of every navigation, and the motion of every patient.

Everything follows from the seed, the anatomy's name and the navigation's index, through random streams of their own.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from endopilot.dataset.config import DatasetConfig
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.simulation.controls import free_wire_load, random_controls
from endopilot.simulation.motion import Motion, motion_named
from endopilot.types import Anatomy

TIP_GROUP = 8
"""Navigations, from the first on, that share a drawn tip: a simulation has one rod."""
SURPLUS = (1.0, 3.0)
"""Range of what a navigation's drawn velocities are multiplied by before they become loads of the drive: how much more
than a free wire needs. It is drawn uniformly, and the result kept within the device's fastest velocities."""


@dataclass(frozen=True, eq=False)
class Draw:
    """The drawn controls, friction and tips of navigations.

    Attributes:
        initial: Δ (mm) and φ (rad) of each device before the first period.
        control: velocities (mm/s, rad/s) or loads (N, N·mm) of the drives.
        tip_stiffness_factor: factor on the stiffness of the distal 10 mm.
        seeds: of each navigation's robot.
    """

    initial: Float[np.ndarray, "n devices 2"]
    control: Float[np.ndarray, "n samples devices 2"]
    friction: Float[np.ndarray, "n"]
    tip_bend_rad: Float[np.ndarray, "n"]
    tip_stiffness_factor: Float[np.ndarray, "n"]
    seeds: tuple[tuple[int, int], ...] = ()

    def stacks(self, given: Stack) -> list[Stack]:
        """Return each navigation's devices; those of one tip share one object, and `given` itself where nothing is
        drawn."""
        made = {(given.wire.tip_bend_rad, 1.0): given}
        tips = list(zip(self.tip_bend_rad.tolist(), self.tip_stiffness_factor.tolist(), strict=True))
        for bend_rad, factor in tips:
            if (bend_rad, factor) not in made:
                wire = given.wire.with_tip(bend_rad=bend_rad, stiffness_factor=factor)
                made[bend_rad, factor] = replace(given, wire=wire)
        return [made[tip] for tip in tips]


def draw_navigations(
    config: DatasetConfig, device: Wire, anatomy: Anatomy, sequences: range, *, devices: int = 1
) -> Draw:
    """Draw some navigations of an anatomy; each is the same whatever the number of the others.

    Args:
        devices: their number, each driven independently; the wire's draw is the same with and without catheters.
    """
    controls, friction, tip, surplus, _, robots = _streams(config, anatomy.name)
    initial, control = random_controls(
        config.navigation,
        devices=devices,
        n_sequences=len(sequences),
        n_samples=config.samples,
        seed=int(controls.generate_state(1, np.uint64)[0]),
        max_inserted_length_mm=float(anatomy.tree.longest_path().abscissa[-1]),
        first=sequences.start,
    )
    groups = np.array(sequences) // TIP_GROUP
    bend, stiffness = np.moveaxis(_uniform(tip, (0.0, 1.0), (sequences.stop // TIP_GROUP + 1, 2))[groups], 1, 0)
    own = config.friction or (device.friction, device.friction)
    if config.control == "force":
        free = control * _uniform(surplus, SURPLUS, sequences.stop)[sequences.start :, None, None, None]
        control = _loads(config, device, free)
    return Draw(
        initial=initial,
        control=control,
        friction=_uniform(friction, own, sequences.stop)[sequences.start :],
        tip_bend_rad=device.tip_bend_rad * _within(config.tip_bend_factor, bend),
        tip_stiffness_factor=_within(config.tip_stiffness_factor, stiffness),
        seeds=tuple((int(robots.generate_state(1, np.uint64)[0]), index) for index in sequences),
    )


def patient_motion(config: DatasetConfig, anatomy: str) -> Motion | None:
    """Return how the vessel of an anatomy moves in the navigations of a dataset; None if it lies still."""
    return motion_named(config.motion, int(_streams(config, anatomy)[4].generate_state(1, np.uint64)[0]))


def _streams(config: DatasetConfig, anatomy: str) -> list[np.random.SeedSequence]:
    """Return the random streams of an anatomy: of controls, friction, tip, surplus, motion and robots."""
    name_number = int.from_bytes(hashlib.sha256(anatomy.encode()).digest()[:8], "little")
    return np.random.SeedSequence([config.seed, name_number]).spawn(6)


def _uniform(
    seed: np.random.SeedSequence, bounds: tuple[float, float], size: int | tuple[int, ...]
) -> Float[np.ndarray, "*size"]:
    if bounds[0] == bounds[1]:
        return np.full(size, bounds[0])
    return np.random.Generator(np.random.Philox(seed)).uniform(*bounds, size)


def _within(bounds: tuple[float, float] | None, share: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.ones_like(share) if bounds is None else bounds[0] + (bounds[1] - bounds[0]) * share


def _loads(
    config: DatasetConfig, device: Wire, velocity: Float[np.ndarray, "n samples 1 2"]
) -> Float[np.ndarray, "n samples 1 2"]:
    """Return the drive's loads (N, N·mm) that would move a free wire at these velocities, within the drive's limits."""
    fastest = DriveLimits.of(device).fastest
    return free_wire_load(
        np.clip(velocity, -fastest, fastest),
        radius_mm=device.tip_radius_mm,
        friction_n=config.simulator.introducer_friction_n,
        drag_n_s_mm=config.simulator.introducer_drag_n_s_mm,
        stick_mm_s=config.simulator.stick_velocity_mm_s,
    )
