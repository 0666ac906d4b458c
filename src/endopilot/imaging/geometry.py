"""Where the voxels of an image lie: one rule on spacing, origin and axes for every file format.

Axes that miss right angles by less than 1e-2 are those of a header with few digits: they are straightened, and noted.
Beyond, the image is sheared (a gantry tilt, for instance), and is refused with the name of the header's field.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from endopilot.errors import InputError
from endopilot.types import Volume

AXES_TOLERANCE = 1e-2  # cosine between axes, and error of a unit vector's length, below which they are straightened
_PLACE_TOLERANCE = 0.05  # a slice may lie off its place by this share of the step: positions have few digits
_ROUNDING = 1e-5  # what single precision and six decimals leave, some micrometres: it is not noted


def require(good: object, path: Path, said: str) -> None:
    """Raise InputError, which names the file and what is wrong with it, unless a check of its header is passed."""
    if not good:
        raise InputError(f"{path}: {said}")


def placed(
    voxels: Shaped[np.ndarray, "nz ny nx"],
    direction: Float[np.ndarray, "3 3"],
    spacing_mm: Float[np.ndarray, "3"],
    origin_mm: Float[np.ndarray, "3"],
    *,
    path: Path,
    fields: tuple[str, str, str],
    notes: tuple[str, ...] = (),
    files: tuple[Path, ...] = (),
) -> Volume:
    """Return voxels where a header puts them, its axes (columns of `direction`) straightened to the nearest rotation
    about the volume's centre, and noted. `fields` are the format's names of direction, spacing and origin. Raises
    InputError, which names them, for what is no such geometry."""
    for name, values in zip(fields, (direction.T, spacing_mm, origin_mm), strict=True):
        shown = " ".join(f"{value:g}" for value in np.ravel(values))
        require(np.isfinite(values).all(), path, f"{name} holds {shown}, which is not finite; export it again")
    small = f"{fields[1]} gives voxels of {lengths_text(spacing_mm)} mm; export it again"
    require(spacing_mm.min() > 0, path, small)
    lengths = np.linalg.norm(direction, axis=0)
    long = f"{fields[0]} holds axes of length {lengths_text(lengths)}, which must be 1; export it again"
    require(np.abs(lengths - 1.0).max() < AXES_TOLERANCE, path, long)
    axes = direction / lengths
    skew = float(np.abs(axes.T @ axes - np.eye(3)).max())
    off = f"off by {np.degrees(np.arcsin(min(skew, 1.0))):.2g}°: a sheared image or a gantry tilt"
    sheared = f"{fields[0]}: its axes are not at right angles ({off}); resample it to straight slices"
    require(skew < AXES_TOLERANCE, path, sheared)
    left, _, right = np.linalg.svd(axes)
    # 0 - 0 and not -0: the axes of an upright volume stay the plain numbers that they are.
    straight = axes if skew < 1e-12 else left @ right
    error = max(skew, float(np.abs(lengths - 1.0).max()))
    if error < _ROUNDING:
        return Volume(voxels, spacing_mm, origin_mm, straight, notes, files)
    origin = origin_mm + (direction - straight) @ (spacing_mm * (np.array(voxels.shape[::-1], dtype=float) - 1.0) / 2.0)
    straightened = Volume(voxels, spacing_mm, origin, straight)
    moved = farthest_apart_mm(Volume(voxels, spacing_mm, origin_mm, direction), straightened)
    note = (
        f"{path.name}: the axes in {fields[0]} are off unit vectors at right angles by {error:.2g}; they were "
        f"straightened, which moved voxels by up to {moved:.2g} mm"
    )
    return replace(straightened, notes=(*notes, note), files=files)


def parted(steps_mm: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return directions and lengths of a header's steps along i, j and k; `placed` refuses one without length."""
    lengths = np.linalg.norm(steps_mm, axis=0)
    with np.errstate(invalid="ignore"):
        return steps_mm / np.where(lengths > 0, lengths, 1.0), lengths


def farthest_apart_mm(one: Volume, other: Volume) -> float:
    """Return how far two grids of one size put the same voxel apart at most, mm."""
    corners = np.array(list(itertools.product(*((0.0, extent - 1.0) for extent in one.voxels.shape[::-1]))))
    return float(np.linalg.norm(one.index_to_world(corners) - other.index_to_world(corners), axis=1).max())


def plane(
    orientation: Sequence[float], spacing_mm: Sequence[float], *, path: Path
) -> tuple[Float[np.ndarray, "3 2"], Float[np.ndarray, "3"]]:
    """Return the directions of i and j in a DICOM slice, from ImageOrientationPatient and PixelSpacing, and their unit
    normal. Raises InputError for axes that are not at right angles, or pixels without size."""
    axes = np.array(orientation, dtype=float).reshape(2, 3).T
    normal = np.cross(axes[:, 0], axes[:, 1])
    length = float(np.linalg.norm(normal))
    normal = normal / length if length > 0.1 else np.array([0.0, 0.0, 1.0])
    turned, sizes = np.column_stack([axes, normal]), np.array([*spacing_mm[::-1], 1.0])
    fields = "ImageOrientationPatient", "PixelSpacing", ""
    placed(np.zeros((1, 1, 1)), turned, sizes, np.zeros(3), path=path, fields=fields)
    return axes, normal


def slice_grid(
    positions: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "3 2"],
    spacing_mm: Sequence[float],
    size: tuple[int, int],
    *,
    path: Path,
) -> Volume:
    """Return the volume, still empty, of parallel slices of `size` (Rows, Columns; DICOM PS3.3 C.7.6.2.1.1). Bounded is
    how far each lies from its place in the even grid, not the step, whose errors add up. Raises InputError for uneven
    steps or a slant."""
    first, slots = positions[0], np.arange(len(positions))
    travel = (positions[-1] - first) / slots[-1]
    step = float(np.linalg.norm(travel))
    off = np.linalg.norm(positions - first - slots[:, None] * travel, axis=1)
    worst = int(off.argmax())
    uneven = f"slice {worst + 1} lies {off[worst]:.2f} mm from where even steps of {step:.2f} mm put it"
    mend = "export the series again, or resample it to even steps"
    require(
        off[worst] <= _PLACE_TOLERANCE * step, path, f"ImagePositionPatient are not evenly spaced: {uneven}; {mend}"
    )
    return placed(
        np.broadcast_to(np.int16(0), (len(positions), *size)),
        np.column_stack([axes, travel / step]),
        np.array([*spacing_mm[::-1], step]),
        first,
        path=path,
        fields=("ImageOrientationPatient and ImagePositionPatient", "PixelSpacing", "ImagePositionPatient"),
    )


def lengths_text(lengths: np.ndarray) -> str:
    """Return the edges of a voxel as messages write them."""
    return "×".join(f"{length:.3g}" for length in lengths)
