"""Telescoping devices on one shared centreline: a wire, and the catheters around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.catheter import Catheter, check_nested, read_catheter
from endopilot.devices.device import Device, Wire, check_fits, read_wire
from endopilot.errors import InputError
from endopilot.lines import length_along, places_on
from endopilot.settings import Within, settings
from endopilot.types import Anatomy


@settings
class Transmission:
    """How a drive's rotation reaches the ostium: the device between, of `length_mm` (0: none), twists under a Coulomb
    friction torque a length, N·mm/mm.

    docs/concepts/transmission.md derives it: of a uniform device with stiffness GJ, free at the ostium, the rotation
    lags by m L²/2GJ while it turns, and starts after a reversal when the drive has turned by twice that.
    """

    length_mm: Annotated[float, Within(0, 3000, unit="mm", mistaken=(("m", 1000.0),))] = 0.0
    twist_friction_n_mm_mm: Annotated[float, Within(0, 1)] = 0.0


SHOWN_BEHIND_MM = 20.0  # length of devices that pictures show behind the ostium, in the guiding catheter, mm
_APART_MM = 1e-6  # nodes nearer to a tip than this are the tip, mm
Proximals = tuple[tuple[float, float], ...]  # of each device's proximal end a length and an angle, or rates


@dataclass(frozen=True)
class Stack:
    """A wire, and the catheters around it from the inside out; a wire alone is a stack of one. `transmissions` are what
    lies between drive and ostium, of each device; drives act at the ostium if not given."""

    wire: Wire
    catheters: tuple[Catheter, ...] = ()
    transmissions: tuple[Transmission, ...] = ()

    def __post_init__(self) -> None:
        """Check that there are as many transmissions as devices, and give drives at the ostium that of no length."""
        given = len(self.transmissions)
        if given not in (0, len(self)):
            raise InputError(f"transmissions: {given} for {len(self)} devices; give one for each device, or none")
        if not given:
            object.__setattr__(self, "transmissions", (Transmission(),) * len(self))

    @staticmethod
    def of(device: Wire | Stack | str | Path, *catheters: Catheter | str | Path) -> Stack:
        """Return the stack of a wire, or a stack, and catheters around it from the inside out, whose drives act at the
        ostium; each is given itself, by its name or by its YAML file. Raises InputError for no such device."""
        around = tuple(each if isinstance(each, Catheter) else read_catheter(each) for each in catheters)
        if not isinstance(device, Stack):
            return Stack(device if isinstance(device, Wire) else read_wire(device), around)
        further = tuple(Transmission() for _ in around)
        return replace(device, catheters=device.catheters + around, transmissions=device.transmissions + further)

    def __len__(self) -> int:
        """Return the number of devices."""
        return 1 + len(self.catheters)

    @property
    def devices(self) -> tuple[Device, ...]:
        """The wire, then the catheters around it."""
        return (self.wire, *self.catheters)

    @property
    def name(self) -> str:
        """The names of its devices, such as "workhorse-014 in microcatheter-1.7f"."""
        return " in ".join(device.name for device in self.devices)

    @property
    def outer_radius_mm(self) -> float:
        """Radius of the widest device, mm."""
        return max(device.tip_radius_mm for device in self.devices)

    @property
    def push_limit_n(self) -> float:
        """What all drives together can push with, N: it sizes the wall's stiffness."""
        return sum(device.push_limit_n for device in self.devices)

    @property
    def limits(self) -> Float[np.ndarray, "devices 3"]:
        """Where the drive of each device slips: push (N), pull (N) and torque (N·mm)."""
        return np.array([[each.push_limit_n, each.pull_limit_n, each.torque_limit_n_mm] for each in self.devices])

    @property
    def fastest(self) -> Float[np.ndarray, "devices 2"]:
        """Fastest translation (mm/s) and rotation (rad/s) of each drive."""
        return np.array([[each.max_velocity_mm_s, each.max_rotation_rad_s] for each in self.devices])

    def frictions(self, of_wire: Float[np.ndarray, "worlds"]) -> Float[np.ndarray, "worlds devices"]:
        """Return the Coulomb coefficients of the devices on the wall: the wire's as given, the catheters' own."""
        around = [np.full(len(of_wire), catheter.friction) for catheter in self.catheters]
        return np.column_stack([of_wire, *around])

    @property
    def constants(self) -> tuple[Any, ...]:
        """All numbers of the devices: stacks with the same constants behave the same."""
        behind = tuple((each.length_mm, each.twist_friction_n_mm_mm) for each in self.transmissions)
        return self.wire.constants + tuple(each.constants for each in self.catheters) + behind

    def check(self, anatomy: Anatomy) -> None:
        """Raise InputError unless the devices fit into each other, and into an anatomy."""
        check_nested(self.wire, self.catheters)
        for device in self.devices:
            check_fits(device, anatomy)


def column_prefixes(devices: int) -> tuple[str, ...]:
    """Return what names of a table's columns begin with, by device: nothing for the wire, then `catheter_1_`, ..."""
    return ("", *(f"catheter_{k}_" for k in range(1, devices)))


def lines_from_tips(
    nodes: Float[np.ndarray, "n 3"], inserted_length_mm: Float[np.ndarray, "devices"]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the line that telescoping devices share (nodes, LPS mm) as each has it, from its own tip on."""
    behind = inserted_length_mm.max() - inserted_length_mm
    along = length_along(nodes)
    return [
        nodes if at == 0 else np.vstack([places_on(nodes, along, np.array([at])), nodes[along > at + _APART_MM]])
        for at in behind.tolist()
    ]


def shown_part(
    nodes: Float[np.ndarray, "n 3"], deepest_mm: float, behind_mm: float = SHOWN_BEHIND_MM
) -> Float[np.ndarray, "shown 3"]:
    """Return what pictures show of a line, from its tip to `behind_mm` behind the ostium; NaN beyond its end."""
    nodes = nodes[np.isfinite(nodes).all(axis=1)]
    return nodes[length_along(nodes) <= deepest_mm + behind_mm]
