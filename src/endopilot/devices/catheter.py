"""Catheters as data, read from YAML: devices around a wire, with a bore and the shape that they were formed to, arcs in
a plane from the tip on, each `[length_mm, angle_deg]`; a negative angle bends the other side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device import Device, DeviceFile, Sourced, Wire, WireFile, check_built, file_constants
from endopilot.devices.device_files import MOST_VALUES, ArcLength, Friction, Width, named_file
from endopilot.errors import InputError
from endopilot.files import read_text, write_yaml
from endopilot.settings import NonNegative, Positive, Text, Within, read_settings, settings

_SHIPPED = Path(__file__).parent / "catheters"
MOST_CATHETERS = 2  # catheters that a wire can have around it


@settings
class Catheter(Device):
    """A catheter around a wire.

    Attributes:
        inner_diameter_mm: diameter of its bore, mm; `bore_friction` is its Coulomb coefficient with what lies in it.
        shape: arcs it was formed to, from the tip on: length (mm) and angle (rad); straight beyond them.
    """

    inner_diameter_mm: Positive
    bore_friction: NonNegative
    shape: tuple[tuple[Positive, Annotated[float, Within(-4 * math.pi, 4 * math.pi)]], ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Catheter:
        outer = self.diameter_mm
        if self.inner_diameter_mm >= outer:
            raise ValueError(
                f"inner_diameter_mm: {self.inner_diameter_mm:g}; give less than the outer diameter, {outer:g} mm"
            )
        if len(self.shape) > MOST_VALUES:
            raise ValueError(f"shape: {len(self.shape)} arcs; give at most {MOST_VALUES}")
        return self

    def turned(self, abscissa_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the angle by which the unloaded catheter turns from its tip to distances from it, rad."""
        lengths, angles = (np.array([0.0, *(arc[part] for arc in self.shape)]) for part in (0, 1))
        return np.interp(abscissa_mm, np.cumsum(lengths), np.cumsum(angles))

    def summary(self) -> dict[str, Any]:
        """Return what a list of devices shows: `Device.summary` and `inner_diameter_mm`."""
        return Device.summary(self) | {"inner_diameter_mm": self.inner_diameter_mm}


@settings
class _Shape:
    """The arcs of a catheter's file, and where they come from."""

    arcs: tuple[tuple[ArcLength, Annotated[float, Within(-720, 720)]], ...]
    source: Text


@settings
class CatheterFile(DeviceFile):
    """What a catheter's file holds; `Catheter` says what each constant means."""

    inner_diameter_mm: Sourced[Width]
    bore_friction: Sourced[Friction]
    shape: _Shape


_ORDER = (
    *("diameter_mm", "inner_diameter_mm", "abscissa_mm", "bend_stiffness_n_mm2", "twist_stiffness_n_mm2", "shape"),
    *("friction", "bore_friction", "max_velocity_mm_s", "max_rotation_rad_s", "push_limit_n", "pull_limit_n"),
    "torque_limit_n_mm",
)
"""Of what a catheter's file holds: that of its sources is part of the identity of tasks that hold one."""


def list_catheters() -> tuple[str, ...]:
    """Return the names of the shipped catheters."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.yaml")))


def read_catheter(name_or_path: str | Path) -> Catheter:
    """Read a catheter by its name, or from a YAML file; InputError names file, field, value and mend."""
    path = named_file("catheter", name_or_path, (_SHIPPED,), list_catheters)
    content = read_settings(path, CatheterFile)
    shape = tuple((length, math.radians(angle)) for length, angle in content.shape.arcs)
    try:
        catheter = Catheter(**file_constants(content, _ORDER), shape=shape)
        check_built(catheter, bore_mm=catheter.inner_diameter_mm, arcs=catheter.shape, catheter=True)
        return catheter
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def catheter_yaml(name_or_path: str | Path) -> str:
    """Return the text of a catheter's YAML file, by name or path; InputError if there is none, or it is no text."""
    path = named_file("catheter", name_or_path, (_SHIPPED,), list_catheters)
    return read_text(path, what="catheter's YAML file")


def check_nested(wire: Wire, catheters: Sequence[Catheter]) -> None:
    """Raise InputError unless a wire and at most two catheters, from the inside out, fit into each other."""
    if len(catheters) > MOST_CATHETERS:
        raise InputError(f"catheters: {len(catheters)}; give at most {MOST_CATHETERS}")
    inner: Device = wire
    for catheter in catheters:
        if inner.diameter_mm >= catheter.inner_diameter_mm:
            raise InputError(
                f"device {inner.name}: diameter_mm = {inner.diameter_mm:g} is too wide for the bore of catheter "
                f"{catheter.name}, {catheter.inner_diameter_mm:g} mm; choose a thinner device or a wider catheter"
            )
        inner = catheter


def write_device(device: Wire | Catheter, *, output: str | Path) -> None:
    """Write a device as a YAML file that `read_wire` or `read_catheter` reads back; InputError if it cannot."""
    content: dict[str, Any] = {"name": device.name}
    of_wire = (field.name for field in fields(WireFile) if field.name != "name")
    for name in of_wire if isinstance(device, Wire) else _ORDER:
        if (value := _written(device, name)) is not None:
            content[name] = value | {"source": device.sources[name]}
    write_yaml(Path(output), content)


def _written(device: Wire | Catheter, name: str) -> dict[str, Any] | None:
    """Return what a file holds of a constant, but for its source; None where the device has none such."""
    if name == "shape":
        assert isinstance(device, Catheter)
        return {"arcs": [[length, round(math.degrees(angle), 10)] for length, angle in device.shape]}
    if name == "tip_bend":
        assert isinstance(device, Wire)
        angle_deg = round(math.degrees(device.tip_bend_rad), 10)
        exact = math.radians(angle_deg) == device.tip_bend_rad
        angle_deg = angle_deg if exact else math.degrees(device.tip_bend_rad)
        return {"angle_deg": angle_deg, "length_mm": device.tip_bend_length_mm}
    value = getattr(device, name)
    if name == "tip_shaping":
        return value and {"angle_deg": list(value.angle_deg), "length_mm": list(value.length_mm)}
    return {"value": list(value) if isinstance(value, tuple) else value}
