"""Devices as data: stiffness profiles, diameter, tip shape and friction, read from YAML and checked.

In a device's file every constant stands with its source, as `{value: ..., source: ...}`; a file without a source for
each constant is refused. A profile is piecewise linear between its abscissae, which count from the tip, and constant
beyond the last one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.simulation.device_files import device_yaml
from endopilot.types import Anatomy

_SCALARS = ("diameter_mm", "friction", "max_velocity_mm_s", "max_rotation_rad_s", "push_limit_n")
_PROFILES = ("abscissa_mm", "bend_stiffness_n_mm2", "twist_stiffness_n_mm2")
_FIELDS = ("name", *_SCALARS, *_PROFILES, "tip_load_n", "tip_bend")
_VALUE_KEYS, _TIP_BEND_KEYS = ("value", "source"), ("angle_deg", "length_mm", "source")

TIP_LENGTH_MM = 10.0
"""Length of the floppy tip, mm: the buckling length of catalogues' tip loads, and the distal coil of coronary wires."""
GRAM_FORCE_N = 9.80665e-3
"""One gram-force in N, by the standard acceleration of gravity; catalogues give tip loads in it."""


@dataclass(frozen=True, kw_only=True)
class Device:
    """A guidewire, or another slender device driven at its proximal end.

    Attributes:
        name: short name.
        diameter_mm: outer diameter, mm.
        abscissa_mm: distances from the tip at which the profiles are given, mm, increasing from 0.
        bend_stiffness_n_mm2: bending stiffness EI at those distances, N·mm².
        twist_stiffness_n_mm2: torsional stiffness GJ at those distances, N·mm².
        tip_bend_rad: angle by which the unloaded tip is bent, rad.
        tip_bend_length_mm: length from the tip over which it is bent, with constant curvature, mm.
        tip_load_n: load at which the tip buckles, as in catalogues, N; None where the maker states none.
        friction: Coulomb friction coefficient on the vessel's wall.
        max_velocity_mm_s: fastest translation of the drive, mm/s.
        max_rotation_rad_s: fastest rotation of the drive, rad/s.
        push_limit_n: force at which the drive slips rather than push the wire harder, N; a wire whose tip is caught
            is not folded up in the vessel then.
        sources: where each constant comes from.
    """

    name: str
    diameter_mm: float
    abscissa_mm: Sequence[float]
    bend_stiffness_n_mm2: Sequence[float]
    twist_stiffness_n_mm2: Sequence[float]
    tip_bend_rad: float
    tip_bend_length_mm: float
    tip_load_n: float | None
    friction: float
    max_velocity_mm_s: float
    max_rotation_rad_s: float
    push_limit_n: float
    sources: Mapping[str, str]

    def __post_init__(self) -> None:
        """Check every constant.

        Raises:
            InputError: a constant is missing, not finite or out of its range.
        """
        for name in _SCALARS:
            value = getattr(self, name)
            if not (np.isfinite(value) and (value > 0 or (name == "friction" and value == 0))):
                wanted = "a number of 0 or more" if name == "friction" else "a positive number"
                raise InputError(f"device {self.name}: {name} = {value:g} is not {wanted}; correct it")
        self._check_profiles()
        if self.tip_load_n is not None and not (np.isfinite(self.tip_load_n) and self.tip_load_n > 0):
            raise InputError(
                f"device {self.name}: tip_load_n = {self.tip_load_n:g}; give a positive load in N, or null"
            )
        bend, length = self.tip_bend_rad, self.tip_bend_length_mm
        if not (np.isfinite(bend) and abs(bend) <= 2 * np.pi):
            raise InputError(f"device {self.name}: tip_bend angle_deg = {np.rad2deg(bend):g}; give -360 to 360 degrees")
        if not (np.isfinite(length) and (length > 0 or length == bend == 0)):
            raise InputError(f"device {self.name}: tip_bend length_mm = {length:g}; a bent tip needs a positive length")

    def _check_profiles(self) -> None:
        count = len(self.abscissa_mm)
        for name in _PROFILES:
            values = np.asarray(getattr(self, name), dtype=float)
            if values.ndim != 1 or len(values) != count or count == 0:
                raise InputError(
                    f"device {self.name}: {name} holds {values.size} values and abscissa_mm {count}; give one for each"
                )
            least = "0 or more" if name == "abscissa_mm" else "positive"
            bad = ~np.isfinite(values) | ((values <= 0) if least == "positive" else (values < 0))
            if bad.any():
                raise InputError(f"device {self.name}: {name} holds {values[bad][0]:g}; every value must be {least}")
        abscissa = [float(value) for value in self.abscissa_mm]
        if abscissa[0] != 0 or (np.diff(abscissa) <= 0).any():
            raise InputError(f"device {self.name}: abscissa_mm = {abscissa} must begin at 0, the tip, and increase")

    @property
    def constants(self) -> tuple[Any, ...]:
        """All numbers of the device, in the order of its fields: devices with the same constants behave the same."""
        values = [getattr(self, field.name) for field in fields(self) if field.name not in ("name", "sources")]
        return tuple(tuple(map(float, value)) if isinstance(value, Sequence) else value for value in values)

    @property
    def tip_radius_mm(self) -> float:
        """Outer radius, mm, at the tip as everywhere."""
        return self.diameter_mm / 2

    def bend_stiffness(self, abscissa_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return EI in N·mm² at distances from the tip."""
        return np.interp(abscissa_mm, self.abscissa_mm, self.bend_stiffness_n_mm2)

    def twist_stiffness(self, abscissa_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return GJ in N·mm² at distances from the tip."""
        return np.interp(abscissa_mm, self.abscissa_mm, self.twist_stiffness_n_mm2)

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Device:
        """Return the device that `dataclasses.asdict` made a record of, as manifests hold it."""
        constants: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record.items()}
        return Device(**constants)

    def with_tip(self, *, bend_rad: float, stiffness_factor: float) -> Device:
        """Return the device with another tip.

        Args:
            bend_rad: angle by which the unloaded tip is bent, rad.
            stiffness_factor: EI and GJ of the distal `TIP_LENGTH_MM` are multiplied by it, and less and less so as far
                as the next abscissa of the profiles.
        """
        at = np.asarray(self.abscissa_mm, dtype=float)
        factor = np.where(at <= TIP_LENGTH_MM, stiffness_factor, 1.0)
        bend, twist = (
            factor * np.asarray(p, dtype=float) for p in (self.bend_stiffness_n_mm2, self.twist_stiffness_n_mm2)
        )
        return replace(
            self,
            tip_bend_rad=bend_rad,
            bend_stiffness_n_mm2=tuple(bend.tolist()),
            twist_stiffness_n_mm2=tuple(twist.tolist()),
        )

    def summary(self) -> dict[str, Any]:
        """Return what a list of devices shows.

        The keys: `name`, `diameter_mm`, bending stiffness `ei_tip_n_mm2` and `ei_shaft_n_mm2`, torsional stiffness
        `gj_tip_n_mm2` and `gj_shaft_n_mm2`, the catalogue's `tip_load_n` (N) and `tip_load_gf` (gram-force), which are
        None where it states none, `tip_bend_deg` and `friction`.
        """
        load = self.tip_load_n
        return {
            "name": self.name,
            "diameter_mm": self.diameter_mm,
            "ei_tip_n_mm2": self.bend_stiffness_n_mm2[0],
            "ei_shaft_n_mm2": self.bend_stiffness_n_mm2[-1],
            "gj_tip_n_mm2": self.twist_stiffness_n_mm2[0],
            "gj_shaft_n_mm2": self.twist_stiffness_n_mm2[-1],
            "tip_load_n": load,
            "tip_load_gf": None if load is None else round(load / GRAM_FORCE_N, 3),
            "tip_bend_deg": round(float(np.rad2deg(self.tip_bend_rad)), 3),
            "friction": self.friction,
        }


def read_device(name_or_path: str | Path) -> Device:
    """Read a device by its name (`endopilot.simulation.device_files`), or from a YAML file.

    Raises:
        InputError: no such device, or a file that is not a device; the line names file, field, value and mend.
    """
    path, text = device_yaml(name_or_path)
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        where = getattr(error, "problem_mark", None)
        line = f"line {where.line + 1}: " if where else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{path}: {line}not valid YAML ({problem}); correct the file") from error
    try:
        return _parse(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def check_fits(device: Device, anatomy: Anatomy) -> None:
    """Check that the device passes through the guiding catheter and the ostium.

    Raises:
        InputError: the device is wider than one of them.
    """
    lumen = float(anatomy.tree.branches[0].centerline.radius[0])
    for what, radius in (("lumen at the ostium", lumen), ("guiding catheter", anatomy.catheter_radius_mm)):
        if device.tip_radius_mm >= radius:
            raise InputError(
                f"device {device.name}: diameter_mm = {device.diameter_mm:g} is wider than the {what} of "
                f"{anatomy.name}, {2 * radius:.2f} mm; choose a thinner device"
            )


def _parse(content: Any) -> Device:
    if not isinstance(content, dict):
        raise InputError(
            "holds no mapping of fields; copy the form of a shipped device (`endopilot devices NAME --yaml`)"
        )
    for name in _FIELDS:
        if name not in content:
            raise InputError(f"field {name} is missing; add it")
    _refuse_unknown("", content, _FIELDS)
    if not isinstance(content["name"], str) or not content["name"].strip():
        raise InputError(f"name = {content['name']!r} is no text; give the device a name")
    sources = {name: _source(name, content[name]) for name in _FIELDS[1:]}
    tip, load = content["tip_bend"], content["tip_load_n"]["value"]
    constants: dict[str, Any] = {name: _number(name, content[name]["value"]) for name in _SCALARS}
    constants |= {name: _numbers(name, content[name]["value"]) for name in _PROFILES}
    return Device(
        name=content["name"],
        **constants,
        tip_bend_rad=float(np.deg2rad(_number("tip_bend angle_deg", tip["angle_deg"]))),
        tip_bend_length_mm=_number("tip_bend length_mm", tip["length_mm"]),
        tip_load_n=None if load is None else _number("tip_load_n", load),
        sources=sources,
    )


def _source(name: str, entry: Any) -> str:
    """Check that a field's entry is whole, and return its source."""
    keys = _TIP_BEND_KEYS if name == "tip_bend" else _VALUE_KEYS
    form = "{" + ", ".join(f"{key}: ..." for key in keys) + "}"
    if not isinstance(entry, dict):
        raise InputError(f"field {name} = {entry!r} has no source; write it as {form}")
    _refuse_unknown(f"{name} ", entry, keys)
    if not str(entry.get("source") or "").strip():
        raise InputError(f"field {name} has no source; write it as {form}")
    missing = [key for key in keys if key not in entry]
    if missing:
        raise InputError(f"field {name} has no {missing[0]}; write it as {form}")
    return str(entry["source"])


def _refuse_unknown(of: str, content: dict[Any, Any], fields: Sequence[str]) -> None:
    unknown = sorted(str(key) for key in set(content) - set(fields))
    if unknown:
        raise InputError(f"field {of}{unknown[0]} is unknown; the fields are {', '.join(fields)}")


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name} = {value!r} is not a number; correct it")
    return float(value)


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    if not isinstance(values, list):
        raise InputError(f"{name} = {values!r} is not a list of numbers; correct it")
    return tuple(_number(name, value) for value in values)
