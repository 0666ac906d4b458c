"""One sentence of what was understood of a vessel: what a user checks in five seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence

from endopilot.anatomy.sources import AnatomySource
from endopilot.anatomy.units import ANSWERED, ASSUMED, BY_ARRAYS, unit_name
from endopilot.errors import place_text
from endopilot.types import LumenMask, VesselTree

_DONE = {
    "joined": r"bridged|united|capped|closed by filling|joined by|joined to one",
    "parted": r"parted|is cut|cut at|cut there|are cut",
    "widened": r"was widened|were widened",
    "left out": r"left out|not in the tree|not part of this|apart and|were not joined",
}
"""What a remark says was done, by its words."""

_KNOWN = {ASSUMED: " (not stated)", BY_ARRAYS: " (SimVascular's arrays)", ANSWERED: " (--scale)"}


def understood(tree: VesselTree, source: AnatomySource, coordinates: str | None, remarks: Sequence[str]) -> str:
    """Return what was understood: inlet, extent and narrowest place, unit and axes as taken, and what was done.

    Args:
        tree: what was made.
        source: in mm, as it was taken.
        coordinates: axes that the user stated, if any.
        remarks: what each step did, a sentence each.
    """
    lines = [branch.centerline for branch in tree.branches]
    farthest = max(float(line.abscissa[-1]) for line in lines)
    narrowest = min((line for line in lines), key=lambda line: float(line.radius.min()))
    if isinstance(source.content, LumenMask) or not source.file:
        read = "mm in LPS"
    else:
        axes = source.coordinates or coordinates
        stated = " (--coordinates)" if coordinates and not source.coordinates else "" if axes else " (not stated)"
        read = f"{unit_name(source.factor)}{_KNOWN.get(source.odds, '')} in {(axes or 'lps').upper()}{stated}"
    done = [_done(verb, [text for text in remarks if re.search(words, text)]) for verb, words in _DONE.items()]
    wall = [text for text in remarks if text.startswith("what is given is a wall")]
    return (
        f"Understood: enters at {place_text(lines[0].points[0])}, {2 * lines[0].radius[0]:.1f} mm wide; "
        f"{farthest:.0f} mm to the farthest end, {2 * narrowest.radius.min():.1f} mm wide at the narrowest; "
        + "; ".join([f"read as {read}", *wall, *filter(None, done)])
    )


def _done(verb: str, remarks: list[str]) -> str:
    """Return how many things were done, and the largest length that their remarks name beside places."""
    if not remarks:
        return ""
    bare = re.sub(r"\([^()]*\) mm", "", " ".join(remarks))
    sizes = [float(size) for size in re.findall(r"(\d+(?:\.\d+)?) mm", bare)]
    return f"{verb}: {len(remarks)}" + (f" (up to {max(sizes):.0f} mm)" if sizes else "")
