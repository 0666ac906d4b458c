"""The robot: the interface of a robot, its limits, the motion of a drive, and a robot in the simulator.

A drive follows a velocity command late (latency), no faster and no more suddenly than its limits, and with lost motion
where it reverses (backlash). `DriveMotion` is that and nothing else; the simulated robot puts a simulated wire behind
it, the drive process (`endopilot drive`) a clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Proximals
from endopilot.settings import NonNegative, Positive, Within, settings
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
    """A reading of a robot's encoders.

    Attributes:
        time_s: by the robot's clock, s.
        devices: inserted length Δ (mm) and rotation φ (rad, unwrapped) of each device: of the wire, then of each
            catheter from the inside out.
    """

    time_s: float
    devices: Proximals


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
        """Return the readings of the encoders."""
        ...


@settings
class RobotConfig:
    """How a real drive differs from an ideal one. docs/robot.md says where the numbers come from."""

    latency_s: Annotated[float, Within(0, 10)] = 0.05
    """Time from a command to the motion, s."""
    max_acceleration_mm_s2: Positive = 200.0
    """Largest change of the translation's speed, mm/s²."""
    max_acceleration_rad_s2: Positive = 60.0
    """Largest change of the rotation's speed, rad/s²."""
    backlash_mm: NonNegative = 0.1
    """Motion that is lost where the translation reverses, mm."""
    backlash_rad: NonNegative = 0.035
    """Motion that is lost where the rotation reverses, rad."""
    encoder_sd_mm: NonNegative = 0.02
    """Standard deviation of a reading of the inserted length, mm."""
    encoder_sd_rad: NonNegative = 0.005
    """Standard deviation of a reading of the rotation, rad."""


class DriveMotion:
    """The motion of a drive under velocity commands.

    Attributes:
        time_s: since the start, s.
        position: of the wire's proximal end: Δ, mm, and φ, rad. Set it where the wire did not follow.
        velocity: of the motor, mm/s and rad/s.
    """

    def __init__(self, limits: DriveLimits, config: RobotConfig, position: tuple[float, float]) -> None:
        """Begin at rest at a position, in the middle of the backlash."""
        self._limits = limits
        self._acceleration = np.array([config.max_acceleration_mm_s2, config.max_acceleration_rad_s2])
        self._fastest = np.array([limits.max_velocity_mm_s, limits.max_rotation_rad_s])
        self._ramp = self._acceleration
        self._half_gap = np.array([config.backlash_mm, config.backlash_rad]) / 2
        self._latency_s = config.latency_s
        self._orders: deque[tuple[float, Float[np.ndarray, "2"]]] = deque()
        self._wanted, self._ahead = np.zeros(2), np.zeros(2)
        self.time_s, self.velocity, self.position = 0.0, np.zeros(2), np.array(position, dtype=float)

    def command(self, translation: float, rotation: float) -> tuple[float, float]:
        """Take a velocity, mm/s and rad/s, which acts after the latency; return it within the limits."""
        taken = self._limits.safe(translation, rotation)
        self._orders.append((self.time_s + self._latency_s, np.array(taken)))
        return taken

    def stop(self, *, within_s: float = np.inf) -> None:
        """Brake at once, whatever was commanded before: within a time, s, where the motor's ramp would take longer."""
        self._orders.clear()
        self._wanted, self._ramp = np.zeros(2), np.maximum(self._acceleration, self._fastest / within_s)

    def advance(self, duration: float) -> Float[np.ndarray, "2"]:
        """Let some time pass, s, and return how far the wire's proximal end moves in it, mm and rad."""
        before, end = self.position.copy(), self.time_s + duration
        while self.time_s < end - 1e-12:
            while self._orders and self._orders[0][0] <= self.time_s + 1e-12:
                self._wanted, self._ramp = self._orders.popleft()[1], self._acceleration
            until = min(self._orders[0][0], end) if self._orders else end
            self._move(until - self.time_s)
            self.time_s = until
        return self.position - before

    def _move(self, duration: float) -> None:
        """Move towards the wanted velocity for a while, s: ramp, then constant; the wire follows through the gap."""
        ramp = np.minimum(np.abs(self._wanted - self.velocity) / self._ramp, duration)
        reached = self.velocity + np.sign(self._wanted - self.velocity) * self._ramp * ramp
        motor = (self.velocity + reached) / 2 * ramp + reached * (duration - ramp)
        self.velocity = reached
        ahead = np.clip(self._ahead + motor, -self._half_gap, self._half_gap)
        moved = motor - (ahead - self._ahead)
        self._ahead = ahead
        self.position = self.position + moved
        self.position[0] = np.clip(self.position[0], *self._limits.travel_mm)


class SimulatedRobot:
    """A robot whose wire, and catheters if it has any, are the one world of a simulator. Each device has its own drive.

    The encoders sit on the devices, behind the gears: they measure what backlash and a slipping drive leave of a
    command. They count from the assumed position of the ostium.

    Attributes:
        recorder: what the devices were asked for and did in each cycle so far.
        last_step: what the wire did in the drive's last cycle; None before the first.
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
            config: latency, backlash, accelerations and encoder noise.
            seed: of the encoder noise.
            ostium_mm: the true inserted lengths are this much more than the encoders', mm.
            cycle_s: period of the drives' loop, s.
        """
        self._simulator, self._ostium_mm = simulator, ostium_mm
        config = config or RobotConfig()
        self._noise = np.array([config.encoder_sd_mm, config.encoder_sd_rad])
        self._random = np.random.default_rng([seed, 1])
        self._drives = [
            DriveMotion(_by_encoder(limit, ostium_mm), config, (at, turned))
            for limit, (at, turned) in zip(limits, self._encoders().tolist(), strict=True)
        ]
        self.recorder = Recorder(simulator, cycle_s)
        self.last_step: Step | None = None

    @property
    def velocity(self) -> Float[np.ndarray, "devices 2"]:
        """The motors' velocities, mm/s and rad/s."""
        return np.array([drive.velocity for drive in self._drives])

    def stop(self) -> None:
        """Brake at once, whatever was commanded before."""
        for drive in self._drives:
            drive.stop()

    def command(self, devices: Proximals) -> Proximals:
        """Move on until the next command, and return what is made of it, as `Robot` says."""
        given = [*devices, *[(0.0, 0.0)] * len(self._drives)]
        return tuple(drive.command(*velocity) for drive, velocity in zip(self._drives, given, strict=False))

    def proximal_state(self) -> ProximalState:
        """Return the readings of the encoders; every reading has a noise of its own."""
        places = self._encoders()
        read = places + self._noise * self._random.standard_normal(places.shape)
        return ProximalState(self._drives[0].time_s, tuple((at, turn) for at, turn in read.tolist()))

    def run(self, duration: float) -> float:
        """Let the robot and its devices run for whole cycles, s, and return the largest wall force on a node, N."""
        period, peak = self.recorder.period_s, 0.0
        for _ in range(max(1, round(duration / period))):
            control = np.array([drive.advance(period) for drive in self._drives]) / period
            self.last_step = step = self.recorder.step(control[None])
            for drive, place in zip(self._drives, self._encoders(), strict=True):
                drive.position = place
            peak = max(peak, float(step.contact_force_max[0]))
        return peak

    @property
    def proximal(self) -> Float[np.ndarray, "devices 2"]:
        """Inserted length, mm, and rotation, rad, of each device as they truly are."""
        return self._simulator.proximal[0]

    def _encoders(self) -> Float[np.ndarray, "devices 2"]:
        """Return what the encoders read without noise: they count from where the ostium is assumed."""
        return self.proximal - [self._ostium_mm, 0.0]


def _by_encoder(limits: DriveLimits, ostium_mm: float) -> DriveLimits:
    """Return limits whose far end, by the encoder, is no deeper than where the device truly ends."""
    low, high = limits.travel_mm
    return replace(limits, travel_mm=(low, high - max(ostium_mm, 0.0) - _HAIR_MM))
