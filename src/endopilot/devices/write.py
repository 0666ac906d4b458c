"""Devices as files that `read_wire` and `read_catheter` read: `write_device`."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from endopilot.devices.catheter import Catheter, CatheterFile
from endopilot.devices.device import Wire, WireFile
from endopilot.files import write_yaml


def write_device(device: Wire | Catheter, *, output: str | Path) -> None:
    """Write a wire or a catheter as a YAML file that `read_wire` or `read_catheter` reads, with the same constants.

    Args:
        device: the wire or the catheter.
        output: the file.

    Raises:
        InputError: the file cannot be written.
    """
    content = _wire(device) if isinstance(device, Wire) else _catheter(device)
    write_yaml(Path(output), content)


def _wire(wire: Wire) -> dict[str, Any]:
    content = _sourced(wire, WireFile, but=("tip_bend", "tip_shaping"))
    angle_deg = round(math.degrees(wire.tip_bend_rad), 10)
    if math.radians(angle_deg) != wire.tip_bend_rad:
        angle_deg = math.degrees(wire.tip_bend_rad)
    source = wire.sources["tip_bend"]
    content["tip_bend"] = {"angle_deg": angle_deg, "length_mm": wire.tip_bend_length_mm, "source": source}
    shaping = wire.tip_shaping
    if shaping is not None:
        limits = {"angle_deg": list(shaping.angle_deg), "length_mm": list(shaping.length_mm)}
        content["tip_shaping"] = limits | {"source": wire.sources["tip_shaping"]}
    return content


def _catheter(catheter: Catheter) -> dict[str, Any]:
    arcs = [[length, round(math.degrees(angle), 10)] for length, angle in catheter.shape]
    shape = {"arcs": arcs, "source": catheter.sources["shape"]}
    return _sourced(catheter, CatheterFile, but=("shape",)) | {"shape": shape}


def _sourced(device: Wire | Catheter, file: type, *, but: tuple[str, ...]) -> dict[str, Any]:
    """Return name and constants as a file has them, each with its source, but for those of other form."""
    content: dict[str, Any] = {"name": device.name}
    for name in (field.name for field in fields(file) if field.name not in ("name", *but)):
        value = getattr(device, name)
        content[name] = {"value": list(value) if isinstance(value, tuple) else value, "source": device.sources[name]}
    return content
