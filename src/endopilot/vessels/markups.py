"""Centerlines from 3D Slicer's markups (`.mrk.json`): curves with a radius at each control point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot import files
from endopilot.errors import InputError
from endopilot.vessels.sources import RADIUS_NAMES, RAS_TO_LPS, AnatomySource, Polylines, checked_lines
from endopilot.vessels.units import mm_per_unit

_AXES = {"LPS": "lps", "RAS": "ras", "0": "ras", "1": "lps"}
"""Axes by their names and by the numbers of Slicer's older files."""

_NO_CENTERLINE = {
    "fiducial": "its points are in no order; convert it to a curve in Slicer's Markups module",
    "closedcurve": "a closed curve has no end to enter; save it as an open curve (type Curve)",
}


def read_markups(path: Path) -> AnatomySource:
    """Read the curves of a markups file, in LPS mm; other markups beside them are left out with a note.

    Raises:
        InputError: the file holds no open curve, or a curve has other axes than LPS and RAS, an unknown unit, no
            radii, or a position that is none.
    """
    content = files.read_json(path)
    markups = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(markups, list) or not markups or not all(isinstance(markup, dict) for markup in markups):
        raise InputError(f"{path}: holds no Slicer markups; export the centerline curve as .mrk.json")
    points, radii, axes, factors, notes = [], [], set(), set(), []
    refused = []
    for number, markup in enumerate(markups):
        name = str(markup.get("label") or markup.get("name") or number)
        kind, control = markup.get("type"), markup.get("controlPoints")
        control = control if isinstance(control, list) else []
        reason = _no_centerline(kind, control)
        if reason is not None:
            refused.append(f"{kind or 'curve'} {name!r} is no centerline: {reason}")
            continue
        stated, factor = _axes(markup, name, path), _factor(markup.get("coordinateUnits"), name, path)
        line, given = _positions(control, name, path)
        radius = _radii(markup, given, factor, name, path)
        if not given.all():
            notes.append(f"curve {name!r}: {int((~given).sum())} control points without a position are left out")
        if kind is None:
            notes.append(f"markup {name!r} states no type: taken for a curve")
        if stated is None:
            notes.append(f"curve {name!r}: axes not stated: taken for LPS, the default of the format")
        if factor != 1.0:
            notes.append(f"curve {name!r} states {_first(markup['coordinateUnits'])}: multiplied by {factor:g}")
        points.append(line * (RAS_TO_LPS if stated == "ras" else 1.0) * factor)
        radii.append(radius)
        axes.add(stated or "lps")
        factors.add(factor)
    if not points:
        raise InputError(f"{path}: {refused[0]}")
    notes += [f"{reason.split(':')[0]}, and is left out" for reason in refused]
    factor = factors.pop() if len(factors) == 1 else 1.0
    lines = checked_lines(Polylines(tuple(points), tuple(radii)), path, notes)
    return AnatomySource(lines, coordinates=" and ".join(sorted(axes)), factor=factor, notes=tuple(notes))


def _no_centerline(kind: Any, control: list[Any]) -> str | None:
    """Return why a markup is no centerline, or None if it is one."""
    lower = str(kind or "Curve").lower()
    if lower not in ("curve", "line"):
        return _NO_CENTERLINE.get(lower, "only open curves and lines are (type Curve or Line)")
    if len(control) < 2:
        return f"it has {len(control)} control points; draw it through two or more"
    return None


def _axes(markup: dict[str, Any], name: str, path: Path) -> str | None:
    stated = markup.get("coordinateSystem")
    if stated is None:
        return None
    axes = _AXES.get(str(stated).upper())
    if axes is None:
        raise InputError(
            f"{path}: curve {name!r}: coordinateSystem is {stated!r}, from which no place in the patient follows; "
            "save it in LPS or RAS"
        )
    return axes


def _factor(unit: Any, name: str, path: Path) -> float:
    factor = 1.0 if unit is None else mm_per_unit(_first(unit))
    if factor is None:
        raise InputError(f"{path}: curve {name!r}: unit {unit!r} is no known length; save it in mm")
    return factor


def _first(unit: Any) -> Any:
    """Return a unit's own name: newer files write it as a list of name, system and meaning."""
    return unit[0] if isinstance(unit, list) and unit else unit


def _positions(control: list[Any], name: str, path: Path) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    try:
        given = np.array([point.get("positionStatus", "defined") == "defined" for point in control])
        line = [[float(value) for value in control[i]["position"]] for i in np.flatnonzero(given)]
        places = np.array(line, dtype=float)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: curve {name!r}: a control point has no numeric position; export the curve again"
        ) from error
    if places.ndim != 2 or places.shape[1] != 3 or len(places) < 2:
        raise InputError(
            f"{path}: curve {name!r}: positions have the shape {places.shape}, not two or more of three numbers; "
            "export the curve again"
        )
    return places, given


def _radii(markup: dict[str, Any], given: np.ndarray, factor: float, name: str, path: Path) -> np.ndarray:
    found = markup.get("measurements")
    found = [m for m in found if isinstance(m, dict)] if isinstance(found, list) else []
    measurements = {str(m.get("name", "")).lower(): m for m in found if m.get("controlPointValues")}
    chosen = next((measurements[wanted] for wanted in RADIUS_NAMES if wanted in measurements), None)
    if chosen is None:
        held = ", ".join(str(m.get("name")) for m in found) or "no measurements at all"
        raise InputError(
            f"{path}: curve {name!r} has no radius measurement for its {len(given)} control points (it holds {held}); "
            "export it from Slicer's Extract Centerline module"
        )
    try:
        values = np.array([float(value) for value in chosen["controlPointValues"]])
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: curve {name!r}: a radius is no number; export the curve again") from error
    if len(values) == len(given):
        values = values[given]
    elif len(values) != given.sum():
        raise InputError(
            f"{path}: curve {name!r} has {len(values)} radii for {len(given)} control points; export it again from "
            "Slicer's Extract Centerline module"
        )
    unit = chosen.get("units")
    return values * (factor if unit in (None, "") else _factor(unit, name, path))
