"""Targets by name, by place and by depth: `find_target`."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.tasks.navigation import Target
from endopilot.types import VesselTree

OUTSIDE_MM = 2.0
"""A point this far outside the lumen is no target, mm."""
Place = str | Target | Sequence[float] | Float[np.ndarray, "3"]
"""A section such as "4" or "LAD", a point X, Y, Z in LPS mm as text or as numbers, or a target itself."""
_ALIASES = {"pda": ("4", "15"), "lad": ("7",), "lcx": ("13", "11"), "rca": ("3",), "pl": ("16", "14"), "lm": ("5",)}
"""Other names of AHA/SCCT segments; of several, the first that a tree has. The PDA comes from the left as 15."""


def find_target(tree: VesselTree, place: Place, *, depth_mm: float | None = None) -> Target:
    """Return the target that is meant, as `Anatomy.target` says.

    The middle of a section lies on the branch that holds most of it. `depth_mm` counts in the branch where the section
    begins, of several in the one that begins nearest to the ostium, and goes on in the straightest one. InputError for
    what is not there: a section, one that is deep enough, a point of three finite numbers in the lumen, a target.
    """
    if isinstance(place, Target):
        try:
            place.check(tree)
        except ValueError as error:
            raise InputError(str(error)) from None
        return place
    if not isinstance(place, str):
        numbers = np.ravel(np.array(place, dtype=object)).tolist()
        return _nearest(tree, numbers, ",".join(map(str, numbers)))
    if not place.strip():
        raise InputError("target: is empty; give a section such as 4, or a point X,Y,Z in LPS mm")
    place = place.strip(" ()[]")
    parts = place.split(",")
    if len(parts) == 3 and ";" not in place:
        return _nearest(tree, parts, place)
    numbers = re.findall(r"[-+0-9.e]+", place)
    if len(numbers) > 1 and not re.sub(r"[-+0-9.e,;\s]", "", place):
        mend = f"write it as {','.join(numbers)}" if len(numbers) == 3 else f"these are {len(numbers)} numbers"
        raise InputError(f"target: {place!r}; a point is X,Y,Z in LPS mm, three numbers with commas: {mend}")
    present = {present.lower(): present for present in tree.sections_present}
    for known in _ALIASES.get(place.lower(), (place.lower(),)):
        if known in present:
            label = tree.section_names.index(present[known])
            return _middle(tree, label) if depth_mm is None else _beyond(tree, label, depth_mm)
    raise InputError(
        f"target: {place!r}; the vessel has no such section (it has {', '.join(tree.sections_present)}); "
        "give one of them, or a point X,Y,Z in LPS mm"
    )


def section_at(tree: VesselTree, branch: int, abscissa: float) -> str:
    """Return the name of the section that a place of the tree lies in."""
    line = tree.branches[branch].centerline
    at = int(np.argmin(np.abs(line.abscissa - abscissa)))
    return tree.section_names[int(tree.branches[branch].section[at])]


def _middle(tree: VesselTree, label: int) -> Target:
    """Return the middle of a section, on the branch that holds most of it."""
    own = [branch.centerline.abscissa[branch.section == label] for branch in tree.branches]
    branch = int(np.argmax([at[-1] - at[0] if len(at) else -1.0 for at in own]))
    return Target(branch=branch, abscissa=float((own[branch][0] + own[branch][-1]) / 2))


def _beyond(tree: VesselTree, label: int, depth_mm: float) -> Target:
    """Return the place that lies a depth beyond the begin of a section."""
    begins = {
        index: float(branch.centerline.abscissa[max(int(np.argmax(branch.section == label)) - 1, 0)])
        for index, branch in enumerate(tree.branches)
        if (branch.section == label).any()
    }
    branch = min(begins, key=lambda index: begins[index])
    abscissa = begins[branch] + depth_mm
    while abscissa > tree.branches[branch].centerline.abscissa[-1]:
        onwards = [child for child in tree.children(branch) if child in begins]
        if not onwards:
            raise InputError(f"depth_mm: {depth_mm:g}; section {tree.section_names[label]} of this tree is shorter")
        branch = min(onwards, key=lambda child: turn_rad(tree, child))
    return Target(branch=branch, abscissa=abscissa)


def turn_rad(tree: VesselTree, branch: int) -> float:
    """Return the angle between a branch's first direction and its parent's last, rad, over some millimetres."""
    line, before = tree.branches[branch].centerline, tree.branches[tree.branches[branch].parent].centerline
    clear = float(line.radius[0]) + float(line.radius[-1])
    out = line.points[min(int(np.searchsorted(line.abscissa, line.abscissa[0] + clear)), len(line.points) - 1)]
    back = before.points[max(int(np.searchsorted(before.abscissa, before.abscissa[-1] - clear)) - 1, 0)]
    into, onto = line.points[0] - back, out - line.points[0]
    return float(np.arccos(np.clip(into @ onto / (np.linalg.norm(into) * np.linalg.norm(onto)), -1.0, 1.0)))


def _nearest(tree: VesselTree, numbers: Sequence[str] | Sequence[float], text: str) -> Target:
    """Return the place of the centerline that is nearest to a point, LPS mm."""
    try:
        point = np.array([float(number) for number in numbers])
    except (TypeError, ValueError):
        point = np.full(3, np.nan)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"target: {text}; not three finite numbers; give a point as X,Y,Z in LPS mm")
    lines = [branch.centerline for branch in tree.branches]
    distances = [np.linalg.norm(line.points - point, axis=1) for line in lines]
    branch = int(np.argmin([distance.min() for distance in distances]))
    at = int(np.argmin(distances[branch]))
    distance, radius = float(distances[branch][at]), float(lines[branch].radius[at])
    if distance > radius + OUTSIDE_MM:
        raise InputError(
            f"target: {text}; {distance:.1f} mm from the nearest centerline of the vessel, whose lumen is "
            f"{radius:.1f} mm in radius there; give a point in the vessel, in LPS mm"
        )
    return Target(branch=branch, abscissa=float(lines[branch].abscissa[at]))
