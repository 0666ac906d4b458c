"""Robots in front of a simulator's devices: drives, grips, encoders and load cells; one robot a world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import DriveMotion, RobotConfig
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig, wall_stiffness
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import Step, Trajectory


class Recorder:
    """Drives a simulator in steps of `period_s` and keeps what it does."""

    def __init__(self, simulator: Simulator, period_s: float, *, record_shape: bool = False) -> None:
        """Begin where the worlds are now; `record_shape` records the positions of all nodes too."""
        self.simulator, self.period_s = simulator, period_s
        self._begun = simulator._begun
        self._commands: list[np.ndarray] = []
        self._steps: list[Step] = []
        self._shapes: list[np.ndarray] | None = [] if record_shape else None

    def step(self, control: ArrayLike) -> Step:
        """Drive every world for a period, as `Simulator.step` does."""
        self._steps.append(self.simulator.step(control, self.period_s))
        self._commands.append(np.array(control, dtype=float).reshape(self._begun[1].shape))
        if self._shapes is not None:
            self._shapes.append(self.simulator.position)
        return self._steps[-1]

    def trajectory(self) -> Trajectory:
        """Return all steps so far; ValueError if there is none."""
        if not self._steps:
            raise ValueError("nothing was driven yet")
        names = Step.__dataclass_fields__
        recorded = {name: np.stack([getattr(step, name) for step in self._steps], axis=1) for name in names}
        if self._shapes is not None:
            recorded["shape"] = self.simulator._shown(np.stack(self._shapes, axis=1), recorded["inserted_length"])
        return self.simulator._made(self._begun, np.stack(self._commands, axis=1), self.period_s, recorded)


Seed = Sequence[int]  # seed of one robot: of its gains, its jitter and its noise


def in_grip(stack: Stack, robot: RobotConfig, core: SimulatorConfig) -> tuple[Stack, SimulatorConfig]:
    """Return devices as a robot holds them, slipping where its grip yields, behind the ostium as its drives say, or
    else the stack; and settings by which the wall is as hard as before."""
    drives = robot.drives(len(stack))
    wire, *around = drives
    catheters = tuple(drive.gripped(each) for drive, each in zip(around, stack.catheters, strict=True))
    behind = zip(drives, stack.transmissions, strict=True)
    transmissions = tuple(drive.transmission if drive.transmission.length_mm else given for drive, given in behind)
    held = replace(stack, wire=wire.gripped(stack.wire), catheters=catheters, transmissions=transmissions)
    if held == stack:
        return stack, core
    if held.push_limit_n == stack.push_limit_n:
        return held, core
    return held, replace(core, wall_stiffness_n_mm=wall_stiffness(core, stack.push_limit_n))


BACKS_OUT_MM_S = 5.0
"""Speed at which a guiding catheter backs out of the ostium, mm/s: an assumption."""


def backs_out_mm(
    simulator: Simulator,
    due: bool | Bool[np.ndarray, "worlds"],
    left_mm: float | Float[np.ndarray, "worlds"],
    period_s: float,
) -> Float[np.ndarray, "worlds"]:
    """Return by how much guiding catheters back out in a period, mm: where that is due, no farther than is left, and no
    device is taken back behind the ostium."""
    room = np.maximum(simulator.inserted_length.min(axis=1), 0.0)
    return np.where(due, np.minimum(np.minimum(BACKS_OUT_MM_S * period_s, left_mm), room), 0.0)


class Robots:
    """What moves the devices of some worlds, and what is measured of them; worlds are independent.

    Encoders count from the assumed ostium: true inserted lengths are `ostium_mm` more. On the devices they measure what
    play and slip leave of a command; at the motors they see neither. The load holds what the introducer's valve takes.
    """

    def __init__(
        self,
        simulator: Simulator,
        config: RobotConfig | Sequence[RobotConfig],
        limits: Sequence[Sequence[DriveLimits]],
        *,
        seeds: Sequence[Seed],
        ostium_mm: float | Float[np.ndarray, "worlds"] = 0.0,
    ) -> None:
        """Grasp the devices where they are, with one config, or one each, and limits of the drives by the encoders."""
        worlds, devices = len(limits), len(limits[0])
        configs = [config] * worlds if isinstance(config, RobotConfig) else list(config)
        self.ostium_mm = np.broadcast_to(ostium_mm, worlds).astype(float)
        self._configs, self._at_motor = configs, np.zeros((worlds, 1, 1), dtype=bool)
        self._noise, self._load_noise = np.zeros((2, worlds, devices, 2))
        self._random = [np.random.default_rng()] * worlds
        self._grasp(range(worlds), seeds)
        counted = self._counted(simulator)
        self.motion = DriveMotion(configs, limits, counted, seeds=[[*seed, 7] for seed in seeds])

    def drive(
        self,
        simulator: Simulator,
        duration: float,
        step: Callable[[Float[np.ndarray, "worlds devices 2"]], Step],
        back_mm: float | Float[np.ndarray, "worlds"] = 0.0,
    ) -> tuple[Step, Float[np.ndarray, "worlds devices 4"]]:
        """Let the devices move for some time, s, by `step` with the drives' mean velocities, while guiding catheters
        back out; return the step and a reading. Drives take from where devices have come to that some did not follow.
        """
        velocity = self.motion.advance(duration) / duration
        velocity[..., 0] -= np.reshape(back_mm, (-1, 1)) / duration
        self.ostium_mm -= back_mm
        made = step(velocity)
        self.motion.position = self._counted(simulator)
        return made, self.read(simulator)

    def reset(
        self,
        simulator: Simulator,
        worlds: Sequence[int],
        seeds: Sequence[Seed],
        configs: Sequence[RobotConfig] | None = None,
    ) -> None:
        """Let other robots, with configs as before if not given, grasp the devices of some worlds, at rest."""
        for world, config in [] if configs is None else zip(worlds, configs, strict=True):
            self._configs[world] = config
        self._grasp(worlds, seeds)
        counted, chosen = self._counted(simulator)[list(worlds)], [self._configs[world] for world in worlds]
        self.motion.reset(worlds, counted, [[*seed, 7] for seed in seeds], chosen)

    def read(
        self,
        simulator: Simulator,
        *,
        worlds: Sequence[int] | None = None,
        encoder_noise: np.random.Generator | None = None,
    ) -> Float[np.ndarray, "chosen devices 4"]:
        """Return a reading of the encoders, mm and rad, and of the drives' loads, N and N·mm, of some worlds or all.
        The robots' own streams draw the noise if the encoders' is not given."""
        chosen = list(range(len(self._random)) if worlds is None else worlds)
        places = self.counted(simulator)[chosen]
        own, shape = [self._random[world] for world in chosen], places.shape[1:]
        streams = own if encoder_noise is None else [encoder_noise]
        encoders = places + self._noise[chosen] * np.stack([random.standard_normal(shape) for random in streams])
        load = simulator.drive_load[chosen]
        load = load + self._load_noise[chosen] * np.stack([random.standard_normal(shape) for random in own])
        return np.concatenate([encoders, load], axis=-1)

    def counted(self, simulator: Simulator) -> Float[np.ndarray, "worlds devices 2"]:
        """Return what the encoders count, without noise, mm and rad."""
        return np.where(self._at_motor, self.motion.motor, self._counted(simulator))

    def _grasp(self, worlds: Sequence[int], seeds: Sequence[Seed]) -> None:
        devices = self._noise.shape[1]
        for world, seed in zip(worlds, seeds, strict=True):
            config, self._random[world] = self._configs[world], np.random.default_rng([*seed, 8])
            self._at_motor[world] = config.encoders_at == "motor"
            self._noise[world] = config.of_drives(devices, "encoder_sd_mm", "encoder_sd_rad")
            self._load_noise[world] = config.of_drives(devices, "load_sd_n", "load_sd_n_mm")

    def _counted(self, simulator: Simulator) -> Float[np.ndarray, "worlds devices 2"]:
        """Return where the devices are at their drives, counted from where the ostium is assumed."""
        places = simulator.at_drive
        places[..., 0] -= self.ostium_mm[:, None]
        return places
