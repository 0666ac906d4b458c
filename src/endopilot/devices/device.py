"""Devices as data: stiffness profiles, diameter, tip shape and friction, read from YAML, each with its source, as
`{value: ..., source: ...}`. A profile is linear between its abscissae, which count from the tip, and constant beyond.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device_files import (
    GRAM_FORCE_N,
    MOST_VALUES,
    TIP_LENGTH_MM,
    Abscissa,
    Angle,
    ArcLength,
    BendLength,
    Force,
    Friction,
    Rotation,
    Stiffness,
    TipLoad,
    Torque,
    Velocity,
    Width,
    device_file,
)
from endopilot.errors import InputError
from endopilot.settings import Ascending, NonNegative, Positive, Text, Within, public, read_settings, settings
from endopilot.types import Anatomy

Value = TypeVar("Value")

_MODULUS_MPA = (0.1, 250e3)
"""Young's modulus that EI and the section may imply, MPa: from a tenth of the softest published rod's, 1 MPa, to just
above that of cobalt alloys, 233 GPa; steel has 200 GPa."""
_WIRE_RATIO = (0.63, 1.05)  # GJ/EI of a wire: 1/(1 + ν) of a round section, ν from 0 to 0.5, and 5 % for rounding
_CATHETER_RATIO = (0.63, 3.0)  # the same of a catheter, whose braid may raise GJ
_FALL = 3.0  # factor by which EI may fall from the tip on; devices stiffen towards the shaft
_STIFFENING = 1e5  # largest ratio of EI along a device
_LOAD_FACTOR = 10.0  # between a catalogue's tip load and that of the tip's EI: protocols differ
_STRENGTH_MPA = 3000.0  # tensile strength of the strongest steel wire, 0.3 mm thick, MPa (EN 10270-1)
_LEAST_DEG = math.degrees(math.pi) / 57  # a bend up to this, some 3.16 °, is one in rad: half a turn has π of them


@settings
class TipShaping:
    """The bends that a hand can give a wire's tip: least and largest angle (degrees) and length from the tip (mm)."""

    angle_deg: Annotated[tuple[NonNegative, NonNegative], Ascending]
    length_mm: Annotated[tuple[Positive, Positive], Ascending]

    def allows(self, angle_deg: float, length_mm: float) -> bool:
        """Return whether a hand can bend the tip by an angle (degrees) over a length (mm)."""
        (least, largest), (shortest, longest) = self.angle_deg, self.length_mm
        return least <= angle_deg <= largest and shortest <= length_mm <= longest


@settings
class Device:
    """A slender device that is driven at its proximal end: what a wire and a catheter have in common.

    Attributes:
        name: short name.
        diameter_mm: outer diameter, mm.
        abscissa_mm: distances from the tip at which the profiles are given, mm, increasing from 0.
        bend_stiffness_n_mm2: bending stiffness EI at those distances, N·mm².
        twist_stiffness_n_mm2: torsional stiffness GJ at those distances, N·mm².
        friction: Coulomb friction coefficient on the vessel's wall.
        max_velocity_mm_s: fastest translation of the drive, mm/s.
        max_rotation_rad_s: fastest rotation of the drive, rad/s.
        push_limit_n: force at which the drive slips rather than push the device harder, N; a wire whose tip is caught
            is not folded up in the vessel then.
        pull_limit_n: force at which it slips rather than pull harder, N.
        torque_limit_n_mm: torque at which it slips rather than turn the device harder, in either direction, N·mm.
        sources: where each constant comes from.
    """

    name: Text
    diameter_mm: Positive
    abscissa_mm: tuple[NonNegative, ...]
    bend_stiffness_n_mm2: tuple[Positive, ...]
    twist_stiffness_n_mm2: tuple[Positive, ...]
    friction: NonNegative
    max_velocity_mm_s: Positive
    max_rotation_rad_s: Positive
    push_limit_n: Positive
    pull_limit_n: Positive
    torque_limit_n_mm: Positive
    sources: dict[str, str]

    @model_validator(mode="after")
    def _profiles_fit(self) -> Device:
        at = self.abscissa_mm
        if at[:1] != (0.0,) or any(after <= before for before, after in pairwise(at)):
            raise ValueError(f"abscissa_mm: {list(at)}; begin at 0, the tip, and increase")
        if len(at) > MOST_VALUES:
            raise ValueError(f"abscissa_mm: {len(at)} values; give at most {MOST_VALUES}")
        for name in ("bend_stiffness_n_mm2", "twist_stiffness_n_mm2"):
            count = len(getattr(self, name))
            if count != len(at):
                raise ValueError(f"{name}: {count} values, but abscissa_mm has {len(at)}; give one for each")
        return self

    @property
    def constants(self) -> tuple[Any, ...]:
        """All numbers of the device, in the order of its fields: devices with the same constants behave the same."""
        others = ("name", "sources", "tip_shaping")
        return tuple(getattr(self, field.name) for field in fields(self) if field.name not in others)

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

    def summary(self) -> dict[str, Any]:
        """Return `name`, `diameter_mm`, EI and GJ at tip and shaft (as `ei_tip_n_mm2`), and `friction`."""
        return {
            "name": self.name,
            "diameter_mm": self.diameter_mm,
            "ei_tip_n_mm2": self.bend_stiffness_n_mm2[0],
            "ei_shaft_n_mm2": self.bend_stiffness_n_mm2[-1],
            "gj_tip_n_mm2": self.twist_stiffness_n_mm2[0],
            "gj_shaft_n_mm2": self.twist_stiffness_n_mm2[-1],
            "friction": self.friction,
        }


@settings
class Wire(Device):
    """A guidewire.

    Attributes:
        tip_bend_rad: angle by which the unloaded tip is bent, rad.
        tip_bend_length_mm: length from the tip over which it is bent, with constant curvature, mm.
        tip_load_n: load at which the tip buckles, as in catalogues, N; None where the maker states none.
        tip_shaping: the bends that a hand can give its tip; None where the tip keeps the bend that it has.
    """

    tip_bend_rad: Annotated[float, Within(-2 * math.pi, 2 * math.pi)]
    tip_bend_length_mm: NonNegative
    tip_load_n: Positive | None
    tip_shaping: TipShaping | None = None

    @model_validator(mode="after")
    def _bend_has_a_length(self) -> Wire:
        if self.tip_bend_rad and not self.tip_bend_length_mm:
            raise ValueError(f"tip_bend: length_mm is {self.tip_bend_length_mm:g}; give a bent tip a positive length")
        return self

    def with_tip(self, *, bend_rad: float, stiffness_factor: float, shaft_stiffness_factor: float = 1.0) -> Wire:
        """Return the device with another tip.

        Args:
            bend_rad: angle by which the unloaded tip is bent, rad.
            stiffness_factor: EI and GJ of the distal `TIP_LENGTH_MM` are multiplied by it, and less and less so as far
                as the next abscissa of the profiles.
            shaft_stiffness_factor: EI and GJ from that abscissa on are multiplied by it.
        """
        at = np.asarray(self.abscissa_mm, dtype=float)
        factor = np.where(at <= TIP_LENGTH_MM, stiffness_factor, shaft_stiffness_factor)
        bend, twist = (
            factor * np.asarray(p, dtype=float) for p in (self.bend_stiffness_n_mm2, self.twist_stiffness_n_mm2)
        )
        return replace(
            self,
            tip_bend_rad=bend_rad,
            bend_stiffness_n_mm2=tuple(bend.tolist()),
            twist_stiffness_n_mm2=tuple(twist.tolist()),
        )

    def shaped(self, angle_deg: float, length_mm: float) -> Wire:
        """Return the device with its tip bent by an angle (degrees) over a length (mm)."""
        return replace(self, tip_bend_rad=math.radians(angle_deg), tip_bend_length_mm=float(length_mm))

    def summary(self) -> dict[str, Any]:
        """Return `Device.summary`, the catalogue's `tip_load_n` (None where it states none) and `tip_bend_deg`."""
        bend = {"tip_bend_deg": round(float(np.rad2deg(self.tip_bend_rad)), 3)}
        return Device.summary(self) | {"tip_load_n": self.tip_load_n} | bend


@settings
class Sourced(Generic[Value]):
    """A constant in a device's file, and where it comes from."""

    value: Value
    source: Text


@settings
class _TipBend:
    """The bend of the tip in a device's file, and where it comes from."""

    angle_deg: Annotated[float, Within(-360, 360)]
    length_mm: BendLength
    source: Text


@settings
class _Shaping(TipShaping):
    """The bends that a hand can give the tip, in a device's file, and where their limits come from."""

    angle_deg: Annotated[tuple[Angle, Angle], Ascending]
    length_mm: Annotated[tuple[ArcLength, ArcLength], Ascending]
    source: Text


@settings
class DeviceFile:
    """What a wire's and a catheter's file hold alike; `Device` says what each constant means."""

    name: Text
    diameter_mm: Sourced[Width]
    friction: Sourced[Friction]
    max_velocity_mm_s: Sourced[Velocity]
    max_rotation_rad_s: Sourced[Rotation]
    push_limit_n: Sourced[Force]
    pull_limit_n: Sourced[Force]
    torque_limit_n_mm: Sourced[Torque]
    abscissa_mm: Sourced[tuple[Abscissa, ...]]
    bend_stiffness_n_mm2: Sourced[tuple[Stiffness, ...]]
    twist_stiffness_n_mm2: Sourced[tuple[Stiffness, ...]]


@settings
class WireFile(DeviceFile):
    """What a wire's file holds; `Wire` says what each constant means."""

    tip_load_n: Sourced[TipLoad | None]
    tip_bend: _TipBend
    tip_shaping: _Shaping | None = None


def file_constants(content: DeviceFile, order: Sequence[str] = ()) -> dict[str, Any]:
    """Return name, constants and sources that a device's file holds, as the device takes them; in an order of its own,
    if one is given."""
    names = order or [field.name for field in fields(content) if field.name != "name"]
    entries = {name: getattr(content, name) for name in names}
    constants = {name: entry.value for name, entry in entries.items() if isinstance(entry, Sourced)}
    sources = {name: entry.source for name, entry in entries.items() if entry is not None}
    return {"name": content.name, **constants, "sources": sources}


@public
def read_wire(name_or_path: str | Path) -> Wire:
    """Read a wire by its name, or from a YAML file; InputError names file, field, value and mend."""
    path = device_file(name_or_path)
    content = read_settings(path, WireFile)
    shaping = content.tip_shaping
    try:
        device = Wire(
            **file_constants(content),
            tip_bend_rad=math.radians(content.tip_bend.angle_deg),
            tip_bend_length_mm=content.tip_bend.length_mm,
            tip_shaping=shaping and TipShaping(angle_deg=shaping.angle_deg, length_mm=shaping.length_mm),
        )
        check_built(device)
        check_tip(device)
        return device
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def check_built(
    device: Device, *, bore_mm: float = 0.0, arcs: Sequence[tuple[float, float]] = (), catheter: bool = False
) -> None:
    """Raise InputError where a file's constants cannot be one thing's; `bore_mm` is 0 for a wire."""
    _check_stiffness(device, bore_mm, catheter)
    shears = _STRENGTH_MPA / math.sqrt(3) * math.pi / 16 * device.diameter_mm**3  # yields in shear by von Mises
    if (torque := device.torque_limit_n_mm) > shears:
        raise InputError(
            f"torque_limit_n_mm: {torque:g} N·mm shears off {device.diameter_mm:g} mm of the strongest steel, at "
            f"{shears:.3g} N·mm; give N·mm at which the drive slips ({torque:g} mN·mm is {torque / 1000:g} N·mm)"
        )
    _check_bends("shape", [each for each in arcs if each[1]], device)


def check_tip(device: Wire) -> None:
    """Raise InputError where a wire's tip cannot be one: its load, its bend, and the bends that a hand can give it."""
    if device.tip_load_n is not None:
        _check_tip_load(device.tip_load_n, device)
    if device.tip_bend_rad:
        _check_bends("tip_bend", [(device.tip_bend_length_mm, device.tip_bend_rad)], device)
    shaping = device.tip_shaping
    if shaping is not None and 0 < shaping.angle_deg[1] <= _LEAST_DEG:
        high = shaping.angle_deg[1]
        raise InputError(f"tip_shaping.angle_deg: {high:g}; give degrees ({high:g} rad is {math.degrees(high):.4g}°)")


def _check_stiffness(device: Device, bore_mm: float, catheter: bool) -> None:
    end, bend, twist = device.abscissa_mm[-1], device.bend_stiffness_n_mm2, device.twist_stiffness_n_mm2
    if 0 < end < 1:
        raise InputError(f"abscissa_mm: ends at {end:g} mm; give the abscissae in mm ({end:g} m is {1000 * end:g} mm)")
    section = math.pi / 64 * (device.diameter_mm**4 - bore_mm**4)
    low, high = _CATHETER_RATIO if catheter else _WIRE_RATIO
    for place, (ei, gj) in enumerate(zip(bend, twist, strict=True)):
        modulus, which = ei / section, f"bend_stiffness_n_mm2.value[{place}]: {ei:g}"
        thick = f"with diameter_mm = {device.diameter_mm:g} takes a Young's modulus of"
        if modulus > _MODULUS_MPA[1]:
            raise InputError(
                f"{which} {thick} {modulus / 1000:.3g} GPa; "
                f"metals have at most {_MODULUS_MPA[1] / 1000:g}: give N·mm², and the diameter, not the radius, in mm"
            )
        if modulus < _MODULUS_MPA[0]:
            raise InputError(
                f"{which} {thick} {modulus:.2g} MPa; the softest devices have "
                f"{_MODULUS_MPA[0]:g}: give mm, and N·mm² ({ei:g} N·m² is {1e6 * ei:.4g} N·mm²)"
            )
        if not low <= gj / ei <= high:
            raise InputError(
                f"twist_stiffness_n_mm2.value[{place}]: {gj:g} is {gj / ei:.3g} times EI; give {low:g} to {high:g} "
                f"times (a round section has GJ = EI/(1 + ν), {ei / 1.3:.3g} for ν = 0.3)"
            )
        if ei > _STIFFENING * min(bend):
            raise InputError(
                f"{which} is more than {_STIFFENING:g} times the least, {min(bend):g}; correct one of them"
            )
        if ei * _FALL < max(bend[: place + 1]):
            raise InputError(
                f"{which}, and {max(bend[:place]):g} nearer to the tip; list the tip first, and let EI rise from it"
            )


def _check_tip_load(load_n: float, device: Device) -> None:
    middle = float(device.bend_stiffness(np.linspace(0, TIP_LENGTH_MM, 101)).mean())
    buckles = math.pi**2 * middle / (4 * TIP_LENGTH_MM**2)
    if not 1 / _LOAD_FACTOR <= load_n / buckles <= _LOAD_FACTOR:
        force = load_n * GRAM_FORCE_N
        meant = f" ({load_n:g} gf is {force:.3g} N)" if 1 / _LOAD_FACTOR <= force / buckles <= _LOAD_FACTOR else ""
        raise InputError(
            f"tip_load_n: {load_n:g}; a tip of this EI buckles at {buckles:.3g} N (π² EI/4L², L = {TIP_LENGTH_MM:g} mm)"
            f"; give N within a factor of {_LOAD_FACTOR:g} of it, or null{meant}"
        )


def _check_bends(name: str, bends: Sequence[tuple[float, float]], device: Device) -> None:
    """Check bends of the tip, or of a catheter: lengths in mm, angles in rad, none of them 0."""
    angles = [abs(math.degrees(angle)) for _, angle in bends]
    if bends and max(angles) <= _LEAST_DEG:
        angle = max(angles)
        raise InputError(
            f"{name}: bends by {angle:.4g}°; give degrees ({angle:.4g} rad is {math.degrees(angle):.4g}°), or 0"
        )
    for length, angle in bends:
        if length < abs(angle) * device.diameter_mm / 2:
            raise InputError(
                f"{name}: {math.degrees(angle):g}° over {length:g} mm has a radius of {length / abs(angle):.2g} mm, "
                f"less than the device's own; give lengths in mm ({length:g} m is {1000 * length:g} mm)"
            )


def check_fits(device: Device, anatomy: Anatomy) -> None:
    """Raise InputError where the device is wider than the guiding catheter or the ostium."""
    lumen = float(anatomy.tree.branches[0].centerline.radius[0])
    for what, radius in (("lumen at the ostium", lumen), ("guiding catheter", anatomy.catheter_radius_mm)):
        if device.tip_radius_mm >= radius:
            raise InputError(
                f"device {device.name}: diameter_mm = {device.diameter_mm:g} is wider than the {what} of "
                f"{anatomy.name}, {2 * radius:.2f} mm; choose a thinner device"
            )


def lateral_reach(bend_rad: float, length_mm: float) -> float:
    """Return how far a bent tip stands beside the wire, mm: L(1 − cos θ)/θ, with half a turn at most."""
    angle = abs(bend_rad)
    return float(length_mm * (1 - np.cos(min(angle, np.pi))) / angle) if angle > 0 else 0.0
