"""Files in another unit than mm, told by the size of the vessels in them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError

SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM = 0.25, 40.0
"""Vessels that a guidewire enters have mean radii between these."""

CORONARY_EXTENT_MM = (20.0, 500.0)
"""A coronary tree, even a vestige, reaches from corner to corner of a box with a diagonal between these."""

_UNITS = ((10.0, "cm"), (1000.0, "m"), (25.4, "inches"), (0.1, "tenths of mm"), (0.001, "µm"))


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
        InputError: the size is no vessel's; the message names the `--scale` that mends it, if one does.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if _plausible(radius_mm, extent, vessel):
        return
    size = f"extends over {extent:.3g} mm" + (f" with a mean radius of {radius_mm:.3g} mm" if radius_mm else "")
    for factor, unit in _UNITS:
        if _plausible(radius_mm and factor * radius_mm, factor * extent, vessel):
            raise InputError(
                f"{label}: {size}, as no vessel does; the file seems to be in {unit}: use --scale {factor:g}"
            )
    raise InputError(
        f"{label}: {size}, as no vessel does; check the label and the units of positions and radii (--scale)"
    )


def _plausible(radius_mm: float | None, extent_mm: float, vessel: str) -> bool:
    wide = radius_mm is None or SMALLEST_RADIUS_MM <= radius_mm <= LARGEST_RADIUS_MM
    return wide and (vessel == "generic" or CORONARY_EXTENT_MM[0] <= extent_mm <= CORONARY_EXTENT_MM[1])
