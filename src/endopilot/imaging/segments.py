"""Which of the segments of a mask file is meant: by number, or by the name that the file gives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from endopilot.errors import InputError
from endopilot.types import Volume

_MOST_LISTED = 20
_LONGEST_NAME = 40
_MOST_OF_BYTE = 255
_LIKE_NEIGHBOURS = 0.25


@dataclass(frozen=True)
class Segment:
    """A segment of a file: its name (or empty), the label image that it is in, from 0, and its value there."""

    name: str
    layer: int
    value: int


@dataclass(frozen=True, eq=False)
class ImageFile:
    """An image file's content: the volume of its first layer, all layers, and the segments that its header names."""

    volume: Volume
    layers: Shaped[np.ndarray, "layers nz ny nx"]
    segments: tuple[Segment, ...] = ()


def inside_segment(
    image: ImageFile, label: int | str | None, threshold: float | None, path: Path
) -> tuple[Bool[np.ndarray, "nz ny nx"], tuple[str, ...]]:
    """Return the voxels of the one segment that holds some, or was asked for, and notes. Its number is its value, or
    its place in the file, from 1, where several layers share values; `threshold` divides grey levels. Raises InputError
    where a layer is neither, nothing is inside, or the label is not there or not given."""
    layers = image.layers
    if threshold is not None:
        if label is not None or len(layers) > 1:
            raise InputError(f"{path}: threshold={threshold:g} is for grey levels, which have no labels; give either")
        return _inside_threshold(layers[0], threshold, path)
    found = [_values(layer, label is not None, path) for layer in layers]
    named = [s for s in image.segments if s.layer < len(layers)]
    known = {(s.layer, s.value) for s in named}
    named += [Segment("", k, v) for k, values in enumerate(found) for v in values if (k, v) not in known]
    by_value = len({s.value for s in named}) == len(named)
    numbered = [(s.value if by_value else place, s) for place, s in enumerate(named, start=1)]
    present = [(number, s) for number, s in numbered if s.value in found[s.layer]]
    if not present:
        raise InputError(f"{path}: the mask is empty; segment the vessel again or give another file")
    chosen = choose(present, label, path)
    return layers[chosen.layer] == chosen.value, ()


def _inside_threshold(
    grey: Shaped[np.ndarray, "nz ny nx"], threshold: float, path: Path
) -> tuple[Bool[np.ndarray, "nz ny nx"], tuple[str, ...]]:
    """Return the voxels on the side of a threshold on which the volume's border does not lie: the border is outside."""
    low, high = float(grey.min()), float(grey.max())
    if not low < threshold <= high:  # nor is it where some voxels are NaN
        raise InputError(f"{path}: threshold={threshold:g}: its values go from {low:g} to {high:g}; give one between")
    border = np.concatenate([grey.take(end, axis).ravel() for axis in range(3) for end in (0, -1)])
    if np.median(border) < threshold:
        return grey >= threshold, ()
    return grey < threshold, (f"{path.name}: the volume's border is above {threshold:g}: what is below is inside",)


def choose(
    numbered: Sequence[tuple[int, Segment]], label: int | str | None, path: Path, *, show_names: bool = True
) -> Segment:
    """Return the only segment, or that of a number or name; InputError, which names them if `show_names`."""
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
    words = " ".join(name.split())[:_LONGEST_NAME]
    return f"{number} ({words})" if words else str(number)


def _values(layer: Shaped[np.ndarray, "nz ny nx"], asked: bool, path: Path) -> list[int]:
    """Return the values but 0 of a label image, after making sure that it is one; of a CT none can be asked for."""
    own = layer[layer != 0]
    if not np.isfinite(own).all():
        raise InputError(f"{path}: some voxels are not finite numbers; write it again with 0 in their place")
    low, high = min(float(own.min(initial=0)), 0.0), max(float(own.max(initial=0)), 0.0)
    if own.dtype.kind in "iu" or np.array_equal(own, np.round(own)):
        if high - low < 1 << 16:
            counts = np.bincount(own.astype(np.int64) - int(low))
            values, counts = np.flatnonzero(counts) + int(low), counts[counts > 0]
        else:
            values, counts = np.unique(own, return_counts=True)
        several = len(values) > 1 and (not asked or low < 0)
        if not (several and _is_grey(layer, float(values[counts.argmax()]))) and (high > 0 or not len(values)):
            return [int(value) for value in values]
    ct = "a CT is segmented first (`endopilot segment`); " if low < 0 or high > _MOST_OF_BYTE else ""
    kind = "signed distances or level sets" if low < 0 else "probabilities or a mask resampled to grey levels"
    middle = 0.0 if low < 0 else 0.5 if high <= 1 else high / 2
    raise InputError(
        f"{path}: values from {low:g} to {high:g} are no mask of labels: {ct}{kind} become one with "
        f"threshold={middle:g} (--threshold {middle:g})"
    )


def _is_grey(layer: Shaped[np.ndarray, "nz ny nx"], usual: float) -> bool:
    """Return whether whole numbers are grey levels: few neighbours are alike, neither both 0 nor of the usual value:
    along some axis at most 24 % in vessels of 1 to 12 mm in 2 to 255 greys, 29 % or more in thinnest labels."""
    for axis in range(3):
        one, other = (np.moveaxis(layer, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        pairs = (one != 0) & (other != 0) & ((one != usual) | (other != usual))
        if np.count_nonzero(pairs & (one == other)) < _LIKE_NEIGHBOURS * np.count_nonzero(pairs):
            return True
    return False
