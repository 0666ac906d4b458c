"""Devices as data: stiffness profiles, diameter, tip shape and friction, read from YAML and checked.

In a device's file every constant stands with its source, as `{value: ..., source: ...}`; a file without a source for
each constant is refused. A profile is piecewise linear between its abscissae, which count from the tip, and constant
beyond the last one.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device_files import device_file
from endopilot.devices.device_ranges import (
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
    check_built,
    check_tip,
)
from endopilot.errors import InputError
from endopilot.settings import NonNegative, Positive, Text, Within, public, read_settings, settings
from endopilot.types import Anatomy

Value = TypeVar("Value")


@settings
class TipShaping:
    """The bends that a hand can give the tip of a wire.

    Attributes:
        angle_deg: least and largest angle, degrees.
        length_mm: least and largest length from the tip over which it is bent, mm.
    """

    angle_deg: tuple[NonNegative, NonNegative]
    length_mm: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _consistent(self) -> TipShaping:
        for name in ("angle_deg", "length_mm"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: [{low:g}, {high:g}]; give the least first")
        return self

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

    angle_deg: tuple[Angle, Angle]
    length_mm: tuple[ArcLength, ArcLength]
    source: Text


@settings
class WireFile:
    """What a device's file holds; `Wire` says what each constant means."""

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
    tip_load_n: Sourced[TipLoad | None]
    tip_bend: _TipBend
    tip_shaping: _Shaping | None = None


@public
def read_wire(name_or_path: str | Path) -> Wire:
    """Read a device by its name (`endopilot.devices.device_files`), or from a YAML file.

    Raises:
        InputError: no such device, or a file that is not a device; the line names file, field, value and mend.
    """
    path = device_file(name_or_path)
    content = read_settings(path, WireFile)
    entries = {field.name: getattr(content, field.name) for field in fields(content) if field.name != "name"}
    entries = {name: entry for name, entry in entries.items() if entry is not None}
    shaping = content.tip_shaping
    constants = {name: entry.value for name, entry in entries.items() if isinstance(entry, Sourced)}
    try:
        device = Wire(
            name=content.name,
            **constants,
            tip_bend_rad=math.radians(content.tip_bend.angle_deg),
            tip_bend_length_mm=content.tip_bend.length_mm,
            sources={name: entry.source for name, entry in entries.items()},
            tip_shaping=shaping and TipShaping(angle_deg=shaping.angle_deg, length_mm=shaping.length_mm),
        )
        check_built(device)
        check_tip(device)
        return device
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


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


def lateral_reach(bend_rad: float, length_mm: float) -> float:
    """Return how far a tip stands beside the wire behind it, mm: L(1 − cos θ)/θ.

    A tip that is bent by more than half a turn stands farthest beside the wire where it has turned by half of one.

    Args:
        bend_rad: angle by which it is bent, rad.
        length_mm: length over which it is bent, with constant curvature, mm.
    """
    angle = abs(bend_rad)
    return float(length_mm * (1 - np.cos(min(angle, np.pi))) / angle) if angle > 0 else 0.0
