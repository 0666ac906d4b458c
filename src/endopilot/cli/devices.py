"""`endopilot devices`: the guidewires that endopilot knows."""

from __future__ import annotations

import sys

from tyro.conf import Positional

from endopilot.cli.arguments import show_rows
from endopilot.errors import InputError
from endopilot.simulation.device import Device, device_yaml, list_devices, read_device
from endopilot.simulation.tip_load import tip_load_row

EXIT_FAILED = 1


def command(
    devices: Positional[tuple[str, ...]] = (), /, *, tip_load: bool = False, yaml: bool = False, json: bool = False
) -> None:
    """List devices: diameter, bending stiffness EI and torsional stiffness GJ at tip and shaft, tip load, tip shape.

    Args:
        devices: names of shipped devices or paths of YAML files; all shipped ones by default.
        tip_load: simulate the tip-load test instead, and leave with exit code 1 if one misses its catalogue's load.
        yaml: print the file of the device instead, to be changed into one of your own.
        json: print the rows as JSON.
    """
    chosen = devices or list_devices()
    if yaml:
        if len(devices) != 1:
            raise InputError(f"--yaml: {len(devices)} devices; name the one to print")
        read_device(devices[0])
        print(device_yaml(devices[0])[1], end="")
        return
    row_of = tip_load_row if tip_load else Device.summary
    rows = [row_of(read_device(name)) for name in chosen]
    show_rows(rows, as_json=json)
    if any(row.get("passed") is False for row in rows):
        sys.exit(EXIT_FAILED)
