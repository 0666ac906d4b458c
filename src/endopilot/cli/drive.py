"""`endopilot drive`: a simulated robotic drive that takes commands over TCP."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Annotated

from endopilot.control.drive import Drive, serve
from endopilot.control.drive_protocol import read_secret
from endopilot.control.robot import RobotConfig
from endopilot.settings import Finite, Within, settings
from endopilot.simulation.device import read_device
from endopilot.simulation.drive_limits import DriveLimits


@settings
class ListenConfig:
    """The drive's address and travel."""

    host: str = "127.0.0.1"
    """Address to listen on; by default only this machine can connect."""
    port: Annotated[int, Within(0, 65535)] = 7345
    """TCP port; 0 for a free one."""
    travel_mm: tuple[Finite, Finite] = (0.0, 300.0)
    """Least and largest inserted length, mm."""


def command(
    *,
    secret: Path,
    device: str = "workhorse-014",
    listen: ListenConfig = ListenConfig(),
    config: RobotConfig = RobotConfig(),
) -> None:
    """Run a simulated robotic drive until Ctrl-C; one client commands it over TCP (docs/robot.md). No medical device.

    Args:
        secret: file with the secret that drive and client share, at least 16 bytes, readable by you alone.
        device: name of a device (`endopilot devices`) or a YAML file; it sets the speed limits.
        listen: address and travel.
        config: latency, accelerations, backlash and encoder noise.
    """
    wire = read_device(device)
    limits = DriveLimits(
        max_velocity_mm_s=wire.max_velocity_mm_s,
        max_rotation_rad_s=wire.max_rotation_rad_s,
        travel_mm=listen.travel_mm,
    )
    drive = Drive(
        limits,
        read_secret(secret),
        now=time.monotonic(),
        config=config,
        inserted_length=max(listen.travel_mm[0], 0.0),
        report=lambda line: print(line, flush=True),
    )
    asyncio.run(
        serve(drive, listen.host, listen.port, lambda port: print(f"listening on {listen.host}:{port}", flush=True))
    )
