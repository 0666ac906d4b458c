"""What a robot does to a command before a device moves, as data (`RobotConfig`, and the YAML files that hold it), and
the motion of the drives of many robots at once (`DriveMotion`).

    command -> latency, jitter -> motor [encoder] -> gain -> play -> slip -> proximal end of the device [encoder]

docs/concepts/robot.md describes the chain, and says where the numbers come from.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device import Device
from endopilot.devices.device_files import named_file
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Transmission
from endopilot.files import write_yaml
from endopilot.settings import NonNegative, Positive, Within, public, read_settings, settings

ASSUMED, IDEAL = "assumed", "ideal"  # the robot of assumed numbers, the default, and the one that does as commanded
_SHIPPED = Path(__file__).parent / "robots"
Kind = TypeVar("Kind", bound=Device)
_MOST_SPREADS = 3.0  # a gain that is drawn lies no farther from its mean than this many standard deviations


@settings
class DriveConfig:
    """The drive of one device: motor, gears and grip, and what lies between it and the ostium."""

    max_acceleration_mm_s2: Positive = 200.0
    """Largest change of the translation's speed, mm/s²."""
    max_acceleration_rad_s2: Positive = 60.0
    """Largest change of the rotation's speed, rad/s²."""
    gain_translation: Annotated[float, Within(0.5, 2)] = 1.0
    """Motion of the device per motion of the motor: rollers are thicker or thinner than their drive reckons."""
    gain_rotation: Annotated[float, Within(0.5, 2)] = 1.0
    """The same of the rotation."""
    gain_sd_translation: Annotated[float, Within(0, 0.2)] = 0.0
    """Standard deviation of that gain from robot to robot, a share of it; a seed draws the robot."""
    gain_sd_rotation: Annotated[float, Within(0, 0.2)] = 0.0
    """The same of the rotation."""
    play_mm: Annotated[float, Within(0, 50, unit="mm")] = 0.1
    """Motion that is lost where the translation reverses, mm."""
    play_rad: Annotated[float, Within(0, 50, unit="rad", mistaken=(("°", np.pi / 180),))] = 0.035
    """Motion that is lost where the rotation reverses, rad."""
    play_sd_share: Annotated[float, Within(0, 0.5)] = 0.0
    """Standard deviation of both plays from robot to robot, a share of them; a seed draws the robot."""
    grip_n: Positive | None = None
    """Axial force beyond which the device slips in the drive's grip, N; the device's own limits hold if not given."""
    grip_n_mm: Positive | None = None
    """Torque beyond which it slips, N·mm, likewise."""
    encoder_sd_mm: NonNegative = 0.02
    """Standard deviation of a reading of the inserted length, mm."""
    encoder_sd_rad: NonNegative = 0.005
    """Standard deviation of a reading of the rotation, rad."""
    load_sd_n: NonNegative = 0.02
    """Standard deviation of a reading of the axial force, N."""
    load_sd_n_mm: NonNegative = 0.01
    """Standard deviation of a reading of the torque, N·mm."""
    transmission: Transmission = Transmission()
    """The length of the device in its guiding catheter, which twists there under friction."""

    def gripped(self, device: Kind) -> Kind:
        """Return a device with the limits at which it slips in this drive."""
        force, torque = self.grip_n or np.inf, self.grip_n_mm or np.inf
        return replace(
            device,
            push_limit_n=min(device.push_limit_n, force),
            pull_limit_n=min(device.pull_limit_n, force),
            torque_limit_n_mm=min(device.torque_limit_n_mm, torque),
        )


@settings
class RobotConfig:
    """A robot. What a file leaves out is as here, in the robot `assumed`."""

    encoders_at: Literal["motor", "wire"] = "wire"
    """Where the encoders sit: on the motors, in front of gain, play and slip, which they do not see; or on the devices,
    behind them."""
    latency_s: Annotated[float, Within(0, 10, unit="s", mistaken=(("ms", 1e-3),))] = 0.05
    """Time from a command to the motion, s."""
    jitter_s: Annotated[float, Within(0, 10, unit="s", mistaken=(("ms", 1e-3),))] = 0.0
    """A command comes later than that by up to this time, s, evenly drawn; none overtakes the one before."""
    wire: DriveConfig = DriveConfig()
    """Drive of the wire."""
    catheters: tuple[DriveConfig, ...] = (DriveConfig(),)
    """Drives of the catheters around it, from the inside out; the last serves all further ones."""
    sources: tuple[str, ...] = ()
    """Where numbers come from, a line each, such as "play_mm: 2.4 to 2.6 measured"."""

    @model_validator(mode="after")
    def _consistent(self) -> RobotConfig:
        if not self.catheters:
            raise ValueError("catheters: []; give at least one drive, which then serves all catheters")
        return self

    def drives(self, count: int) -> tuple[DriveConfig, ...]:
        """Return the drives of the wire and of the catheters around it, of some devices in all."""
        around = [self.catheters[min(k, len(self.catheters) - 1)] for k in range(count - 1)]
        return (self.wire, *around)

    def of_drives(self, count: int, *names: str) -> Float[np.ndarray, "devices numbers"]:
        """Return some fields of each drive, of some devices in all."""
        return np.array([[getattr(drive, name) for name in names] for drive in self.drives(count)])

    def gains(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "devices 2"]:
        """Return the gains of one robot's drives, drawn; of translation and rotation of each device."""
        spread = self.of_drives(count, "gain_sd_translation", "gain_sd_rotation")
        drawn = np.clip(random.standard_normal(spread.shape), -_MOST_SPREADS, _MOST_SPREADS)
        return self.of_drives(count, "gain_translation", "gain_rotation") * (1 + spread * drawn)

    def plays(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "devices 2"]:
        """Return the plays of one robot's drives, drawn, mm and rad."""
        drawn = np.clip(random.standard_normal((count, 2)), -_MOST_SPREADS, _MOST_SPREADS)
        spread = self.of_drives(count, "play_sd_share")
        return self.of_drives(count, "play_mm", "play_rad") * np.maximum(1 + spread * drawn, 0.0)

    def run_out(self, velocity: Float[np.ndarray, "devices 2"]) -> Float[np.ndarray, "devices 2"]:
        """Return how far motors go on, from a velocity (mm/s, rad/s), before they obey a stop, mm and rad."""
        braking = self.of_drives(len(velocity), "max_acceleration_mm_s2", "max_acceleration_rad_s2")
        return velocity * self.latency_s + velocity * np.abs(velocity) / (2 * braking)

    def write(self, path: Path | str) -> None:
        """Write the robot as a YAML file for `read_robot`, whole or not at all; InputError if it cannot be written."""
        write_yaml(Path(path), asdict(self))


def list_robots() -> tuple[str, ...]:
    """Return the names of the robots that the package knows."""
    return (ASSUMED, *sorted(path.stem for path in _SHIPPED.glob("*.yaml")))


@public
def read_robot(name_or_path: str | Path) -> RobotConfig:
    """Read a robot by its name, or from a YAML file; InputError names file, field, value and mend."""
    if str(name_or_path) == ASSUMED:
        return RobotConfig()
    path = named_file("robot", name_or_path, (_SHIPPED,), list_robots)
    return read_settings(path, RobotConfig, onto=RobotConfig())


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
        self._latency_s, self._jitter_s, self._clock = (np.zeros(robots) for _ in range(3))
        self._acceleration, self._gain, self._half_play, self._ahead = (np.zeros(position.shape) for _ in range(4))
        self._wanted, self._ramp, self.velocity, self.motor, self.position = (
            np.zeros(position.shape) for _ in range(5)
        )
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
