"""Which of the segments of a mask file is meant: by number, or by the name that the file gives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from endopilot.errors import InputError

_MOST_LISTED = 20
_LONGEST_NAME = 40


@dataclass(frozen=True)
class Segment:
    """A segment as a file describes it.

    Attributes:
        name: empty where it has none.
        layer: which of the file's label images it is in, from 0.
        value: of its voxels there.
    """

    name: str
    layer: int
    value: int


def inside_segment(
    layers: Shaped[np.ndarray, "layers nz ny nx"],
    segments: Sequence[Segment],
    label: int | str | None,
    path: Path,
) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the voxels of the one segment that holds some, or of the one asked for.

    A segment's number is its value; where segments of several layers share values, it is its place in the file, from 1.

    Args:
        layers: label images, 0 outside.
        segments: those that the file names.
        label: number or name of a segment; None where there is but one.
        path: the file, for messages.

    Raises:
        InputError: a layer is no label image, nothing is inside, or the label is not there or not given.
    """
    found = [_values(layer, path) for layer in layers]
    named = [s for s in segments if s.layer < len(layers)]
    known = {(s.layer, s.value) for s in named}
    named += [Segment("", k, v) for k, values in enumerate(found) for v in values if (k, v) not in known]
    by_value = len({s.value for s in named}) == len(named)
    numbered = [(s.value if by_value else place, s) for place, s in enumerate(named, start=1)]
    present = [(number, s) for number, s in numbered if s.value in found[s.layer]]
    if not present:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    chosen = choose(present, label, path)
    return layers[chosen.layer] == chosen.value


def choose(
    numbered: Sequence[tuple[int, Segment]], label: int | str | None, path: Path, *, show_names: bool = True
) -> Segment:
    """Return the one segment there is, or the one with a number or name.

    Args:
        numbered: segments that hold voxels, each with its number.
        label: number or name of a segment; None where there is but one.
        path: the file, for messages.
        show_names: whether messages may hold the names.

    Raises:
        InputError: there are several, or none or several of that name.
    """
    listed = ", ".join(_shown(number, s.name if show_names else "") for number, s in numbered[:_MOST_LISTED])
    listed += ", …" if len(numbered) > _MOST_LISTED else ""
    if label is None:
        if len(numbered) > 1:
            raise InputError(
                f"{path}: the mask holds {len(numbered)} labels ({listed}); choose one: label=N (--label N)"
            )
        return numbered[0][1]
    wanted = str(label).strip()
    matching = [s for number, s in numbered if wanted == s.name.strip()]
    matching = matching or [s for number, s in numbered if wanted == str(number)]
    matching = matching or [s for number, s in numbered if wanted.casefold() == s.name.strip().casefold()]
    if not matching:
        raise InputError(f"{path}: no voxel has label {wanted}; the file holds {listed}")
    if len(matching) > 1:
        raise InputError(f"{path}: {len(matching)} segments are called {wanted}; choose one by number: {listed}")
    return matching[0]


def _shown(number: int, name: str) -> str:
    """Return a segment's number, and its name as one short line."""
    words = " ".join(name.split())[:_LONGEST_NAME]
    return f"{number} ({words})" if words else str(number)


def _values(layer: Shaped[np.ndarray, "nz ny nx"], path: Path) -> list[int]:
    """Return the values above 0 of a label image, after making sure that it is one."""
    low, high = float(layer.min()), float(layer.max())
    whole = layer.dtype.kind in "iu" or (np.isfinite(layer).all() and np.array_equal(layer, np.round(layer)))
    if not whole or low < 0:
        raise InputError(f"{path}: values from {low:g} to {high:g} are no mask; give whole numbers ≥ 0")
    if high < 1 << 16:
        counts = np.bincount(layer.ravel().astype(np.uint16, copy=False))
        return [int(value) for value in np.flatnonzero(counts) if value > 0]
    return [int(value) for value in np.unique(layer) if value > 0]
