"""`endopilot drive`: a simulated robotic drive that takes commands over TLS."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

from endopilot.cli.arguments import ListenConfig
from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import ASSUMED, read_robot
from endopilot.robot.drive import Drive, serve, tls_context
from endopilot.settings import Finite


def drive_command(
    *,
    certificates: Path,
    device: str = "workhorse-014",
    travel_mm: tuple[Finite, Finite] = (0.0, 300.0),
    listen: ListenConfig = ListenConfig(port=7345),
    robot: str = ASSUMED,
) -> None:
    """Run a simulated robotic drive until Ctrl-C, over TLS (docs/concepts/drive-protocol.md). No medical device.

    Args:
        certificates: folder with drive.key, drive.crt and client.crt; docs/concepts/drive-protocol.md makes them.
        device: name of a device (`endopilot devices`) or a YAML file; it sets the speed limits.
        travel_mm: least and largest inserted length, mm.
        listen: the drive's address.
        robot: name of a robot (docs/concepts/robot.md) or a YAML file: latency, accelerations and noise.
    """
    wire = read_wire(device)
    limits = DriveLimits(
        max_velocity_mm_s=wire.max_velocity_mm_s, max_rotation_rad_s=wire.max_rotation_rad_s, travel_mm=travel_mm
    )
    context = tls_context(certificates, of_drive=True)
    low, high = travel_mm
    drive = Drive(limits, now=time.monotonic(), config=read_robot(robot), inserted_length=min(max(low, 0.0), high))
    asyncio.run(serve(drive, context, listen.host, listen.port, lambda line: print(line, flush=True)))
