"""What a robot does to a command before a device moves, as data: `RobotConfig`, and the YAML files that hold it.

    command -> latency, jitter -> motor [encoder] -> gain -> play -> slip -> proximal end of the device [encoder]

docs/concepts/robot.md describes the chain, and says where the numbers come from.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device import Device
from endopilot.devices.device_files import named_file
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

    def delayed(self, factor: float) -> RobotConfig:
        """Return a robot whose latency is some times this one's."""
        return replace(self, latency_s=self.latency_s * factor)

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
