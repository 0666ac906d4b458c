"""The motion of drives under velocity commands, of many robots at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig


def through_play(
    ahead: Float[np.ndarray, "*n"], driven: Float[np.ndarray, "*n"], half_gap: Float[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Let motors go on, and return how far they are `ahead` of their devices (e − p, at most half a gap) then, and how
    far the devices went, mm or rad, by the play operator p ← clip(p, e − half_gap, e + half_gap)."""
    after = np.clip(ahead + driven, -half_gap, half_gap)
    return after, driven - (after - ahead)


_ROUNDING_S = 1e-12


class DriveMotion:
    """The motion of the drives of some robots, which do not depend on each other: late, limited, with gain and play.

    `motor` is where the devices would be without gain and play, what an encoder there counts; `position` is of their
    proximal ends, to be set where a device did not follow (mm, rad).
    """

    def __init__(
        self,
        config: RobotConfig | Sequence[RobotConfig],
        limits: Sequence[Sequence[DriveLimits]],
        position: Float[np.ndarray, "robots devices 2"],
        *,
        seeds: Sequence[int | Sequence[int]] = (0,),
    ) -> None:
        """Begin at rest at Δ, mm, and φ, rad, in the middle of the play, or somewhere in it if the encoders do not see
        it; gains and jitter follow from each robot's seed."""
        robots = len(position)
        self._fastest = np.array([[each.fastest for each in of_robot] for of_robot in limits])
        self._travel = np.moveaxis(np.array([[each.travel_mm for each in of_robot] for of_robot in limits]), -1, 0)
        self._latency_s, self._jitter_s, self._clock = np.zeros((3, robots))
        self._acceleration, self._gain, self._half_play, self._ahead = np.zeros((4, *position.shape))
        self._wanted, self._ramp, self.velocity, self.motor, self.position = np.zeros((5, *position.shape))
        self._random: list[np.random.Generator] = [np.random.default_rng()] * robots
        self._orders: deque[tuple[Float[np.ndarray, "robots"], Float[np.ndarray, "robots devices 2"]]] = deque()
        self.reset(range(robots), position, seeds, [config] * robots if isinstance(config, RobotConfig) else config)

    @property
    def time_s(self) -> float:
        """Time since the start, s."""
        return float(self._clock[0])

    def command(self, velocity: Float[np.ndarray, "robots devices 2"]) -> None:
        """Take velocities within the limits, mm/s and rad/s, which act after latency and jitter."""
        late = np.array([random.random() for random in self._random])
        due = self._clock + self._latency_s + self._jitter_s * late
        if self._orders:
            due = np.maximum(due, self._orders[-1][0])
        self._orders.append((due, np.array(velocity, dtype=float)))

    def stop(self, *, within_s: float = np.inf) -> None:
        """Brake at once, whatever was commanded before: within a time, s, where the motors' ramp would take longer."""
        self._orders.clear()
        self._wanted = np.zeros_like(self._wanted)
        self._ramp = np.maximum(self._acceleration, self._fastest / within_s)

    def reset(
        self,
        robots: Sequence[int],
        position: Float[np.ndarray, "chosen devices 2"],
        seeds: Sequence[int | Sequence[int]],
        configs: Sequence[RobotConfig],
    ) -> None:
        """Put other robots, drawn by their seeds, in the place of some, at rest where they are: gains, half the plays,
        and how far the motors are ahead of the devices: not at all, or anywhere in the play where encoders at the
        motors do not see it."""
        chosen, devices = np.asarray(robots, dtype=int), position.shape[1]
        for robot, seed, config in zip(robots, seeds, configs, strict=True):
            self._random[robot] = random = np.random.default_rng(seed)
            self._latency_s[robot], self._jitter_s[robot] = config.latency_s, config.jitter_s
            self._acceleration[robot] = config.of_drives(devices, "max_acceleration_mm_s2", "max_acceleration_rad_s2")
            self._gain[robot] = config.gains(devices, random)
            apart = random.spawn(1)[0]  # what is drawn from the stream stays the same
            self._half_play[robot] = half_play = config.plays(devices, apart) / 2
            self._ahead[robot] = apart.uniform(-1.0, 1.0, half_play.shape) * half_play * (config.encoders_at == "motor")
        self._top = self._fastest / np.maximum(self._gain, 1.0)  # of the motors: no device goes faster than its limit
        for due, velocity in self._orders:
            due[chosen], velocity[chosen] = -np.inf, 0.0
        for array in (self._wanted, self.velocity):
            array[chosen] = 0.0
        self._ramp[chosen], self._clock[chosen] = self._acceleration[chosen], 0.0
        self.motor[chosen], self.position[chosen] = position, position

    def advance(self, duration: float) -> Float[np.ndarray, "robots devices 2"]:
        """Let some time pass, s, and return how far the devices' proximal ends move in it, mm and rad."""
        before, end = self.position.copy(), self._clock + duration
        while (self._clock < end - _ROUNDING_S).any():
            self._obey()
            until = np.minimum(self._next(), end)
            self._move((until - self._clock)[:, None, None])
            self._clock = until
        return self.position - before

    def _obey(self) -> None:
        """Take what is due of each robot, and forget what all have taken."""
        for due, velocity in self._orders:
            here = due <= self._clock + _ROUNDING_S
            self._wanted = np.where(here[:, None, None], np.clip(velocity, -self._top, self._top), self._wanted)
            self._ramp = np.where(here[:, None, None], self._acceleration, self._ramp)
        while self._orders and (self._orders[0][0] <= self._clock + _ROUNDING_S).all():
            self._orders.popleft()

    def _next(self) -> Float[np.ndarray, "robots"]:
        times = [np.where(due <= self._clock + _ROUNDING_S, np.inf, due) for due, _ in self._orders]
        return np.min(times, axis=0) if times else np.full_like(self._clock, np.inf)

    def _move(self, duration: Float[np.ndarray, "robots 1 1"]) -> None:
        """Move towards the wanted velocity for a while, s: ramp, then constant; the devices follow through the play."""
        ramp = np.minimum(np.abs(self._wanted - self.velocity) / self._ramp, duration)
        reached = self.velocity + np.sign(self._wanted - self.velocity) * self._ramp * ramp
        motor = (self.velocity + reached) / 2 * ramp + reached * (duration - ramp)
        self.velocity, self.motor = reached, self.motor + motor
        driven = self._gain * motor
        self._ahead, moved = through_play(self._ahead, driven, self._half_play)
        self.position = self.position + moved
        self.position[..., 0] = np.clip(self.position[..., 0], *self._travel)
