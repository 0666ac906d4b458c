"""`endopilot verify` and `devices`: the core against closed forms, and the known wires."""

from __future__ import annotations

from typing import Any

from endopilot.cli.arguments import Answer
from endopilot.devices.catheter import catheter_yaml, list_catheters, read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.device_files import device_file, device_yaml, list_wires, user_devices
from endopilot.errors import InputError
from endopilot.simulation.tip_load import tip_load_row
from endopilot.verification import free_rod
from endopilot.verification.free_rod import run


def verify_command() -> Answer:
    """Compare the rod core with closed forms of free rods; print one row a case and its verdict.

    A row holds case, reference, value, error and bar. The exit code is 1 if an error exceeds its bar. In the source
    tree, `python -m benchmarks verification` also compares drives, walls, friction, catheters, moving vessels and an
    independent engine, and `python -m benchmarks --help` lists what else is measured.
    """
    rows = [case.row() for case in run(free_rod.CASES)]
    more = "more: `python -m benchmarks verification` in the source tree"
    return Answer(rows, [rows, more], passed=all(row["passed"] is not False for row in rows))


def devices_command(devices: tuple[str, ...] = (), /, *, tip_load: bool = False, yaml: bool = False) -> Answer | None:
    """List guidewires and catheters: diameters, bending and torsional stiffness EI and GJ, tip load, tip shape.

    A device is shipped, or a YAML file in ~/.config/endopilot/devices or in the folder that ENDOPILOT_DEVICES names; it
    is called by its file's name.

    Args:
        devices: names of devices or paths of wires' YAML files; all known devices by default.
        tip_load: simulate the tip-load test instead; exit code 1 if a device's error exceeds the bar. π²EI/4L² is its
            load where EI is constant over the first 10 mm.
        yaml: print the file of one device or catheter instead, to start one of your own from.
    """
    if yaml:
        if len(devices) != 1:
            raise InputError(f"--yaml: {len(devices)} devices; name the one to print")
        (name,) = devices
        _row(name)  # refuses a damaged file
        print(catheter_yaml(name) if name in list_catheters() else device_yaml(name)[1], end="")
        return None
    names = devices or (*list_wires(), *user_devices(), *(() if tip_load else list_catheters()))
    rows = [tip_load_row(read_wire(name)) if tip_load else _row(name) for name in names]
    tables = ([row for row in rows if ("inner_diameter_mm" in row) is bored] for bored in (False, True))
    return Answer(rows, list(filter(None, tables)), passed=all(row.get("passed") is not False for row in rows))


def _row(name: str) -> dict[str, Any]:
    if name in list_catheters():
        return read_catheter(name).summary()
    return read_wire(name).summary() | {"origin": "endopilot" if name in list_wires() else str(device_file(name))}
