"""Files in another unit than mm: as they state it, or as the size of the vessels in them tells."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.imaging.geometry import MM_PER_UNIT

SMALLEST_RADIUS_MM = 0.25
"""Vessels that a guidewire enters have mean radii from this on."""

LARGEST_EXTENT_MM = 2500.0
"""No vessel of the body reaches farther."""

_KINDS = {
    "coronary": (1.2, 0.35, 120.0),
    "cerebral": (1.5, 0.35, 120.0),
    "neck, organ or arm": (3.0, 0.4, 180.0),
    "leg": (3.0, 0.35, 600.0),
    "thoracic aorta": (12.0, 0.25, 250.0),
    "whole aorta": (9.0, 0.25, 450.0),
    "aorta with head or legs": (4.0, 0.4, 550.0),
}
"""Mean radius, SD of its logarithm, and extent of the body's trees, mm: medians of the atlas, which draws them from
published statistics (rca 1.2 and 123, lca 1.0 and 147, cerebral 1.5 and 140, portal 3.3 and 177, arch 8 and 304), and
of public patients. Calibres of small vessels spread more: some files hold their thinnest branches, others do not."""

_LONGER_SD, _SHORTER_SD = 0.3, 0.9
"""Spread of ln(extent) about a kind's own; a file may hold a piece of the vessel, so that shorter costs less."""

_UNITS = {"mm": 1.0, "cm": 10.0, "inches": 25.4, "dm": 100.0, "m": 1000.0, "tenths of mm": 0.1, "µm": 0.001}
_RARE = {"tenths of mm": 0.02, "µm": 0.02}
"""How likely a unit is against cm, before the sizes are looked at."""

ASSUMED, BY_ARRAYS, STATED, ANSWERED = 4.0, 100.0, 1e4, 1e6
"""How much likelier a file's unit is what it was taken for than any other: by default, since arrays of a program that
has a usual unit are in it, since the file states the unit, and since the user did."""

_CERTAIN, _FITS = 0.9, 0.05
"""A unit less probable than the first is asked for; the message names what has this share of the best one's chances."""

_NONE = 1e-6
"""Likelihood of sizes that are no vessel's; those of a kind's medians have 1."""

_NAMES = {**MM_PER_UNIT, "[in_i]": 25.4}
"""mm in each unit of length, by its names; `[in_i]` is the inch of UCUM, which Slicer writes."""


def mm_per_unit(name: object) -> float | None:
    """Return how many mm a unit of length has, or None where the name is of none.

    Args:
        name: such as "mm" or "inches", in upper or lower case.
    """
    return _NAMES.get(str(name).strip().lower())


def unit_name(factor: float) -> str:
    """Return what a unit of so many mm is called."""
    return next((name for name, one in _UNITS.items() if one == factor), f"units of {factor:g} mm")


def check_unit(
    points: Float[np.ndarray, "n 3"],
    radius_mm: float | None,
    vessel: Literal["rca", "lca", "generic"],
    label: str,
    *,
    factor: float = 1.0,
    odds: float = STATED,
) -> None:
    """Refuse a vessel that has another size than vessels have, and ask where its size fits in several units.

    Radius and extent together tell the unit: no tree of the body is as long as a coronary artery's in mm and as wide as
    an aorta's in cm. Each unit is weighed by how usual it makes the two, against the nearest kind of vessel.

    Args:
        points: places on the vessel or its wall, or the corners of its box, in mm as taken.
        radius_mm: mean radius, if it is known.
        vessel: which vessel it is to be.
        label: name of the source, for the message.
        factor: mm in the unit that the file was taken to be in.
        odds: how much likelier that unit is than another: `ASSUMED`, `BY_ARRAYS`, `STATED` or `ANSWERED`.

    Raises:
        InputError: the size is no vessel's, or one in several units; the message names each size and its `--scale`.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    units = {factor: unit_name(factor)} | {one: name for name, one in _UNITS.items()}
    chance = {
        one: _usual(radius_mm and radius_mm * one / factor, extent * one / factor, vessel)
        * (odds if one == factor else _RARE.get(name, 1.0))
        for one, name in units.items()
    }
    certain = chance[factor] / (sum(chance.values()) + _NONE)
    best = max(chance.values())
    if certain >= _CERTAIN or (radius_mm is None and chance[factor] >= _FITS * best > 0.0):
        return
    fits = [one for one in units if chance[one] >= max(_FITS * best, _NONE)]
    if factor in fits and len(fits) > 1:
        sizes = (f"{_size(radius_mm, extent, one / factor)} in {units[one]} (--scale {one:g})" for one in fits)
        raise InputError(f"{label}: states no unit: its vessel {', or '.join(sizes)}; say which, with --scale")
    text = f"{label}: {_size(radius_mm, extent, 1.0)}, as no vessel does; "
    if not fits or factor in fits:
        raise InputError(text + "check the label and the units of positions and radii (--scale)")
    named, scales = " or ".join(units[one] for one in fits), " or --scale ".join(f"{one:g}" for one in fits)
    raise InputError(f"{text}the file seems to be in {named}: use --scale {scales}")


def _size(radius_mm: float | None, extent_mm: float, factor: float) -> str:
    return f"extends over {factor * extent_mm:.3g} mm" + (
        f" with a mean radius of {factor * radius_mm:.3g} mm" if radius_mm else ""
    )


def _usual(radius_mm: float | None, extent_mm: float, vessel: str) -> float:
    """Return how usual a vessel's size is: 1 at the medians of a kind, less by two normal laws of its logarithms."""
    if not (radius_mm or 0.0) <= extent_mm <= LARGEST_EXTENT_MM or extent_mm == 0.0:
        return 0.0
    radius, spread, extent = np.array(list(_KINDS.values()) if vessel == "generic" else [_KINDS["coronary"]]).T
    wide = np.log((radius_mm or radius) / radius) / spread
    length = np.log(extent_mm / extent)
    length /= np.where(length > 0, _LONGER_SD, _SHORTER_SD)
    return float(np.exp(-0.5 * (wide**2 + length**2)).max())
