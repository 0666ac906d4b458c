"""The interface of a robot, and a robot in the simulator: drives (`DriveMotion`) with simulated devices behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.drive_motion import DriveMotion
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Proximals, Stack
from endopilot.simulation.config import SimulatorConfig, wall_stiffness
from endopilot.simulation.recorder import Recorder
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step

CYCLE_S = 0.05
"""Longest period of a drive's loop, s: in the simulator its motors' mean velocity over it moves the devices. The core's
time step, a quarter of it, doubles what a navigation costs that plans nothing, and changes none of its figures."""
_HAIR_MM = 1e-9
"""What rounding may add to an inserted length, mm."""


@dataclass(frozen=True)
class ProximalState:
    """What a robot measures, of the wire and then of each catheter from the inside out.

    Attributes:
        time_s: by the robot's clock, s.
        devices: inserted length Δ (mm) and rotation φ (rad, unwrapped) as the encoders have them.
        load: axial force (N, positive when it pushes) and torque (N·mm) of each drive; empty for a robot that measures
            none.
    """

    time_s: float
    devices: Proximals
    load: Proximals = ()


@runtime_checkable
class Robot(Protocol):
    """A robot that drives a wire, and the catheters around it if it has drives for them."""

    def command(self, devices: Proximals) -> Proximals:
        """Move on until the next command, and return what is made of it: a pair for each device.

        Args:
            devices: mm/s and rad/s of the wire, then of each catheter. What is not finite stops that device, what is
                beyond its drive's limits is cut off; a device that is not given stops.
        """
        ...

    def proximal_state(self) -> ProximalState:
        """Return the readings of the encoders, and of the drives' loads."""
        ...


class SimulatedRobot:
    """A robot whose wire, and catheters if it has any, are the one world of a simulator. Each device has its own drive.

    Encoders count from the assumed position of the ostium. On the devices they measure what play and a slipping drive
    leave of a command; at the motors they see neither. The load holds what the introducer's valve takes: its friction,
    with the sign of the motion.

    Attributes:
        recorder: what the devices were asked for and did in each cycle so far, as it truly was.
        last_step: what the devices did in the drives' last cycle; None before the first.
    """

    def __init__(
        self,
        simulator: Simulator,
        limits: Sequence[DriveLimits],
        config: RobotConfig | None = None,
        *,
        seed: int = 0,
        ostium_mm: float = 0.0,
        cycle_s: float = CYCLE_S,
    ) -> None:
        """Grasp the devices where they are.

        Args:
            simulator: of one world, driven by velocity.
            limits: of the drive of the wire, then of each catheter's.
            config: latency, gains, plays, encoders and noise.
            seed: of the noise, the jitter, and the gains.
            ostium_mm: the true inserted lengths are this much more than the encoders', mm.
            cycle_s: period of the drives' loop, s.
        """
        self._simulator, self._ostium_mm, self._limits = simulator, ostium_mm, tuple(limits)
        config = config or RobotConfig()
        self._at_motor = config.encoders_at == "motor"
        self._noise = config.of_drives(len(limits), "encoder_sd_mm", "encoder_sd_rad")
        self._load_noise = config.of_drives(len(limits), "load_sd_n", "load_sd_n_mm")
        self._random, self._between = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 8])
        drives = [_by_encoder(limit, ostium_mm) for limit in limits]
        self._motion = DriveMotion(config, [drives], self._by_encoder()[None], seeds=[[seed, 7]])
        self._readings: list[Float[np.ndarray, "devices 4"]] = []
        self.recorder = Recorder(simulator, cycle_s)
        self.last_step: Step | None = None

    @property
    def velocity(self) -> Float[np.ndarray, "devices 2"]:
        """The motors' velocities, mm/s and rad/s."""
        return self._motion.velocity[0]

    def stop(self) -> None:
        """Brake at once, whatever was commanded before."""
        self._motion.stop()

    def command(self, devices: Proximals) -> Proximals:
        """Move on until the next command, and return what is made of it, as `Robot` says."""
        given = [*devices, *[(0.0, 0.0)] * len(self._limits)]
        taken = tuple(limits.safe(*velocity) for limits, velocity in zip(self._limits, given, strict=False))
        self._motion.command(np.array([taken]))
        return taken

    def proximal_state(self) -> ProximalState:
        """Return the readings of the encoders and the loads; every reading has a noise of its own."""
        read = self._read(self._random)
        if self._readings:
            self._readings[-1] = read  # what was told is what is recorded
        rows = read.tolist()
        devices, load = tuple((at, turn) for at, turn, _, _ in rows), tuple((f, m) for _, _, f, m in rows)
        return ProximalState(self._motion.time_s, devices, load)

    def run(self, duration: float) -> float:
        """Let the robot and its devices run for whole cycles, s, and return the largest wall force on a node, N."""
        period, peak = self.recorder.period_s, 0.0
        for _ in range(max(1, round(duration / period))):
            self.last_step = step = self.recorder.step(self._motion.advance(period) / period)
            self._motion.position = self._by_encoder()[None]
            self._readings.append(self._read(self._between))
            peak = max(peak, float(step.contact_force_max[0]))
        return peak

    @property
    def proximal(self) -> Float[np.ndarray, "devices 2"]:
        """Inserted length, mm, and rotation, rad, of each device as they truly are."""
        return self._simulator.proximal[0]

    @property
    def load(self) -> Float[np.ndarray, "devices 2"]:
        """Axial force, N, and torque, N·mm, of each drive as they truly are."""
        return self._simulator.drive_load[0]

    @property
    def measured(self) -> dict[str, Float[np.ndarray, "1 cycles devices 2"]]:
        """What was measured at the end of each cycle, as columns of the recorder's trajectory.

        `encoders` holds inserted length, mm, and rotation, rad; `load` axial force, N, and torque, N·mm.
        """
        read = np.array(self._readings).reshape(1, -1, len(self._limits), 4)
        return {"encoders": read[..., :2], "load": read[..., 2:]}

    def _by_encoder(self) -> Float[np.ndarray, "devices 2"]:
        """Return where the devices are, counted from where the ostium is assumed."""
        return self.proximal - [self._ostium_mm, 0.0]

    def _read(self, random: np.random.Generator) -> Float[np.ndarray, "devices 4"]:
        """Return a reading of the encoders and of the loads; the encoders' noise is that of a random stream."""
        places = self._motion.motor[0] if self._at_motor else self._by_encoder()
        encoders = places + self._noise * random.standard_normal(places.shape)
        load = self.load + self._load_noise * self._between.standard_normal(places.shape)
        return np.concatenate([encoders, load], axis=1)


def in_grip(stack: Stack, robot: RobotConfig, core: SimulatorConfig) -> tuple[Stack, SimulatorConfig]:
    """Return devices that slip where a robot's grip yields, and settings by which the wall is as hard as before.

    Args:
        stack: the devices.
        robot: what holds them.
        core: settings of the rod core, whose wall is as hard as the devices' push limits say if nothing else is given.
    """
    wire, *around = robot.drives(len(stack))
    catheters = tuple(drive.gripped(each) for drive, each in zip(around, stack.catheters, strict=True))
    held = replace(stack, wire=wire.gripped(stack.wire), catheters=catheters)
    if held == stack:
        return stack, core
    return held, replace(core, wall_stiffness_n_mm=wall_stiffness(core, stack.push_limit_n))


def _by_encoder(limits: DriveLimits, ostium_mm: float) -> DriveLimits:
    """Return limits whose far end, by the encoder, is no deeper than where the device truly ends."""
    low, high = limits.travel_mm
    return replace(limits, travel_mm=(low, high - max(ostium_mm, 0.0) - _HAIR_MM))
