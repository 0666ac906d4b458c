"""What the numbers of a device's file can be: ranges by field, and how they must agree with each other.

docs/concepts/devices.md says where each range comes from. They hold every wire from 0.006 to 0.038 inch, catheters and
sheaths up to 24 French, and the soft rods of published benchmarks; what lies outside was most likely given in another
unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np

from endopilot.errors import InputError
from endopilot.settings import Within

if TYPE_CHECKING:
    from endopilot.devices.device import Device, Wire

GRAM_FORCE_N = 9.80665e-3
"""One gram-force in N, by the standard acceleration of gravity; catalogues give tip loads in it."""
TIP_LENGTH_MM = 10.0
"""Length of the floppy tip, mm: the buckling length of catalogues' tip loads, and the distal coil of coronary wires."""
MOST_VALUES = 1000
"""Values that a profile or a shape may have."""
_LENGTHS = (("m", 1000.0), ("inch", 25.4), ("cm", 10.0), ("µm", 0.001))
_FORCES = (("gf", GRAM_FORCE_N), ("mN", 0.001), ("kgf", 1000 * GRAM_FORCE_N))

Width = Annotated[
    float,
    Within(0.15, 10, unit="mm", mistaken=(("inch", 25.4), ("m", 1000.0), ("French", 1 / 3), ("µm", 0.001))),
]
"""An outer or an inner diameter, mm."""
Abscissa = Annotated[float, Within(0, 5000, unit="mm", mistaken=(("µm", 0.001),))]
"""A distance from the tip, mm."""
Stiffness = Annotated[float, Within(1e-4, 1e6, unit="N·mm²", mistaken=(("N·m²", 1e6),))]
"""EI or GJ, N·mm²."""
BendLength = Annotated[float, Within(0, 200, unit="mm", mistaken=(("µm", 0.001),))]
"""Length of a bend of the tip, mm; 0 for a straight one."""
ArcLength = Annotated[float, Within(0.1, 500, unit="mm", mistaken=_LENGTHS)]
"""Length of an arc of a catheter's shape, or that a hand can bend a tip over, mm."""
Angle = Annotated[float, Within(0, 360, unit="°")]
"""Angle that a hand can bend a tip by, °."""
TipLoad = Annotated[float, Within(3e-4, 0.6, unit="N", mistaken=_FORCES)]
"""Load at which the tip buckles, N."""
Friction = Annotated[float, Within(0, 2, mistaken=(("%", 0.01),))]
"""A Coulomb coefficient."""
Velocity = Annotated[
    float, Within(0.1, 500, unit="mm/s", mistaken=(("m/s", 1000.0), ("cm/s", 10.0), ("mm/min", 1 / 60)))
]
"""Fastest translation of a drive, mm/s."""
Rotation = Annotated[float, Within(0.05, 65, unit="rad/s", mistaken=(("°/s", math.pi / 180), ("rpm", math.pi / 30)))]
"""Fastest rotation of a drive, rad/s."""
Force = Annotated[float, Within(0.01, 50, unit="N", mistaken=_FORCES)]
"""Force at which a drive slips, N."""
Torque = Annotated[
    float, Within(1e-3, 1000, unit="N·mm", mistaken=(("N·m", 1000.0), ("mN·mm", 0.001), ("gf·mm", GRAM_FORCE_N)))
]
"""Torque at which a drive slips, N·mm."""

_MODULUS_MPA = (0.1, 250e3)
"""Young's modulus that EI and the section may imply, MPa: from a tenth of the softest published rod's, 1 MPa, to just
above that of cobalt alloys, 233 GPa; steel has 200 GPa."""
_WIRE_RATIO = (0.63, 1.05)
"""GJ/EI of a wire: 1/(1 + ν) of a round section, ν from 0 to 0.5, and 5 % for rounding."""
_CATHETER_RATIO = (0.63, 3.0)
"""The same of a catheter, whose braid may raise GJ."""
_FALL = 3.0
"""Factor by which EI may fall from the tip on; devices stiffen towards the shaft."""
_STIFFENING = 1e5
"""Largest ratio of EI along a device."""
_LOAD_FACTOR = 10.0
"""Factor between a catalogue's tip load and that of the tip's EI: protocols differ, and 1 gf is 1/102 N."""
_STRENGTH_MPA = 3000.0
"""Tensile strength of the strongest steel wire, MPa: EN 10270-1 has up to 3000 for patented wire of 0.3 mm."""
_LEAST_DEG = math.degrees(math.pi) / 57
"""A bend up to this, some 3.16 °, is one in rad: half a turn has π of them."""


def check_built(
    device: Device, *, bore_mm: float = 0.0, arcs: Sequence[tuple[float, float]] = (), catheter: bool = False
) -> None:
    """Check that the constants of a device can be those of one and the same thing.

    Args:
        device: what its file says.
        bore_mm: diameter of its bore, mm; 0 for a wire.
        arcs: the arcs of a catheter's shape: mm, rad.
        catheter: whether it is a catheter.

    Raises:
        InputError: two of them contradict each other; the line names field, value and what to give.
    """
    _check_stiffness(device, bore_mm, catheter)
    shears = _STRENGTH_MPA / math.sqrt(3) * math.pi / 16 * device.diameter_mm**3  # yields in shear by von Mises
    if (torque := device.torque_limit_n_mm) > shears:
        raise InputError(
            f"torque_limit_n_mm: {torque:g} N·mm shears off {device.diameter_mm:g} mm of the strongest steel, at "
            f"{shears:.3g} N·mm; give N·mm at which the drive slips ({torque:g} mN·mm is {torque / 1000:g} N·mm)"
        )
    _check_bends("shape", [each for each in arcs if each[1]], device)


def check_tip(device: Wire) -> None:
    """Check that the tip of a wire can be one: its load, its bend, and the bends that a hand can give it.

    Args:
        device: what its file says.

    Raises:
        InputError: it cannot; the line names field, value and what to give.
    """
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
