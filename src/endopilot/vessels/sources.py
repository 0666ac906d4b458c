"""What an anatomy is made from: a mask, a surface, or lines with radii, in mm: as stated, or as sizes tell. The kind of
file decides which reader takes it; that of markups stands here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from endopilot import files
from endopilot.errors import InputError, place_text
from endopilot.types import LumenMask, VesselTree
from endopilot.vessels.surface import Surface

MASK_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
SURFACE_SUFFIXES = (".stl", ".obj", ".ply", ".vtp", ".vtu", ".vtk")

_TABLE = "a table of points and radii becomes an anatomy in Python, by endopilot.Polylines (docs/guide/patient.md)"
_CONVERT = {
    ".csv": _TABLE,
    ".txt": _TABLE,
    ".swc": "write its points as the lines of a VTP with an array Radius (mm)",
    ".fcsv": "its points are a list without radii; open it in Slicer and save a centerline curve as .mrk.json",
    ".ctgr": "SimVascular's contours are no wall; export its model as VTP or its mesh as VTU",
    ".glb": "open it in Blender or MeshLab and export STL or PLY",
    ".gltf": "open it in Blender or MeshLab and export STL or PLY",
    ".step": "open it in the CAD program and export STL in mm",
    ".pth": "SimVascular's path has no radii; export its model as VTP or its mesh as VTU",
}
"""How a file that is not read becomes one that is, by its suffix."""

_NUMBERED_AXES = {"0": "ras", "1": "lps"}  # axes by the numbers of Slicer's older files

RADIUS_NAMES = ("maximuminscribedsphereradius", "misr", "radius", "radii")
"""Names of the point array or measurement that holds radii, in lower case: VMTK's, Slicer's, and plain ones."""

AXES = {"LPS": "lps", "LEFT-POSTERIOR-SUPERIOR": "lps", "RAS": "ras", "RIGHT-ANTERIOR-SUPERIOR": "ras"}
"""Axes by the names that files state them by."""

RAS_TO_LPS = np.array([-1.0, -1.0, 1.0])

SMALLEST_RADIUS_MM = 0.25  # vessels that a guidewire enters have mean radii from this on
LARGEST_EXTENT_MM = 2500.0  # no vessel of the body reaches farther

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

_LONGER_SD, _SHORTER_SD = 0.3, 0.9  # spread of ln(extent) of a kind; a file may hold a piece: shorter costs less

_UNITS = {"mm": 1.0, "cm": 10.0, "inches": 25.4, "dm": 100.0, "m": 1000.0, "tenths of mm": 0.1, "µm": 0.001}
_RARE = {"tenths of mm": 0.02, "µm": 0.02}  # how likely a unit is against cm, before the sizes are looked at

ASSUMED, STATED, ANSWERED = 4.0, 1e4, 1e6
"""How much likelier a file's unit is what it was taken for than any other: by default, since the file states the unit,
and since the user did."""

_CERTAIN, _FITS = 0.9, 0.05
"""A unit less probable than the first is asked for; the message names what has this share of the best one's chances."""

_NONE = 1e-6  # likelihood of sizes that are no vessel's; those of a kind's medians have 1
_NAMES = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("dm", "decimeter", "decimeters", "decimetre", "decimetres"), 100.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre"), 1e-3),
    **dict.fromkeys(("in", "inch", "inches", "[in_i]"), 25.4),
}
"""Millimetres in each unit of length by its names, in lower case; `[in_i]` is UCUM's inch, which Slicer writes."""


@dataclass(frozen=True, eq=False)
class Polylines:
    """Centerlines as a file holds them: positions and inscribed-sphere radii, mm, of any number of lines, in any order
    and direction, possibly overlapping. Messages call lines by their names, or by their numbers."""

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


def read_source(path: str | Path, *, label: int | str | None = None, threshold: float | None = None) -> AnatomySource:
    """Read a vessel from a mask, a surface or centerlines; the kind follows from the file.

    Args:
        path: mask (NIfTI, NRRD, MHA, DICOM-SEG), surface (STL, OBJ, PLY, VTP, VTU, VTK) or centerline (VTP with lines
            and radii, as VMTK writes it, or a Slicer markups curve `.mrk.json` with radii); or the folder of a
            patient's markups curves, which are the lines of one tree.
        label: number or name of the segment that is the lumen, where a mask has several.
        threshold: of a mask of grey levels, the value at the wall.

    Raises:
        InputError: the file is missing, damaged, empty, of an unknown kind, or a centerline without radii.
    """
    path = Path(path)
    if not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: no such file; give a mask, a surface or a centerline")
    lower = path.name.lower()
    for option, value in (("label", label), ("threshold", threshold)):
        if value is not None and not lower.endswith(MASK_SUFFIXES):
            raise InputError(f"{path}: --{option} {value} was given, but only masks have {option}s; leave it out")
    if path.is_dir():
        return _read_folder(path)
    if lower.endswith(MASK_SUFFIXES):
        from endopilot.imaging.volume import read_mask  # slow to import

        source = AnatomySource(read_mask(path, label=label, threshold=threshold), coordinates="lps")
    elif lower.endswith(".json"):
        source = _read_markups([path])
    elif lower.endswith(SURFACE_SUFFIXES):
        from endopilot.vessels.polydata import read_polydata  # slow to import

        source = read_polydata(path)
    else:
        known = " ".join((*MASK_SUFFIXES, *SURFACE_SUFFIXES, ".mrk.json"))
        convert = _CONVERT.get(path.suffix.lower())
        raise InputError(f"{path}: unknown kind of file; {convert or f'known are {known}'}")
    read = source.content.volume.files if isinstance(source.content, LumenMask) else ()
    return replace(source, file=path.name, sha256=files.input_hash(path, read)[path.name])


def _read_folder(folder: Path) -> AnatomySource:
    entries = sorted(folder.iterdir())
    curves = [path for path in entries if path.name.lower().endswith(".mrk.json")]
    if (folder / "anatomy.json").exists():
        raise InputError(f"{folder}: is an anatomy already; give it to the next command, such as `endopilot simulate`")
    if not curves:
        raise InputError(f"{folder}: holds no curves (.mrk.json); give a file or a folder of curves")
    notes = [f"{len(curves)} files of curves in the folder are the lines of one tree"]
    if len(entries) > len(curves):
        others = ", ".join(path.name for path in entries if path not in curves)
        notes.append(f"beside the curves the folder holds {others}: left out")
    sha256 = next(iter(files.input_hash(folder, curves).values()))
    return replace(_read_markups(curves, notes, named=True), file=folder.resolve().name, sha256=sha256)


def _read_markups(paths: Sequence[Path], notes: Sequence[str] = (), *, named: bool = False) -> AnatomySource:
    """Read the curves of files of Slicer's markups, in LPS mm, which may be named by their files; other markups beside
    them are left out with a note."""
    lines, names, notes, stated = list[Polylines](), list[str](), list(notes), set[tuple[str, float]]()
    for path in paths:
        content = files.read_json(path)
        markups = content.get("markups") if isinstance(content, dict) else None
        if not isinstance(markups, list) or not markups or not all(isinstance(markup, dict) for markup in markups):
            raise InputError(f"{path}: holds no Slicer markups; export the centerline curve as .mrk.json")
        curves, own, others = [], list[str](), list[str]()
        for number, markup in enumerate(markups):
            name, kind = str(markup.get("label") or markup.get("name") or number), str(markup.get("type") or "Curve")
            if kind.lower() in ("curve", "line"):
                curves.append(_curve(markup, f"{path}: curve {name!r}", own))
            else:
                others.append(f"{kind} {name!r} is no centerline")
        if not curves:
            raise InputError(f"{path}: {others[0]}; save it as an open curve (type Curve) in Slicer's Markups module")
        own += [f"{other}, and is left out" for other in others]
        lines.append(checked_lines(Polylines(*zip(*(curve[:2] for curve in curves), strict=True)), path, own))
        names += [path.name[: -len(".mrk.json")]] * len(curves) if named else []
        notes += [f"{path.name}: {note}" for note in own] if named else own
        stated |= {curve[2:] for curve in curves}
    axes, factors = (set(each) for each in zip(*stated, strict=True))
    points, radius = (tuple(one for own in lines for one in getattr(own, name)) for name in ("points", "radius"))
    return AnatomySource(
        Polylines(points, radius, tuple(names)),
        coordinates=" and ".join(sorted(axes)),
        factor=factors.pop() if len(factors) == 1 else 1.0,
        notes=tuple(notes),
    )


def _curve(
    markup: dict[str, Any], where: str, notes: list[str]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], str, float]:
    """Return the positions and radii of a curve, LPS mm, the axes and the mm in the unit that it states."""
    stated, unit = markup.get("coordinateSystem"), markup.get("coordinateUnits")
    axes = (AXES | _NUMBERED_AXES).get(str("LPS" if stated is None else stated).upper())
    if axes is None:
        raise InputError(
            f"{where}: coordinateSystem is {stated!r}, from which no place in the patient follows; "
            "save it in LPS or RAS"
        )
    factor, unit = _unit(unit, where)
    try:
        control = markup["controlPoints"]
        given = np.array([point.get("positionStatus", "defined") == "defined" for point in control], dtype=bool)
        places = np.array([control[i]["position"] for i in np.flatnonzero(given)], dtype=float)
        measured = {str(each.get("name")).lower(): each for each in markup.get("measurements", ())}
        sizes = next((measured[wanted] for wanted in RADIUS_NAMES if wanted in measured), {})
        radius = np.array(sizes.get("controlPointValues", ()), dtype=float)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: a position or radius is no number; export the curve again") from error
    radius = radius[given] if radius.shape == given.shape else radius
    if len(places) < 2 or places.shape != (radius.size, 3):
        raise InputError(
            f"{where} has positions of the shape {places.shape} and {radius.size} radii (it measures "
            f"{', '.join(measured) or 'nothing'}), not a radius at each of two points or more; export it from Slicer's "
            "Extract Centerline module"
        )
    if not given.all():
        notes.append(f"{where}: {int((~given).sum())} control points without a position are left out")
    if stated is None:
        notes.append(f"{where}: axes not stated: taken for LPS, the default of the format")
    if factor != 1.0:
        notes.append(f"{where} states {unit}: multiplied by {factor:g}")
    own_factor = _unit(own, where)[0] if (own := sizes.get("units")) else factor
    turn = RAS_TO_LPS if axes == "ras" else 1.0
    return places * turn * factor, radius.ravel() * own_factor, axes, factor


def _unit(stated: Any, where: str) -> tuple[float, Any]:
    """Return the mm in a unit, mm if none is stated, and its own name: newer files list name, system and meaning."""
    name = stated[0] if isinstance(stated, list) and stated else stated
    factor = 1.0 if name is None else mm_per_unit(name)
    if factor is None:
        raise InputError(f"{where}: unit {stated!r} is no known length; save it in mm")
    return factor, name


def transformed(source: AnatomySource, *, scale: float | None, coordinates: str | None) -> AnatomySource:
    """Return a source in LPS mm, with a note where nothing states the axes. `scale` (mm in its unit) and `coordinates`
    ("lps", "ras") are the user's; InputError where the file states others."""
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
    """Return centerlines whose positions are finite and whose radii are positive; InputError where they are not. Radii
    that are none at the end of a line become that of the point before, with a note."""
    if not lines.points:
        raise InputError(f"{path}: holds no line of at least two points; export the centerline again")
    radii = []
    for number, (points, radius) in enumerate(zip(lines.points, lines.radius, strict=True)):
        if not np.isfinite(points).all():
            raise InputError(f"{path}: {lines.name(number)}: some positions are not finite numbers; export it again")
        good = np.isfinite(radius) & (radius > 0)
        last = int(np.flatnonzero(good)[-1]) if good.any() else -1
        if not good[: last + 1].all() or last < 0:
            bad = int(np.argmin(good))
            raise InputError(
                f"{path}: {lines.name(number)}: the radius at {place_text(points[bad])} is {radius[bad]:g}; write "
                "inscribed-sphere radii in mm, which are positive"
            )
        if not good.all():
            notes.append(f"{lines.name(number)}: its last {len(good) - 1 - last} radii are none: that before is taken")
        radii.append(np.where(good, radius, radius[last]))
    return replace(lines, radius=tuple(radii))


def mm_per_unit(name: object) -> float | None:
    """Return how many mm a unit of length such as "mm" or "Inches" has, or None where the name is of none."""
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
    """Refuse a vessel (points on it, or its box's corners, in mm by `factor`) of another size than vessels have, or one
    that several units fit, with the sizes in each and its `--scale`.

    Radius and extent together tell the unit, each weighed by how usual it makes the two against the nearest kind of
    vessel; `odds` (`ASSUMED`, `STATED`, `ANSWERED`) favour the one it was taken in.
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
    if not fits or fits == [factor]:
        mend = "check the label and the units of positions and radii (--scale)"
        raise InputError(f"{label}: {_size(radius_mm, extent, 1.0)}, as no vessel does; {mend}")
    sizes = (f"{_size(radius_mm, extent, one / factor)} in {units[one]} (--scale {one:g})" for one in fits)
    raise InputError(f"{label}: its vessel {', or '.join(sizes)}; say which, with --scale")


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
