"""What an anatomy can be made from, read from files: a mask, a surface, or centerlines with radii."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError, place_text
from endopilot.types import LumenMask, VesselTree
from endopilot.vessels.surface import Surface
from endopilot.vessels.units import ANSWERED, STATED

RADIUS_NAMES = ("maximuminscribedsphereradius", "misr", "radius", "radii")
"""Names of the point array or measurement that holds radii, in lower case: VMTK's, Slicer's, and plain ones."""

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Polylines:
    """Centerlines as a file holds them: any number of lines, in any order and direction, possibly overlapping.

    Attributes:
        points: positions of each line, mm.
        radius: inscribed-sphere radii of each line, mm.
        names: what messages call each line; its number if none are given.
    """

    points: tuple[Float[np.ndarray, "_ 3"], ...]
    radius: tuple[Float[np.ndarray, "_"], ...]
    names: tuple[str, ...] = ()

    def name(self, number: int) -> str:
        """Return what messages call a line."""
        return f"line {self.names[number]!r}" if self.names else f"line {number}"


@dataclass(frozen=True, eq=False)
class AnatomySource:
    """The content of a file, and which file it was.

    Attributes:
        content: mask, surface (as read, perhaps open) or centerlines; in LPS where the file states its axes.
        file: name of the file, without its folder.
        sha256: its SHA-256.
        coordinates: axes that the file states, "lps" or "ras"; None where it states none.
        factor: mm in the unit that the file was taken to be in; `content` is in mm already.
        odds: how much likelier that unit is than any other (`units.ASSUMED` and so on).
        notes: what the reader did or left out, a sentence each.
    """

    content: LumenMask | Surface | Polylines | VesselTree
    file: str = ""
    sha256: str = ""
    coordinates: str | None = None
    factor: float = 1.0
    odds: float = STATED
    notes: tuple[str, ...] = ()


def transformed(source: AnatomySource, *, scale: float | None, coordinates: str | None) -> AnatomySource:
    """Return a source in LPS mm, with a note where nothing states the axes.

    Args:
        source: as read.
        scale: factor that turns its unit into mm, if the user states it.
        coordinates: "lps" or "ras" where the user states the axes, otherwise None.

    Raises:
        InputError: the user states other axes or another unit than the file.
    """
    label, notes = source.file or "the source", source.notes
    if coordinates is not None and source.coordinates is not None and coordinates != source.coordinates:
        stated = (
            "is a mask, which is read in LPS whatever its own axes"
            if isinstance(source.content, LumenMask)
            else (f"states {source.coordinates.upper()}")
        )
        raise InputError(f"{label}: --coordinates {coordinates} was given, but the file {stated}; leave the option out")
    factor, odds = source.factor, source.odds
    if scale is not None and factor != 1.0 and odds == STATED and scale not in (1.0, factor):
        raise InputError(
            f"{label}: --scale {scale:g} was given, but the file states a unit of {factor:g} mm; leave the option out"
        )
    if scale is not None and (factor == 1.0 or odds != STATED):
        factor, odds = scale, ANSWERED
    if source.coordinates is None and coordinates is None and source.file:
        notes = (*notes, "axes not stated: taken for LPS (--coordinates ras if they are RAS)")
    turned = coordinates == "ras" and source.coordinates is None
    content = in_mm(source.content, factor / source.factor, RAS_TO_LPS if turned else np.ones(3))
    return replace(source, content=content, factor=factor, odds=odds, notes=notes)


def in_mm(content: Any, factor: float, turn: Float[np.ndarray, "3"]) -> Any:
    """Return what a source holds with positions and radii multiplied by `factor`, and axes turned over by signs."""
    if isinstance(content, Surface):
        return Surface(content.vertices * turn * factor, content.faces)
    if isinstance(content, Polylines):
        points = tuple(points * turn * factor for points in content.points)
        return replace(content, points=points, radius=tuple(radius * factor for radius in content.radius))
    if isinstance(content, LumenMask) and factor != 1.0:
        volume, ostium = content.volume, content.ostium
        return replace(
            content,
            volume=replace(volume, spacing_mm=volume.spacing_mm * factor, origin_mm=volume.origin_mm * factor),
            ostium=None if ostium is None else replace(ostium, position=ostium.position * factor),
        )
    return content


def checked_lines(lines: Polylines, path: Path, notes: list[str]) -> Polylines:
    """Return centerlines whose positions are finite and whose radii are positive.

    Where the radius is no number or zero only at the end of a line, it becomes that of the point before, with a note.

    Raises:
        InputError: there is no line, or a position or radius is none.
    """
    if not lines.points:
        raise InputError(f"{path}: holds no line of at least two points; export the centerline again")
    if all((radius == 0).all() for radius in lines.radius):
        raise InputError(f"{path}: all radii are zero; write inscribed-sphere radii in mm")
    radii = []
    for number, (points, radius) in enumerate(zip(lines.points, lines.radius, strict=True)):
        if not np.isfinite(points).all():
            raise InputError(f"{path}: {lines.name(number)}: some positions are not finite numbers; export it again")
        good = np.flatnonzero(np.isfinite(radius) & (radius > 0))
        bad = np.setdiff1d(np.arange(len(radius)), good)
        if len(bad):
            odd = bad[(radius[bad] < 0) | ((bad > good[0]) & (bad < good[-1]))] if len(good) else bad
            if len(odd):
                raise InputError(
                    f"{path}: {lines.name(number)}: the radius at {place_text(points[odd[0]])} is {radius[odd[0]]:g} "
                    f"({len(odd)} such points); write inscribed-sphere radii, which are positive"
                )
            notes.append(
                f"{lines.name(number)}: the radius of {len(bad)} points at its end, from {place_text(points[bad[0]])}, "
                "is no positive number: that of the point before is taken"
            )
            radius = radius[good[np.abs(good - np.arange(len(radius))[:, None]).argmin(axis=1)]]
        radii.append(radius)
    return replace(lines, radius=tuple(radii))
