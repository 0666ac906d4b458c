"""The interface of a robot, and a robot in the simulator: one of `Robots`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Proximals
from endopilot.simulation.robots import Recorder, Robots, backs_out_mm
from endopilot.simulation.simulator import Simulator

CYCLE_S = 0.05
"""Longest period of a drive's loop, s: in the simulator its motors' mean velocity over it moves the devices. The core's
time step, a quarter of it, doubles what a navigation costs that plans nothing, and changes none of its figures."""


@dataclass(frozen=True)
class ProximalState:
    """What a robot measures at a time by its clock, of the wire and then of each catheter from the inside out: inserted
    length Δ (mm) and rotation φ (rad, unwrapped) as the encoders have them, and axial force (N, positive when it
    pushes) and torque (N·mm) of each drive, if it measures these."""

    time_s: float
    devices: Proximals
    load: Proximals = ()


@runtime_checkable
class Robot(Protocol):
    """A robot that drives a wire, and the catheters around it if it has drives for them."""

    def command(self, devices: Proximals) -> Proximals:
        """Move on until the next command, mm/s and rad/s of the wire, then of each catheter, and return what is made of
        it. What is not finite stops that device, what is beyond its drive's limits is cut off; a device that is not
        given stops."""
        ...

    def proximal_state(self) -> ProximalState:
        """Return the readings of the encoders, and of the drives' loads."""
        ...


class SimulatedRobot:
    """A robot whose wire, and catheters if it has any, are the one world of a simulator, each with a drive of its own.
    `recorder` has what they were asked for and truly did in each cycle."""

    def __init__(
        self,
        simulator: Simulator,
        limits: Sequence[DriveLimits],
        config: RobotConfig | None = None,
        *,
        seed: int = 0,
        ostium_mm: float = 0.0,
        backs_out: tuple[float, float] = (0.0, 0.0),
        cycle_s: float = CYCLE_S,
    ) -> None:
        """Grasp the devices of a simulator's one world, driven by velocity, with drives of some limits, the wire's
        first, and gains, jitter and noise that `seed` draws. True inserted lengths are `ostium_mm` more than the
        encoders'; the guiding catheter `backs_out` of the ostium after some seconds, by some mm."""
        self._simulator, self._limits, self._random = simulator, tuple(limits), np.random.default_rng([seed, 1])
        counted = [limit.by_encoder(ostium_mm) for limit in limits]
        self._robots = Robots(simulator, config or RobotConfig(), [counted], seeds=[[seed]], ostium_mm=ostium_mm)
        self._backs_out_s, self._backs_out_mm = backs_out
        self._readings: list[Float[np.ndarray, "devices 4"]] = []
        self.recorder = Recorder(simulator, cycle_s)

    @property
    def velocity(self) -> Float[np.ndarray, "devices 2"]:
        """The motors' velocities, mm/s and rad/s."""
        return self._robots.motion.velocity[0]

    def stop(self) -> None:
        """Brake at once, whatever was commanded before."""
        self._robots.motion.stop()

    def command(self, devices: Proximals) -> Proximals:
        """Move on until the next command, and return what is made of it, as `Robot` says."""
        given = [*devices, *[(0.0, 0.0)] * len(self._limits)]
        taken = tuple(limits.safe(*velocity) for limits, velocity in zip(self._limits, given, strict=False))
        self._robots.motion.command(np.array([taken]))
        return taken

    def proximal_state(self) -> ProximalState:
        """Return the readings of encoders and loads; every reading has a noise of its own."""
        (read,) = self._robots.read(self._simulator, encoder_noise=self._random)
        if self._readings:
            self._readings[-1] = read  # what was returned is what is recorded
        rows = read.tolist()
        devices, load = tuple((at, turn) for at, turn, _, _ in rows), tuple((f, m) for _, _, f, m in rows)
        return ProximalState(self._robots.motion.time_s, devices, load)

    def run(self, duration: float) -> float:
        """Let the robot and its devices run for whole cycles, s, and return the largest wall force on a node, N."""
        period, peak = self.recorder.period_s, 0.0
        for _ in range(max(1, round(duration / period))):
            due = self._robots.motion.time_s >= self._backs_out_s - period / 2
            back_mm = backs_out_mm(self._simulator, due, self._backs_out_mm, period)
            self._backs_out_mm -= float(back_mm[0])
            step, read = self._robots.drive(self._simulator, period, self.recorder.step, back_mm)
            self._readings.append(read[0])
            peak = max(peak, float(step.contact_force_max[0]))
        return peak

    @property
    def proximal(self) -> Float[np.ndarray, "devices 2"]:
        """Inserted length, mm, and rotation, rad, of each device as they truly are."""
        return self._simulator.proximal[0]

    @property
    def counted(self) -> Float[np.ndarray, "devices 2"]:
        """Inserted length, mm, and rotation, rad, of each device as the encoders count them, without noise."""
        return self._robots.counted(self._simulator)[0]

    @property
    def measured(self) -> dict[str, Float[np.ndarray, "1 cycles devices 2"]]:
        """What was measured at the end of each cycle, as columns of the recorder's trajectory: `encoders` (mm, rad) and
        `load` (N, N·mm)."""
        read = np.array(self._readings).reshape(1, -1, len(self._limits), 4)
        return {"encoders": read[..., :2], "load": read[..., 2:]}
