"""Files in another unit than mm: as they state it, or as the size of the vessels in them tells."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError

SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM = 0.25, 40.0
"""Vessels that a guidewire enters have mean radii between these."""

CORONARY_EXTENT_MM = (20.0, 500.0)
"""A coronary tree, even a vestige, reaches from corner to corner of a box with a diagonal between these."""

LARGEST_EXTENT_MM = 2500.0
"""No vessel of the body reaches farther."""

_USUAL_CORONARY = ((0.6, 3.5), (40.0, 300.0))
"""Mean radius and extent of whole coronary trees, mm: narrower than what is accepted, to tell units apart."""

_UNITS = ((10.0, "cm"), (25.4, "inches"), (100.0, "dm"), (1000.0, "m"), (0.1, "tenths of mm"), (0.001, "µm"))

_NAMES = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("dm", "decimeter", "decimeters", "decimetre", "decimetres"), 100.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre"), 0.001),
    **dict.fromkeys(("in", "inch", "inches", "[in_i]"), 25.4),
}
"""mm in each unit of length, by its names; `[in_i]` is the inch of UCUM, which Slicer writes."""


def mm_per_unit(name: object) -> float | None:
    """Return how many mm a unit of length has, or None where the name is of none.

    Args:
        name: such as "mm" or "inches", in upper or lower case.
    """
    return _NAMES.get(str(name).strip().lower())


def check_unit(
    points: Float[np.ndarray, "n 3"], radius_mm: float | None, vessel: Literal["rca", "lca", "generic"], label: str
) -> None:
    """Refuse a vessel that has another size than vessels have.

    Args:
        points: places on the vessel or its wall, or the corners of its box.
        radius_mm: mean radius, if it is known.
        vessel: which vessel it is to be.
        label: name of the source, for the message.

    Raises:
        InputError: the size is no vessel's; the message names the `--scale` that mends it, or all that do.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if _plausible(radius_mm, extent, vessel):
        return
    size = f"extends over {extent:.3g} mm" + (f" with a mean radius of {radius_mm:.3g} mm" if radius_mm else "")
    fits = [unit for unit in _UNITS if _plausible(radius_mm and unit[0] * radius_mm, unit[0] * extent, vessel)]
    if vessel != "generic":
        usual = [unit for unit in fits if _usual(radius_mm and unit[0] * radius_mm, unit[0] * extent)]
        fits = usual or fits
    if not fits:
        raise InputError(
            f"{label}: {size}, as no vessel does; check the label and the units of positions and radii (--scale)"
        )
    units = " or ".join(unit for _, unit in fits)
    raise InputError(
        f"{label}: {size}, as no vessel does; the file seems to be in {units}: "
        f"use --scale {' or --scale '.join(f'{factor:g}' for factor, _ in fits)}"
    )


def _plausible(radius_mm: float | None, extent_mm: float, vessel: str) -> bool:
    wide = radius_mm is None or SMALLEST_RADIUS_MM <= radius_mm <= LARGEST_RADIUS_MM
    if vessel == "generic":
        # A vessel is longer than it is wide; where no radius is known yet, any width may follow.
        return wide and (radius_mm or SMALLEST_RADIUS_MM) <= extent_mm <= LARGEST_EXTENT_MM
    return wide and CORONARY_EXTENT_MM[0] <= extent_mm <= CORONARY_EXTENT_MM[1]


def _usual(radius_mm: float | None, extent_mm: float) -> bool:
    (thin, wide), (short, long) = _USUAL_CORONARY
    return (radius_mm is None or thin <= radius_mm <= wide) and short <= extent_mm <= long
